"""The characteristic lines of a solid: where two faces of different planes meet."""

from __future__ import annotations

from enum import IntEnum

from p2wss.skeleton.compiled import inner
from p2wss.skeleton.faces import flat_label, ground_label
from p2wss.skeleton.records import NUM_CAPS


class LineKind(IntEnum):
    """What a line of a solid is."""

    EAVE = 0  # horizontal: a roof, or a flat piece, and the wall below it
    VERGE = 1  # inclined: a roof and the wall beside it
    RIDGE = 2  # horizontal: two roof faces that both fall away from it, or a roof and a cap
    HIP = 3  # inclined: two roof faces that both fall away from it
    VALLEY = 4  # two roof faces that both rise from it
    ABUTMENT = 5  # a roof and a wall that rises from it


_EAVE, _VERGE, _RIDGE, _HIP, _VALLEY, _ABUTMENT = (int(kind) for kind in LineKind)
_LEVEL_M = 1e-6


@inner
def _triangle_normal(vertex, triangle, t):
    a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
    px, py, pz = vertex[b, 0] - vertex[a, 0], vertex[b, 1] - vertex[a, 1], vertex[b, 2] - vertex[a, 2]
    qx, qy, qz = vertex[c, 0] - vertex[a, 0], vertex[c, 1] - vertex[a, 1], vertex[c, 2] - vertex[a, 2]
    return py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx


@inner
def solid_lines(
    num_edges, counts, vertex, triangle, label, num_triangles, twin, line_vertex, line_kind, start
):
    """Append the lines of a solid from row ``start`` on. Returns the row after the last, -1 if full."""
    first_wall = num_edges + counts[NUM_CAPS]
    flat, ground = flat_label(num_edges, counts), ground_label(num_edges, counts)
    row = start
    for h in range(3 * num_triangles):
        other = twin[h]
        one, two = label[h // 3], label[other // 3]
        if other < h or one in (two, ground) or two == ground:
            continue
        wall_one = first_wall <= one < flat
        wall_two = first_wall <= two < flat
        if wall_one and wall_two:
            continue  # a corner of the walls
        a, b = triangle[h // 3, h % 3], triangle[h // 3, (h + 1) % 3]
        nx, ny, nz = _triangle_normal(vertex, triangle, h // 3)
        mx, my, mz = _triangle_normal(vertex, triangle, other // 3)
        dx, dy, dz = vertex[b, 0] - vertex[a, 0], vertex[b, 1] - vertex[a, 1], vertex[b, 2] - vertex[a, 2]
        bend = (ny * mz - nz * my) * dx + (nz * mx - nx * mz) * dy + (nx * my - ny * mx) * dz
        level = abs(dz) < _LEVEL_M
        if wall_one or wall_two:
            kind = _ABUTMENT if bend < 0.0 else _EAVE if level else _VERGE
        elif bend < 0.0:
            kind = _VALLEY
        else:
            kind = _RIDGE if level else _HIP
        if row >= len(line_kind):
            return -1
        line_vertex[row, 0] = a
        line_vertex[row, 1] = b
        line_kind[row] = kind
        row += 1
    return row
