"""The characteristic lines of a solid: where two faces of different planes meet."""

from __future__ import annotations

from enum import IntEnum

from p2wss.skeleton.check import pair_half_edges
from p2wss.skeleton.compiled import entry, inner
from p2wss.skeleton.types import FaceKind


class LineKind(IntEnum):
    """What a line of a solid is."""

    EAVE = 0  # horizontal: a roof, or a flat piece, and the wall below it
    VERGE = 1  # inclined: a roof and the wall beside it
    RIDGE = 2  # horizontal: two roof faces that both fall away from it, or a roof and a cap
    HIP = 3  # inclined: two roof faces that both fall away from it
    VALLEY = 4  # two roof faces that both rise from it
    ABUTMENT = 5  # a roof and a wall that rises from it


_EAVE, _VERGE, _RIDGE, _HIP, _VALLEY, _ABUTMENT = (int(kind) for kind in LineKind)
_GROUND, _WALL = int(FaceKind.GROUND), int(FaceKind.WALL)
_LEVEL_M = 1e-6


@inner
def _triangle_normal(vertex, triangle, t):
    a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
    px, py, pz = vertex[b, 0] - vertex[a, 0], vertex[b, 1] - vertex[a, 1], vertex[b, 2] - vertex[a, 2]
    qx, qy, qz = vertex[c, 0] - vertex[a, 0], vertex[c, 1] - vertex[a, 1], vertex[c, 2] - vertex[a, 2]
    return py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx


@inner
def _solid_lines(vertex, triangle, kind, edge, twin, line_vertex, line_kind, row):
    """Lines of one solid from ``row`` on. Returns the row after the last."""
    for h in range(3 * len(triangle)):
        t, u = h // 3, twin[h] // 3
        if twin[h] < h or (kind[t] == kind[u] and edge[t] == edge[u]):
            continue
        if kind[t] == _GROUND or kind[u] == _GROUND or (kind[t] == _WALL and kind[u] == _WALL):
            continue
        a, b = triangle[t, h % 3], triangle[t, (h + 1) % 3]
        nx, ny, nz = _triangle_normal(vertex, triangle, t)
        mx, my, mz = _triangle_normal(vertex, triangle, u)
        dx, dy, dz = vertex[b, 0] - vertex[a, 0], vertex[b, 1] - vertex[a, 1], vertex[b, 2] - vertex[a, 2]
        bend = (ny * mz - nz * my) * dx + (nz * mx - nx * mz) * dy + (nx * my - ny * mx) * dz
        level = abs(dz) < _LEVEL_M
        if kind[t] == _WALL or kind[u] == _WALL:
            of_kind = _ABUTMENT if bend < 0.0 else _EAVE if level else _VERGE
        elif bend < 0.0:
            of_kind = _VALLEY
        else:
            of_kind = _RIDGE if level else _HIP
        line_vertex[row, 0], line_vertex[row, 1] = a, b
        line_kind[row] = of_kind
        row += 1
    return row


@entry
def find_lines(
    vertex, triangle, kind, edge, vertex_offset, triangle_offset, hash_key, hash_half, twin,
    line_vertex, line_kind, line_offset,
):  # fmt: skip
    """Lines of the meshes of a batch. ``line_vertex`` gets rows of ``vertex``."""
    for p in range(len(vertex_offset) - 1):
        a, b = triangle_offset[p], triangle_offset[p + 1]
        start, end = vertex_offset[p], vertex_offset[p + 1]
        first = line_offset[p]
        last = first
        if pair_half_edges(triangle[a:b], b - a, end - start, hash_key, hash_half, twin):
            last = _solid_lines(
                vertex[start:end], triangle[a:b], kind[a:b], edge[a:b], twin, line_vertex, line_kind, first
            )
        for row in range(first, last):
            line_vertex[row, 0] += start
            line_vertex[row, 1] += start
        line_offset[p + 1] = last
