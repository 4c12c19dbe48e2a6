"""Clutter: what stands on, at and over buildings and is in no label (named as missing in section 6 of the paper).

Dormers, chimneys, annexes and trees are more triangles for the caster. Walls set back under the eaves change the
triangles of the building itself. All of it changes the point cloud only, not the label. Each building draws from its
own key, so it has the same clutter in every tile that contains it; only what would stand inside a neighbour is omitted.
"""

import numpy as np

from p2wss.config import Clutter
from p2wss.scans.clutter import beside_walls, on_roofs
from p2wss.scans.clutter.buildings import ClutterTriangles, LocalBuildings
from p2wss.scans.clutter.eaves import set_walls_back
from p2wss.scans.surface import (
    CLUTTER_REFLECTANCE,
    TREE_REFLECTANCE,
    ClutterKind,
    Surface,
)


def add_clutter(
    surface: Surface, buildings: LocalBuildings, settings: Clutter
) -> tuple[Surface, dict[str, int]]:
    """``surface`` with the clutter of ``buildings``, and the number of clutter objects of each kind.

    Points on clutter have a face id of kind 0, see :class:`~p2wss.scans.surface.ClutterKind`, so they count neither as
    roof nor as wall; trees belong to no building (-1).
    """
    surface, num_set_back = set_walls_back(
        surface, buildings, settings.eave_overhang_share, settings.eave_overhang_m
    )
    roofs = on_roofs.roofs_of(surface, len(buildings.key))
    triangles = {
        ClutterKind.DORMER: on_roofs.dormers(roofs, buildings, settings.dormer_share),
        ClutterKind.CHIMNEY: on_roofs.chimneys(roofs, buildings, settings.chimney_share),
        ClutterKind.ANNEX: beside_walls.annexes(buildings, settings.annex_share),
        ClutterKind.TREE: beside_walls.trees(surface.terrain, buildings, settings.trees_per_building),
    }
    counts = {"eave_overhang": num_set_back}
    for kind, triangles_of_kind in triangles.items():
        counts[kind.name.lower()] = len(np.unique(triangles_of_kind.number))
        surface = _with_triangles(surface, kind, triangles_of_kind)
    return surface, counts


def _with_triangles(surface: Surface, kind: ClutterKind, triangles: ClutterTriangles) -> Surface:
    """``surface`` with the triangles of all clutter objects of one kind."""
    count, is_tree = len(triangles.number), kind == ClutterKind.TREE
    corner = np.arange(3 * count, dtype=np.int32).reshape(-1, 3) + np.int32(len(surface.vertex_m))
    building = np.full(count, -1, np.int32) if is_tree else triangles.building
    reflectance = np.full(count, TREE_REFLECTANCE if is_tree else CLUTTER_REFLECTANCE, np.float32)
    return surface._replace(
        vertex_m=np.concatenate([surface.vertex_m, triangles.vertex_m.reshape(-1, 3)]),
        triangle=np.concatenate([surface.triangle, corner]),
        building=np.concatenate([surface.building, building]),
        face=np.concatenate([surface.face, np.full(count, 4 * kind, np.int32)]),
        reflectance=np.concatenate([surface.reflectance, reflectance]),
        loss=np.concatenate([surface.loss, np.zeros(count, np.float32)]),
    )
