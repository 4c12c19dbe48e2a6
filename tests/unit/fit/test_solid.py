"""Solids: vertices within straight edges are removed, whatever the faces beside them look like."""

from __future__ import annotations

import numpy as np

from p2wss.fit.planes import face_planes, neighbours, planes_at
from p2wss.fit.solid import Mesh, collapse_vertices, is_closed, is_sound


def volume_m3(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertex_m[mesh.triangle], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


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
    mesh = Mesh(vertex_m, triangle, *face_planes(vertex_m, triangle, neighbours(triangle)))
    assert is_closed(vertex_m, triangle)
    assert not is_sound(mesh)

    result = collapse_vertices(mesh)

    assert len(result.vertex_m) == 10
    assert (planes_at(result.triangle, result.plane, 10) >= 3).all()
    assert is_closed(result.vertex_m, result.triangle)
    assert is_sound(result)
    np.testing.assert_allclose(volume_m3(result), volume_m3(mesh))
