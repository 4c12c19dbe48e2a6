"""Half-edges that run the other way, edges that can go, and thin triangles, against plain Python."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest

from p2wss.mesh import Mesh
from p2wss.mesh.shell_kernels import can_merge, thin_triangles
from p2wss.mesh.topology import reverses


@pytest.mark.parametrize(("num", "num_vertices"), [(0, 1), (1, 2), (300, 20), (2000, 100_000)])
def test_the_reverse_of_a_half_edge_is_the_first_one(num: int, num_vertices: int) -> None:
    start, end = np.random.default_rng(num).integers(0, num_vertices, (2, num))
    # half of them have one
    start[num // 2 :], end[num // 2 :] = end[: num - num // 2], start[: num - num // 2].copy()
    first: dict[tuple[int, int], int] = {}
    for k, edge in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        first.setdefault(edge, k)
    expected = [first.get(edge, -1) for edge in zip(end.tolist(), start.tolist(), strict=True)]
    assert reverses(start, end).tolist() == expected


def test_which_edges_can_go() -> None:
    """Of a fan of six around vertex 0, of a strip around a hole, and of two strips around a tube, whose edges between
    the strips have two triangles, but a third corner of the tube beside both ends."""
    fan = [(0, k, k % 6 + 1) for k in range(1, 7)]
    hole = [(1, 8, 2), (2, 8, 9), (2, 9, 3), (3, 9, 10), (3, 10, 1), (1, 10, 8)]
    tube = [*hole, (2, 5, 1), (6, 5, 2), (3, 6, 2), (7, 6, 3), (1, 7, 3), (5, 7, 1)]
    for triangles in (fan, hole, tube):
        beside = defaultdict[int, set[int]](set)
        for triangle in triangles:
            for vertex in triangle:
                beside[vertex] |= {*triangle} - {vertex}
        for end in beside:
            for gone in beside[end]:
                num_both = sum({end, gone} <= {*triangle} for triangle in triangles)
                expected = num_both == 2 and len(beside[end] & beside[gone]) == 2
                assert can_merge(np.array(triangles), 11, end, gone) == expected
    assert can_merge(np.array(fan), 11, 0, 1) and not can_merge(np.array(hole), 11, 1, 2)
    assert not can_merge(np.array(tube), 11, 1, 2)


def test_triangles_thinner_than_a_height() -> None:
    vertex_m = np.array([[0, 0, 0], [10, 0, 0], [4, 0, 2e-3], [4, 5e-4, 0]], float)
    triangle = np.array([[0, 1, 2], [0, 1, 3], [3, 1, 0]])
    mesh = Mesh(vertex_m, triangle, np.zeros(3, np.uint8), np.arange(3))
    assert thin_triangles(mesh.arrays).tolist() == [False, True, True]
