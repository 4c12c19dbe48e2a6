"""Skins that end on the terrain, and terrain without a surface below them: together one closed surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial import cKDTree

from p2wss.mesh import Mesh
from p2wss.mesh.topology import border_rings, doubled_plan_areas, groups
from p2wss.reconstruct.skin import Skin
from p2wss.reconstruct.skin.noding import Edge, ring_edges, split_edges
from p2wss.reconstruct.skin.solids import TOLERANCE_M, Face, faces_of, tidy
from p2wss.reconstruct.skin.triangles import delaunay, numbered, triangulated
from p2wss.skeleton.types import FaceKind

# everything but the floor must be this far above the terrain, or the building is buried and stays a solid
_CLEAR_M = 0.05
# area of triangles that have none
_NO_AREA_M2 = 1e-9


@dataclass(frozen=True)
class _Body:
    """A skin as polygons. outline: the rings around its floor, vertices of the skin, clockwise seen from above."""

    skin: Skin
    faces: list[Face]
    outline: list[list[int]]


def cut(skin_list: Sequence[Skin], terrain: Mesh) -> tuple[list[Skin], Mesh]:
    """The skins without floors, their walls down to the terrain, and the terrain with a hole below each.

    The lower edges of the walls are edges of the terrain, with bit-identical vertices. A skin that could not be
    joined, or part of which is buried, stays a solid, and so does the terrain around it. skin_list: skins whose floors
    are level, each, and below the terrain. terrain: a closed block.
    """
    origin = np.floor(terrain.vertex_m.min(axis=0))
    ground = terrain.vertex_m - origin
    triangle = np.asarray(terrain.triangle, int)
    upwards = doubled_plan_areas(ground[triangle][:, :, :2]) > 2 * _NO_AREA_M2
    top = triangle[upwards]
    bodies = {
        number: _body(replace(skin, mesh=skin.mesh.translated(-origin)))
        for number, skin in enumerate(skin_list)
        if skin.failure is None
    }
    bodies = {number: body for number, body in bodies.items() if not _is_buried(body, ground, top)}

    # common points: those of the terrain, of the outlines, and where these meet
    first, point = {}, ground
    for number, body in bodies.items():
        first[number] = len(point)
        point = np.vstack([point, body.skin.mesh.vertex_m])
    outlines = {
        number: [[v + first[number] for v in ring] for ring in body.outline]
        for number, body in bodies.items()
    }
    on_outline = np.unique([v for rings in outlines.values() for ring in rings for v in ring]).astype(int)
    same = _places(point, np.unique(top), on_outline)
    top = same[top]
    outlines = {
        number: [tidied for ring in rings if (tidied := tidy(same[ring].tolist()))]
        for number, rings in outlines.items()
    }
    flat = point * (1, 1, 0)
    touched = _touched(flat, top, outlines)
    edges = {edge for ring in top[touched].tolist() for edge in ring_edges(ring)}
    edges |= {edge for rings in outlines.values() for ring in rings for edge in ring_edges(ring)}
    split, flat = split_edges(flat, {edge: {0} for edge in edges})
    untouched = top[~touched][~_inside(flat[top[~touched]].mean(axis=1), flat, outlines)]
    pieces = _pieces(flat, edges, split, top[touched], outlines)

    height = np.append(point[:, 2], np.zeros(len(flat) - len(point)))
    new = np.concatenate([on_outline, np.arange(len(point), len(flat))])
    height[new] = _heights(flat[new, :2], ground, triangle[upwards])
    place = np.column_stack([flat[:, :2], height]) + origin
    place[: len(ground)] = terrain.vertex_m
    result = list(skin_list)
    for number, body in bodies.items():
        result[number] = _standing(body, skin_list[number], same, first[number], split, place, origin)
    whole = np.concatenate([untouched, pieces, triangle[~upwards]])
    kind, label = np.full(len(whole), terrain.kind[0], np.uint8), np.zeros(len(whole), np.int32)
    with_holes = Mesh(place, whole.astype(np.int32), kind, label)
    return result, with_holes.part(np.arange(len(whole)))


def _body(skin: Skin) -> _Body:
    mesh = skin.mesh
    building_of = dict(zip(mesh.label.tolist(), skin.building.tolist(), strict=True))
    faces = [replace(face, building=building_of[face.label]) for face in faces_of([mesh])[1]]
    outline = border_rings(mesh.triangle[mesh.kind == FaceKind.GROUND])
    return _Body(skin, faces, outline)


def _is_buried(body: _Body, ground: np.ndarray, top: np.ndarray) -> bool:
    """Whether a vertex besides those of the floor is below the terrain or hardly above it, or beyond its border."""
    mesh = body.skin.mesh
    floor = np.unique(mesh.triangle[mesh.kind == FaceKind.GROUND])
    vertex = mesh.vertex_m[np.setdiff1d(np.arange(len(mesh.vertex_m)), floor)]
    return not (vertex[:, 2] > _heights(vertex[:, :2], ground, top) + _CLEAR_M).all()


def _heights(xy_m: np.ndarray, ground: np.ndarray, top: np.ndarray) -> np.ndarray:
    """Heights of the terrain at places (n, 2), NaN outside."""
    corner = ground[top]
    trees = shapely.STRtree(shapely.polygons(corner[:, :, :2]))
    at, t = trees.query(shapely.points(xy_m), predicate="dwithin", distance=1e-6)
    result = np.full(len(xy_m), np.nan)
    a, b, c = (corner[t, k] for k in range(3))
    place = xy_m[at]
    area = doubled_plan_areas(corner[t][:, :, :2])
    u = doubled_plan_areas(np.stack([place, b[:, :2], c[:, :2]], axis=1)) / area
    v = doubled_plan_areas(np.stack([a[:, :2], place, c[:, :2]], axis=1)) / area
    result[at] = u * a[:, 2] + v * b[:, 2] + (1 - u - v) * c[:, 2]
    return result


def _places(point: np.ndarray, on_top: np.ndarray, on_outline: np.ndarray) -> np.ndarray:
    """int (p,): for every point the one that stands for it; those of outlines for those of the terrain."""
    candidates = np.concatenate([on_outline, on_top])
    pairs = cKDTree(point[candidates, :2]).query_pairs(TOLERANCE_M, output_type="ndarray")
    cluster = groups(len(candidates), pairs)
    _, first = np.unique(cluster, return_index=True)
    same = np.arange(len(point))
    same[candidates] = candidates[first[cluster]]
    return same


def _touched(flat: np.ndarray, top: np.ndarray, outlines: dict[int, list[list[int]]]) -> np.ndarray:
    """Which triangles an outline runs through or along, bool (t,)."""
    lines = np.array([shapely.LinearRing(flat[ring, :2]) for rings in outlines.values() for ring in rings])
    mask = np.zeros(len(top), bool)
    if len(lines):
        tree = shapely.STRtree(shapely.polygons(flat[top][:, :, :2]))
        mask[tree.query(lines, predicate="dwithin", distance=2 * TOLERANCE_M)[1]] = True
    return mask


def _inside(place: np.ndarray, flat: np.ndarray, outlines: dict[int, list[list[int]]]) -> np.ndarray:
    """Which places (n, 2 or 3) are inside a footprint, bool (n,): within an odd number of the rings of an outline."""
    mask = np.zeros(len(place), bool)
    tree = shapely.STRtree(np.asarray(shapely.points(place[:, :2]), object))
    for rings in outlines.values():
        odd = np.zeros(len(place), bool)
        for ring in rings:
            odd[tree.query(shapely.Polygon(flat[ring, :2]), predicate="contains")] ^= True
        mask |= odd
    return mask


def _pieces(
    flat: np.ndarray,
    edges: set[Edge],
    split: dict[Edge, list[int]],
    top: np.ndarray,
    outlines: dict[int, list[list[int]]],
) -> np.ndarray:
    """Triangles of the part of ``top`` outside the footprints, int (t, 3)."""
    sides = {
        (a, b) if a < b else (b, a)
        for edge in edges
        for a, b in zip(split.get(edge, edge), split.get(edge, edge)[1:], strict=False)
    }
    if not sides or not len(top):
        return np.zeros((0, 3), int)
    number = np.array(sorted(sides))
    cells = shapely.get_parts(shapely.polygonize(shapely.linestrings(flat[number][:, :, :2])))
    middle = shapely.get_coordinates(shapely.point_on_surface(cells))
    of_top = np.zeros(len(cells), bool)
    tree = shapely.STRtree(shapely.polygons(flat[top][:, :, :2]))
    of_top[tree.query(shapely.points(middle), predicate="intersects")[0]] = True
    cells = cells[of_top & ~_inside(middle, flat, outlines)]
    of_place = {tuple(flat[v, :2].tolist()): v for v in np.unique(number).tolist()}
    return numbered(np.concatenate([np.zeros((0, 3, 2)), *delaunay(cells)]), of_place)


def _standing(
    body: _Body,
    skin: Skin,
    same: np.ndarray,
    first: int,
    split: dict[Edge, list[int]],
    place: np.ndarray,
    origin: np.ndarray,
) -> Skin:
    """The skin without its floor, whose walls end in the points ``place`` of the terrain."""
    vertex = [*skin.mesh.vertex_m]
    chains: dict[tuple[int, int], list[int]] = {}
    for ring in body.outline:
        for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
            start, end = int(same[a + first]), int(same[b + first])
            line = split.get((start, end) if start < end else (end, start), [start, end])
            between = line[1:-1] if line[0] == start else line[-2:0:-1]
            # a wall runs along its lower edge the other way than the floor does
            chains[b, a] = [b, *range(len(vertex), len(vertex) + len(between))]
            vertex += list(place[between[::-1]])
            vertex[a], vertex[b] = place[start], place[end]
    faces = []
    for face in body.faces:
        if face.kind == FaceKind.GROUND:
            continue
        rings = [
            [v for a, b in zip(ring, [*ring[1:], ring[0]], strict=True) for v in chains.get((a, b), [a])]
            for ring in face.rings
        ]
        changed = any(
            (a, b) in chains for ring in face.rings for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)
        )
        faces.append(replace(face, rings=rings, triangles=None if changed else face.triangles))
    position = np.array(vertex)
    mesh, building = triangulated(position - origin, faces)
    return replace(skin, mesh=mesh.moved(position).part(np.arange(len(building))), building=building)
