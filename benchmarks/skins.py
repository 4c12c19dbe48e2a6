"""Whether the skins of blocks are closed, small and without false wedges: measures. Used by scene.py."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from figures import Figures, cpu_seconds

from p2wss.data.building import Reconstruction
from p2wss.mesh import Mesh
from p2wss.reconstruction.skin import Skin, skins
from p2wss.reconstruction.skin.block_skins import wedges

# radius of the circle on which the surroundings of a wedge are sampled, and number of directions
RADIUS_M, DIRECTIONS = 2e-3, 72
# a wedge is false if buildings cover this much more than its opening, in one piece of at least half a turn
MORE_DEG, FLAT_DEG = 10.0, 175.0


def solids_of(rows: Sequence[Reconstruction]) -> dict[str, Mesh]:
    """The meshes of the buildings that have one, in the CRS, by id."""
    return {row.building_id: row.placed_mesh for row in rows if row.has_mesh}


def measure_skins(rows: Sequence[Reconstruction], figures: Figures) -> None:
    """Closedness, triangles, slivers, false wedges and CPU time of the skins."""
    solids = solids_of(rows)
    skin_list = skins(solids)
    blocks = [skin for skin in skin_list if len(skin.building_ids) > 1]
    figures.row("skins", {"skins": len(skin_list), "blocks": len(blocks)})
    figures.at_most("skins: buildings not joined", sum(skin.failure is not None for skin in skin_list), 0)
    figures.at_most("skins: not closed and manifold", sum(not is_closed(skin) for skin in skin_list), 0)
    before = sum(len(solid.triangle) for solid in solids.values())
    figures.at_most("skins: triangles per triangle of the parts", count(skin_list) / before, 1.2)
    thin_before = sum(
        int((smallest_deg(solid.vertex_m, solid.triangle) < 1).sum()) for solid in solids.values()
    )
    thin = sum(int((smallest_deg(skin.mesh.vertex_m, skin.mesh.triangle) < 1).sum()) for skin in skin_list)
    # a step of centimetres between neighbours is a band of such triangles
    figures.row("triangles below 1 degree", {"of the parts": thin_before, "of the skins": thin})
    # the same count on separate buildings shows what it finds
    alone = [part for solid in solids.items() for part in skins(dict([solid]))]
    figures.row("false wedges", {"of the parts": false_wedges(alone)})
    figures.at_most("skins: false wedges", false_wedges(skin_list), 0)
    figures.row("wedges", {"of the parts": num_wedges(alone), "of the skins": num_wedges(skin_list)})
    figures.at_most("skins: seconds", cpu_seconds(lambda: skins(solids)), 2)


def count(skin_list: Sequence[Skin]) -> int:
    return sum(len(skin.mesh.triangle) for skin in skin_list)


def num_wedges(skin_list: Sequence[Skin]) -> int:
    return sum(len(wedges(skin).face) for skin in skin_list)


def is_closed(skin: Skin) -> bool:
    """Whether every edge has a triangle on each side, and the triangles at every vertex are one fan."""
    following: dict[int, dict[int, int]] = {}
    for a, b, c in skin.mesh.triangle.tolist():
        for here, ahead, behind in ((a, b, c), (b, c, a), (c, a, b)):
            if ahead in following.setdefault(here, {}):
                return False
            following[here][ahead] = behind
    for around in following.values():
        start = next(iter(around))
        vertex, steps = around[start], 1
        while vertex != start:
            if vertex not in around:
                return False
            vertex, steps = around[vertex], steps + 1
        if steps < len(around):
            return False
    return True


def smallest_deg(vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """The smallest angle of every triangle, (t,)."""
    corner = vertex_m[triangle]
    ahead, back = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    sine = np.linalg.norm(np.cross(ahead, back), axis=2)
    return np.degrees(np.arctan2(sine, (ahead * back).sum(axis=2))).min(axis=1)


def false_wedges(skin_list: Sequence[Skin]) -> int:
    """Number of convex edges that are not convex edges of the union of all skins.

    On a circle across the middle of each edge, the places inside any skin are counted by rays upwards. Two skins that
    touch there in the edge alone leave two pieces of the circle free.
    """
    number = 0
    height_of = _Heights(skin_list)
    turn = (np.arange(DIRECTIONS) + 0.37) / DIRECTIONS * 2 * np.pi
    for skin in skin_list:
        edges = wedges(skin)
        middle, along = edges.end_m.mean(axis=1), edges.end_m[:, 1] - edges.end_m[:, 0]
        long = np.linalg.norm(along, axis=1) > 4 * RADIUS_M
        middle, along = middle[long], along[long] / np.linalg.norm(along[long], axis=1)[:, None]
        helper = np.where(np.abs(along[:, [2]]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        u = np.cross(along, helper)
        u /= np.linalg.norm(u, axis=1)[:, None]
        v = np.cross(along, u)
        place = np.cos(turn)[None, :, None] * u[:, None] + np.sin(turn)[None, :, None] * v[:, None]
        place = middle[:, None] + RADIUS_M * place
        inside = height_of.inside(place.reshape(-1, 3)).reshape(-1, DIRECTIONS)
        inside_deg = 360 * inside.mean(axis=1)
        pieces = (inside & ~np.roll(inside, 1, axis=1)).sum(axis=1)
        larger = inside_deg > np.maximum(edges.opening_angle_deg[long] + MORE_DEG, FLAT_DEG)
        number += int((larger & (pieces <= 1)).sum())
    return number


class _Heights:
    """Tells which places are inside skins: above them are more surfaces that face up than surfaces that face down."""

    def __init__(self, skin_list: Sequence[Skin]) -> None:
        corner = np.concatenate([skin.mesh.vertex_m[skin.mesh.triangle] for skin in skin_list])
        self.origin = np.floor(corner.min(axis=(0, 1)))
        corner = corner - self.origin
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        level = np.abs(normal[:, 2]) > 1e-9
        self.corner, self.normal = corner[level], normal[level]
        self.tree = shapely.STRtree(shapely.polygons(self.corner[:, :, :2]))

    def inside(self, place_m: np.ndarray) -> np.ndarray:
        """bool (n,) for places (n, 3)."""
        place = place_m - self.origin
        point, triangle = self.tree.query(shapely.points(place[:, :2]), predicate="intersects")
        a, n = self.corner[triangle, 0], self.normal[triangle]
        height = a[:, 2] - ((place[point, :2] - a[:, :2]) * n[:, :2]).sum(axis=1) / n[:, 2]
        above = height > place[point, 2]
        winding = np.zeros(len(place))
        np.add.at(winding, point[above], np.sign(n[above, 2]))
        return winding > 0
