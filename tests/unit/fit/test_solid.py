"""Solids: vertices within straight edges are removed, whatever the faces beside them look like."""

from __future__ import annotations

import numpy as np
from drawn_towns.planes import mesh_of

from p2wss.config import Reconstruct
from p2wss.data.building import Building
from p2wss.fit.parametric import build_meshes
from p2wss.mesh import Mesh
from p2wss.mesh.planar import with_faces_divided
from p2wss.mesh.rules import crosses_itself


def is_sound(mesh: Mesh) -> bool:
    """Whether a mesh stays closed in programs that round coordinates and triangulate faces again."""
    is_short = mesh.edge_m.min() < 1e-2
    return (
        not is_short and (mesh.num_planes_at >= 3).all() and not crosses_itself(mesh.vertex_m, mesh.triangle)
    )


def volume_m3(mesh: Mesh) -> float:
    return mesh.volume_m3


def test_a_straight_vertex_goes_where_neither_end_sees_the_whole_face() -> None:
    # the footprint is a W; vertex 10 divides its straight side, and all of the floor meets there
    corner_m = np.array([[0, 0], [10, 0], [8, 3], [5, 0.5], [2, 3]], float)
    vertex_m = np.vstack(
        [np.column_stack([corner_m, np.full(5, z)]) for z in (0.0, 4.0)] + [np.array([[5.0, 0.0, 0.0]])]
    )
    floor = [[10, 0, 4], [10, 4, 3], [10, 3, 2], [10, 2, 1]]
    top = [[5, 8, 9], [5, 6, 8], [6, 7, 8]]
    side = [[0, 10, 5], [10, 6, 5], [10, 1, 6]]
    walls = [t for i in range(1, 5) for t in ([i, (i + 1) % 5, i + 5], [(i + 1) % 5, (i + 1) % 5 + 5, i + 5])]
    triangle = np.array(floor + top + side + walls, np.int32)
    mesh = mesh_of(vertex_m, triangle)
    assert mesh.is_closed
    assert not is_sound(mesh)

    result = with_faces_divided(mesh, mesh.num_planes_at != 2)

    assert len(result.vertex_m) == 10
    assert (result.num_planes_at >= 3).all()
    assert result.is_closed
    assert is_sound(result)
    np.testing.assert_allclose(volume_m3(result), volume_m3(mesh))


def test_a_hip_roof_of_the_kernel_is_sound() -> None:
    """Each of its walls is over the edge of the roof above it, but has a label of its own."""
    ring = np.array([[0, 0], [10, 0], [10, 7], [0, 7.0]])
    building = Building("b", "t", (0.0, 0.0), [ring], np.zeros((0, 3)), np.zeros(0, np.uint8), 0.0)
    (hip,) = build_meshes(
        [building],
        [[ring]],
        np.array([4.0]),
        [np.full(4, 40.0)],
        "fit",
        Reconstruct(),
        [""],
    )
    assert hip.mesh is not None
    assert len(np.unique(hip.mesh.label)) == 9
    assert is_sound(hip.mesh)
