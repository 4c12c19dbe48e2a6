"""Solids for tests of skins, and what must hold for every skin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import manifold3d
import numpy as np
import shapely

from p2wss import skeleton
from p2wss.mesh import Mesh
from p2wss.reconstruction.skin import Skin
from p2wss.skeleton import Polygons


class Solid(NamedTuple):
    """A building and its mesh: a list of these is the argument of ``skins``, as a dictionary."""

    building_id: str
    mesh: Mesh


def solid(
    name: str,
    polygon: shapely.Polygon,
    eave_m: float,
    angle_deg: float | Sequence[float] = 0.0,
    ground_z_m: float = 0.0,
) -> Solid:
    """The kernel's solid over a polygon, one angle for all edges or one per edge."""
    polygon = shapely.orient_polygons(polygon)
    rings = [shapely.get_coordinates(ring)[:-1] for ring in shapely.get_rings(polygon)]
    count = sum(map(len, rings))
    angles = np.broadcast_to(np.asarray(angle_deg, float), count)
    meshes = skeleton.build(Polygons.from_rings([rings]), np.array(angles), np.array([eave_m]))
    assert meshes.status[0] == skeleton.Status.OK
    return Solid(name, Mesh.of_kernel(meshes, 0).translated([0, 0, ground_z_m]))


def gable(name: str, box: tuple[float, float, float, float], eave_m: float, pitch_deg: float) -> Solid:
    """A house over a box with its ridge along y: gables stand at the sides of least and greatest y."""
    x0, y0, x1, y1 = box
    polygon = shapely.Polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    return solid(name, polygon, eave_m, [90, pitch_deg, 90, pitch_deg])


def volume(vertex_m: np.ndarray, triangle: np.ndarray) -> float:
    corner = (vertex_m - vertex_m.mean(axis=0))[triangle]
    return float(np.einsum("ti,ti->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6)


def united(solids: Sequence[Solid]) -> manifold3d.Manifold:
    """The union as an independent library computes it."""
    return manifold3d.Manifold.batch_boolean(
        [
            manifold3d.Manifold(manifold3d.Mesh64(s.mesh.vertex_m, s.mesh.triangle.astype(np.uint64)))
            for s in solids
        ],
        manifold3d.OpType.Add,
    )


def assert_closed(skin: Skin) -> None:
    """Every edge has exactly two triangles, in opposite directions, and every vertex one fan of triangles."""
    following: dict[int, dict[int, int]] = {}
    for a, b, c in skin.mesh.triangle.tolist():
        for here, ahead, behind in ((a, b, c), (b, c, a), (c, a, b)):
            around = following.setdefault(here, {})
            assert ahead not in around, "an edge with two triangles on one side"
            around[ahead] = behind
    assert sorted(following) == list(range(len(skin.mesh.vertex_m)))
    for around in following.values():
        start = next(iter(around))
        vertex, steps = around[start], 1
        while vertex != start:
            vertex, steps = around[vertex], steps + 1
        assert steps == len(around), "a vertex with two fans"
    corner = skin.mesh.vertex_m[skin.mesh.triangle]
    doubled = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    assert (doubled > 1e-9).all(), "a triangle without area"
    assert volume(skin.mesh.vertex_m, skin.mesh.triangle) > 0
    assert len(skin.mesh.triangle) == len(skin.mesh.kind) == len(skin.mesh.label) == len(skin.building)
