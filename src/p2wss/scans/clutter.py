"""What stands on, at and over buildings and is in no label: the paper (section 6) names it as missing.

Dormers, chimneys, raised parts, parapets, skylights, annexes, trees, and data that is missing. They are more
triangles for the caster and change the point cloud only. Each building draws from its own key, so it has the
same clutter in every tile that sees it; only what would stand inside a neighbour is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import shapely

from p2wss.config import Clutter
from p2wss.data.polygon_arrays import to_geometries
from p2wss.scans.houses import Houses, across, beside, between, chosen, edges, rectangle
from p2wss.scans.randomness import uniforms
from p2wss.scans.shell import lower_parts, stand_back
from p2wss.scans.surface import (
    ANNEX,
    CHIMNEY,
    DORMER,
    PARAPET,
    RAISED_PART,
    SHADE,
    SKYLIGHT,
    TREE,
    Surface,
    encode_thing,
)
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import FaceKind

NAMES = ("dormer", "chimney", "raised_part", "parapet", "skylight", "annex", "tree", "shade")
_TRIES = 4  # places that are tried for a thing that must fit on a roof face
_MAX_DORMERS, _MAX_TREES = 3, 6
_LEAF_AREA_M2 = 0.35  # a triangle stands for a clump of leaves
_MOST_LEAVES = 2000


class Things(NamedTuple):
    """Triangles: vertex_m float64 (t, 3, 3); building, thing int32 (t,); loss float32 (t,)."""

    vertex_m: np.ndarray
    building: np.ndarray
    thing: np.ndarray
    loss: np.ndarray


class _Roofs(NamedTuple):
    """Roof triangles, ordered by building: building b has ``offset[b]:offset[b + 1]``."""

    corner_m: np.ndarray  # (m, 3, 3)
    face: np.ndarray
    offset: np.ndarray
    area_before_m2: np.ndarray  # (m + 1,), of the triangles before


def clutter(surface: Surface, houses: Houses, shares: Clutter) -> tuple[Surface, dict[str, int]]:
    """``surface`` with the clutter of ``houses``, and how many things of each kind there are.

    Points on a thing get a face id of kind 0, see :func:`surface.encode_thing`, so they count neither as roof
    nor as wall; trees belong to no building (-1).
    """
    surface, num_lower = lower_parts(surface, houses, shares.lower_part_share)
    surface, num_eaves = stand_back(surface, houses, shares.eave_overhang_share, shares.eave_overhang_m)
    counts = {"lower_part": num_lower, "eave_overhang": num_eaves}
    roofs = _roofs(surface, len(houses.key))
    makers: list[tuple[int, Callable[[], Things]]] = [
        (DORMER, lambda: _dormers(roofs, houses, shares.dormer_share)),
        (CHIMNEY, lambda: _chimneys(roofs, houses, shares.chimney_share)),
        (RAISED_PART, lambda: _raised_parts(roofs, houses, shares.raised_part_share)),
        (PARAPET, lambda: _parapets(roofs, houses, shares.parapet_share)),
        (SKYLIGHT, lambda: _skylights(roofs, houses, shares.skylight_share, shares.skylight_loss)),
        (ANNEX, lambda: _annexes(houses, shares.annex_share)),
        (TREE, lambda: _trees(surface, houses, shares.trees_per_building)),
        (SHADE, lambda: _shades(roofs, houses, shares.shade_share)),
    ]
    made = []
    for thing, make in makers:
        things = make()
        counts[NAMES[thing]] = len(np.unique(things.thing))
        made.append(things._replace(thing=np.full(len(things.thing), thing, np.int32)))
    things = Things(*(np.concatenate(column) for column in zip(*made, strict=True)))
    return _joined(surface, things), counts


def _joined(surface: Surface, things: Things) -> Surface:
    count, tree = len(things.thing), things.thing == TREE
    first = len(surface.vertex_m)
    corners = np.arange(3 * count).reshape(-1, 3) + first
    return surface._replace(
        vertex_m=np.concatenate([surface.vertex_m, things.vertex_m.reshape(-1, 3)]),
        triangle=np.concatenate([surface.triangle, corners.astype(np.int32)]),
        building=np.concatenate([surface.building, np.where(tree, -1, things.building).astype(np.int32)]),
        face=np.concatenate([surface.face, encode_thing(things.thing)]),
        reflectance=np.concatenate([surface.reflectance, np.where(tree, 0.4, 0.3).astype(np.float32)]),
        loss=np.concatenate([surface.loss, things.loss]),
        porous=np.concatenate([surface.porous, tree]),
    )


def _roofs(surface: Surface, num_buildings: int) -> _Roofs:
    kind = surface.face & 3
    chosen = np.flatnonzero((kind == FaceKind.ROOF) | (kind == FaceKind.FLAT))
    chosen = chosen[np.argsort(surface.building[chosen], kind="stable")]
    corner = surface.vertex_m[surface.triangle[chosen]]
    area = 0.5 * np.linalg.norm(_normals(corner), axis=1)
    offset = np.searchsorted(surface.building[chosen], np.arange(num_buildings + 1))
    return _Roofs(corner, surface.face[chosen], offset, np.concatenate([[0.0], np.cumsum(area)]))


def _normals(corner_m: np.ndarray) -> np.ndarray:
    """Normals of triangles (n, 3, 3), upwards, twice the area long."""
    normal = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    return normal * np.where(normal[:, 2:] < 0, -1.0, 1.0)


class _Anchors(NamedTuple):
    """Places on roofs: row of the building, face, point (k, 3), unit uphill direction (k, 2), slope (k,)."""

    row: np.ndarray
    face: np.ndarray
    point_m: np.ndarray
    uphill: np.ndarray
    slope: np.ndarray


def _anchors(roofs: _Roofs, rows: np.ndarray, u: np.ndarray) -> _Anchors:
    """A random point on the roof of each of ``rows`` by three draws each, u (k, 3)."""
    first, last = roofs.area_before_m2[roofs.offset[rows]], roofs.area_before_m2[roofs.offset[rows + 1]]
    target = first + u[:, 0] * (last - first)
    index = np.searchsorted(roofs.area_before_m2, target, side="right") - 1
    index = np.clip(index, roofs.offset[rows], roofs.offset[rows + 1] - 1)
    corner = roofs.corner_m[index]
    root = np.sqrt(u[:, 1:2])
    point = (
        (1 - root) * corner[:, 0] + root * (1 - u[:, 2:3]) * corner[:, 1] + root * u[:, 2:3] * corner[:, 2]
    )
    normal = _normals(corner)
    flat = np.linalg.norm(normal[:, :2], axis=1)
    level = flat < 1e-9 * np.abs(normal[:, 2])
    uphill = np.where(level[:, None], [1.0, 0.0], -normal[:, :2] / np.where(level, 1, flat)[:, None])
    return _Anchors(rows, roofs.face[index], point, uphill, np.where(level, 0, flat / normal[:, 2]))


@entry
def _on_roof(
    xy: np.ndarray,
    row: np.ndarray,
    face: np.ndarray,
    corner: np.ndarray,
    faces: np.ndarray,
    offset: np.ndarray,
) -> np.ndarray:
    """Whether all points xy (k, p, 2) are over the roof of building ``row``; only over ``face`` unless it is
    -1."""
    result = np.ones(len(xy), np.bool_)
    for k in range(len(xy)):
        for p in range(xy.shape[1]):
            x, y = xy[k, p, 0], xy[k, p, 1]
            inside = False
            for t in range(offset[row[k]], offset[row[k] + 1]):
                if face[k] >= 0 and faces[t] != face[k]:
                    continue
                sides = 0
                for i in range(3):
                    ax, ay = corner[t, i, 0], corner[t, i, 1]
                    bx, by = corner[t, (i + 1) % 3, 0], corner[t, (i + 1) % 3, 1]
                    cross = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
                    sides += (cross >= 0) - (cross <= 0)
                if abs(sides) >= 2:
                    inside = True
                    break
            if not inside:
                result[k] = False
                break
    return result


def _fitted(
    roofs: _Roofs,
    rows: np.ndarray,
    u: np.ndarray,
    outline: Callable[[_Anchors, np.ndarray], np.ndarray],
    one_face: bool = True,
    steep: tuple[float, float] = (0.0, np.inf),
) -> tuple[np.ndarray, _Anchors]:
    """Anchors at which ``outline(anchors, index)`` (k, p, 2) lies on the roof, the first of a few that does.

    ``u`` has three draws per try and row. Returns the index into ``rows`` of those that found a place.
    """
    found_index, found = [], []
    pending = np.flatnonzero(roofs.offset[rows + 1] > roofs.offset[rows])
    for attempt in range(_TRIES):
        anchors = _anchors(roofs, rows[pending], u[pending, 3 * attempt : 3 * attempt + 3])
        good = (anchors.slope >= steep[0]) & (anchors.slope <= steep[1])
        face = anchors.face if one_face else np.full(len(pending), -1, np.int32)
        good &= _on_roof(
            outline(anchors, pending), anchors.row, face, roofs.corner_m, roofs.face, roofs.offset
        )
        found_index.append(pending[good])
        found.append(_Anchors(*(column[good] for column in anchors)))
        pending = pending[~good]
    index = np.concatenate(found_index)
    return index, _Anchors(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _things(corner_m: np.ndarray, template: list[tuple[int, int, int]], row: np.ndarray) -> Things:
    """Copies of one polyhedron: corner_m (k, v, 3), its triangles, and the building of each.

    ``thing`` numbers the copies here; :func:`clutter` replaces it by what they are.
    """
    count = len(template)
    triangles = corner_m[:, np.array(template)].reshape(-1, 3, 3)
    number = np.repeat(np.arange(len(row), dtype=np.int32), count)
    return Things(
        triangles, np.repeat(row, count).astype(np.int32), number, np.zeros(len(triangles), np.float32)
    )


_BOX = [(4, 5, 6), (4, 6, 7)] + [
    t for i in range(4) for t in ((i, (i + 1) % 4, (i + 1) % 4 + 4), (i, (i + 1) % 4 + 4, i + 4))
]


def _boxes(outline: np.ndarray, low: np.ndarray, high: np.ndarray, row: np.ndarray) -> Things:
    """Blocks over outlines (k, 4, 2) from ``low`` to ``high`` (k,), without floors."""
    corner = np.empty((len(outline), 8, 3))
    corner[:, :4, :2] = corner[:, 4:, :2] = outline
    corner[:, :4, 2], corner[:, 4:, 2] = low[:, None], high[:, None]
    return _things(corner, _BOX, row)


def _dormers(roofs: _Roofs, houses: Houses, share: float) -> Things:
    """Gabled dormers: a front wall on the slope, its ridge runs level into the slope."""
    some, u = chosen(houses, DORMER, share)
    each = 1 + np.minimum((u[:, 0] * _MAX_DORMERS).astype(int), _MAX_DORMERS - 1)
    number = np.arange(_MAX_DORMERS)
    rows, which = (a.ravel() for a in np.broadcast_arrays(some[:, None], number[None]))
    wanted = (number[None] < each[:, None]).ravel()
    size = np.repeat(u[:, 1:4], _MAX_DORMERS, axis=0)[wanted]  # dormers of a house are alike
    place = u[:, 4 : 4 + 3 * _TRIES * _MAX_DORMERS].reshape(-1, 3 * _TRIES)[wanted]
    rows, which = rows[wanted], which[wanted]
    half, high = between(size[:, 0], 0.5, 1.1), between(size[:, 1], 0.8, 1.4)
    rise = half * between(size[:, 2], 0.3, 1.0)

    def outline(at: _Anchors, index: np.ndarray) -> np.ndarray:
        return _dormer_corners(at, half[index], high[index], rise[index])[:, [0, 1, 5, 6, 7], :2]

    index, at = _fitted(roofs, rows, place, outline, steep=(0.35, 2.0))
    corner = _dormer_corners(at, half[index], high[index], rise[index])
    template = [
        (0, 1, 3),
        (0, 3, 2),
        (2, 3, 4),
        (0, 2, 5),
        (1, 6, 3),
        (2, 4, 7),
        (2, 7, 5),
        (3, 6, 7),
        (3, 7, 4),
    ]
    return _things(corner, template, at.row)


def _dormer_corners(at: _Anchors, half: np.ndarray, high: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Bottom left and right, top left and right, gable; where left and right eaves and ridge meet the slope."""
    corner = np.empty((len(half), 8, 3))
    side, slope = across(at.uphill) * half[:, None], np.maximum(at.slope, 0.05)
    back, ridge_back = (high / slope)[:, None], ((high + rise) / slope)[:, None]
    x = at.point_m[:, :2]
    corner[:, 0, :2] = corner[:, 2, :2] = x + side
    corner[:, 1, :2] = corner[:, 3, :2] = x - side
    corner[:, 4, :2] = x
    corner[:, 5, :2], corner[:, 6, :2] = x + side + back * at.uphill, x - side + back * at.uphill
    corner[:, 7, :2] = x + ridge_back * at.uphill
    z = at.point_m[:, 2]
    corner[:, :2, 2] = z[:, None]
    corner[:, [2, 3, 5, 6], 2] = (z + high)[:, None]
    corner[:, [4, 7], 2] = (z + high + rise)[:, None]
    return corner


def _chimneys(roofs: _Roofs, houses: Houses, share: float) -> Things:
    rows, u = chosen(houses, CHIMNEY, share)
    half = np.stack([between(u[:, 0], 0.2, 0.5), between(u[:, 1], 0.2, 0.4)], axis=1)
    high = between(u[:, 2], 0.5, 1.6)

    def outline(at: _Anchors, index: np.ndarray) -> np.ndarray:
        return rectangle(at.point_m[:, :2], at.uphill, half[index])

    index, at = _fitted(roofs, rows, u[:, 3:], outline, one_face=False)
    low = at.point_m[:, 2] - at.slope - 0.2
    return _boxes(outline(at, index), low, at.point_m[:, 2] + high[index], at.row)


def _raised_parts(roofs: _Roofs, houses: Houses, share: float) -> Things:
    """Parts of another height inside the footprint: stair heads, lift houses, raised bays."""
    rows, u = chosen(houses, RAISED_PART, share)
    half, high = between(u[:, :2], 1.0, 2.2), between(u[:, 2], 1.0, 3.0)

    def outline(at: _Anchors, index: np.ndarray) -> np.ndarray:
        return rectangle(at.point_m[:, :2], at.uphill, half[index])

    index, at = _fitted(roofs, rows, u[:, 3:], outline, one_face=False)
    low = at.point_m[:, 2] - 3 * at.slope - 0.5
    return _boxes(outline(at, index), low, at.point_m[:, 2] + high[index], at.row)


def _skylights(roofs: _Roofs, houses: Houses, share: float, loss: tuple[float, float]) -> Things:
    """Panes and solar panels, 4 cm above the slope: a mirror sends most pulses elsewhere."""
    rows, u = chosen(houses, SKYLIGHT, share)
    half = np.stack([between(u[:, 0], 0.4, 1.2), between(u[:, 1], 0.4, 2.5)], axis=1)

    def outline(at: _Anchors, index: np.ndarray) -> np.ndarray:
        flat = half[index] / np.stack([np.sqrt(1 + at.slope**2), np.ones(len(at.slope))], axis=1)
        return rectangle(at.point_m[:, :2], at.uphill, flat)

    index, at = _fitted(roofs, rows, u[:, 3:], outline)
    xy = outline(at, index)
    rise = ((xy - at.point_m[:, None, :2]) * at.uphill[:, None]).sum(axis=2) * at.slope[:, None]
    corner = np.concatenate([xy, (at.point_m[:, 2:3] + rise + 0.04)[..., None]], axis=2)
    things = _things(corner, [(0, 1, 2), (0, 2, 3)], at.row)
    lost = between(u[index, 2], *loss)
    return things._replace(loss=np.repeat(lost, 2).astype(np.float32))


def _shades(roofs: _Roofs, houses: Houses, share: float) -> Things:
    """Missing data: a triangle high above the roof that swallows pulses, as what stood in their way would."""
    rows, u = chosen(houses, SHADE, share)
    keep = roofs.offset[rows + 1] > roofs.offset[rows]
    rows, u = rows[keep], u[keep]
    at = _anchors(roofs, rows, u[:, :3])
    turn = 2 * np.pi * u[:, 3:4] + between(u[:, 4:5], 0.15, 0.5) * np.array([[-1.0, 1.0]])
    corner = np.repeat(at.point_m[:, None], 3, axis=1)
    corner[:, 1:, :2] += between(u[:, 5], 5, 15)[:, None, None] * np.stack(
        [np.cos(turn), np.sin(turn)], axis=2
    )
    corner[:, :, 2] += between(u[:, 6], 6, 14)[:, None]
    things = _things(corner, [(0, 1, 2)], at.row)
    return things._replace(loss=np.ones(len(things.loss), np.float32))


def _parapets(roofs: _Roofs, houses: Houses, share: float) -> Things:
    """A low wall along every edge of a flat roof."""
    rows, u = chosen(houses, PARAPET, share)
    sloped = np.concatenate([[0], np.cumsum((roofs.face & 3) == FaceKind.ROOF)])
    first, last = roofs.offset[rows], roofs.offset[rows + 1]
    flat = (last > first) & (sloped[last] == sloped[first])
    rows, high = rows[flat], between(u[flat, 0], 0.3, 1.0)
    start, end = edges(houses.polygons)
    offset = houses.polygons.vertex_offset
    lengths = np.diff(offset)[rows]
    edge = np.repeat(offset[rows] - np.cumsum(lengths) + lengths, lengths) + np.arange(lengths.sum())
    owner = np.repeat(np.arange(len(rows)), lengths)
    a, b = start[edge], end[edge]
    inwards = 0.25 * across((b - a) / np.maximum(np.linalg.norm(b - a, axis=1), 1e-9)[:, None])
    outline = np.stack([a, b, b + inwards, a + inwards], axis=1)
    low = houses.eave_z_m[rows][owner]
    things = _boxes(outline, low - 0.1, low + high[owner], rows[owner])
    return things._replace(thing=np.repeat(owner, len(_BOX)).astype(np.int32))


def _annexes(houses: Houses, share: float) -> Things:
    """Garages and sheds against a wall that the footprint leaves out, lower than the eaves."""
    rows, u = chosen(houses, ANNEX, share)
    edge, length, outwards = beside(houses, rows, u[:, 0])
    width = np.minimum(between(u[:, 1], 2.5, 6), length)
    depth = between(u[:, 2], 2, 6)
    along = across(outwards)
    middle = houses.polygons.xy_m[edge] + (0.5 * width + u[:, 3] * (length - width))[:, None] * along
    half = np.stack([width, depth], axis=1) / 2
    middle = middle + (half[:, 1] + 0.01)[:, None] * outwards
    high = houses.ground_z_m[rows] + between(u[:, 4], 2.2, 3.2)
    good = (length >= 2.5) & (high < houses.eave_z_m[rows] - 0.3)
    outline = rectangle(middle, along, half)
    shapes = shapely.polygons(rectangle(middle, along, np.maximum(half - 0.05, 0.1)))
    hit, _ = shapely.STRtree(to_geometries(houses.polygons)).query(shapes, predicate="intersects")
    good[hit] = False
    return _boxes(outline[good], houses.base_z_m[rows][good] - 1, high[good], rows[good])


def _trees(surface: Surface, houses: Houses, mean: float) -> Things:
    """Crowns of small random triangles, beside walls and over roofs; pulses pass between the leaves."""
    draws = uniforms(houses.key, TREE * 2**20, 1 + 8 * _MAX_TREES)
    # Poisson numbers by inversion
    term = np.exp(-mean) * np.cumprod(np.concatenate([[1.0], mean / np.arange(1, _MAX_TREES)]))
    number = np.searchsorted(np.cumsum(term), draws[:, 0])
    number[np.diff(houses.polygons.polygon_offset) == 0] = 0
    rows = np.repeat(np.arange(len(number)), number)
    which = np.arange(len(rows)) - np.repeat(np.cumsum(number) - number, number)
    u = draws[:, 1:].reshape(len(draws), _MAX_TREES, 8)[rows, which]
    edge, length, outwards = beside(houses, rows, u[:, 0])
    radius, height = between(u[:, 1], 1.2, 4.2), between(u[:, 2], 4, 14)
    radius = np.minimum(radius, 0.45 * height)
    away = between(u[:, 3], 0.5, 7)
    xy = (
        houses.polygons.xy_m[edge] + (u[:, 4] * length)[:, None] * across(outwards) + away[:, None] * outwards
    )
    hit, _ = shapely.STRtree(to_geometries(houses.polygons)).query(shapely.points(xy), predicate="intersects")
    free = np.ones(len(rows), bool)
    free[hit] = False
    foot = _ground(surface, xy, houses.ground_z_m[rows])
    crown = between(u[:, 5], 0.55, 0.85) * height  # its height
    middle = np.column_stack([xy, foot + height - crown / 2])
    # foliage over a square metre of ground: 1 lets a third of the pulses through, 3 one in twenty
    leaf_area = np.pi * radius**2 * between(u[:, 6], 1.0, 3.0)
    leaves = np.minimum(np.ceil(leaf_area / (0.5 * _LEAF_AREA_M2)), _MOST_LEAVES).astype(np.int64) // 2 + 1
    leaves[~free] = 0
    keys = houses.key[rows] + np.uint64(1) + which.astype(np.uint64)
    tree = np.repeat(np.arange(len(rows)), leaves)
    v = _leaf_draws(keys, leaves)
    ball = _ball(v[:, 0], v[:, 1], v[:, 2])
    half = np.column_stack([radius, radius, crown / 2])[tree]
    # the mean area of a triangle with corners in a ball of radius 1 is 0.47
    size = np.sqrt(_LEAF_AREA_M2 / 0.47)
    corner = (middle[tree] + ball * half)[:, None] + size * np.stack(
        [_ball(v[:, i], v[:, i + 1], v[:, i + 2]) for i in (3, 6, 9)], axis=1
    )
    return Things(corner, rows[tree].astype(np.int32), tree.astype(np.int32), np.zeros(len(tree), np.float32))


def _leaf_draws(keys: np.ndarray, leaves: np.ndarray) -> np.ndarray:
    """Twelve uniform draws per leaf, the leaves of one tree after the other."""
    most = int(leaves.max(initial=0))
    parts = [uniforms(keys[i : i + 1], 2**40, 12 * int(n)).reshape(-1, 12) for i, n in enumerate(leaves) if n]
    return np.concatenate(parts) if most else np.zeros((0, 12))


def _ball(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Points in the unit ball, uniform, float64 (n, 3)."""
    z, turn, radius = 2 * u - 1, 2 * np.pi * v, np.cbrt(w)
    flat = np.sqrt(1 - z * z)
    return radius[:, None] * np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])


def _ground(surface: Surface, xy: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Terrain height of the nearest cell, or ``otherwise`` where there is none."""
    grid = surface.terrain
    rows, columns = grid.height_m.shape
    column = np.rint((xy[:, 0] - grid.x_min_m) / grid.cell_m).astype(int)
    row = np.rint((grid.y_max_m - xy[:, 1]) / grid.cell_m).astype(int)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    height = np.where(inside, grid.height_m[np.where(inside, row, 0), np.where(inside, column, 0)], np.nan)
    return np.where(np.isfinite(height), height, otherwise)
