"""Make nearly parallel edges of a footprint exactly parallel, and nearly collinear ones exactly collinear.

Where two parallel edges of different speeds become neighbours on the wavefront, a rule says which of them
continues. Where they are parallel but for a millimetre, the millimetre would decide instead, and with it the
shape of a large part of the roof. See :func:`p2wss.skeleton.clean`.
"""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import ZERO, inner

# The line of an edge: a point on it, its direction, and whether it is still the original one (`is_original`).
LINE = np.dtype(
    [("x", "f8"), ("y", "f8"), ("dir_x", "f8"), ("dir_y", "f8"), ("group", "i8"), ("is_original", "i8")],
    align=True,
)
_UNMOVED_M = 1e-9


@inner
def _set_original_line(edge, i, line):
    line[i].x = edge[i].x + 0.5 * edge[i].length * edge[i].dir_x
    line[i].y = edge[i].y + 0.5 * edge[i].length * edge[i].dir_y
    line[i].dir_x, line[i].dir_y = edge[i].dir_x, edge[i].dir_y
    line[i].is_original = 1


@inner
def _longest(edge, num_edges, line, group):
    """The longest edge of a group, or -1 if the group is empty."""
    best, length = ZERO - 1, 0.0
    for i in range(num_edges):
        if line[i].group == group and edge[i].length > length:
            best, length = i, edge[i].length
    return best


@inner
def _turn_to_common_directions(edge, num_edges, line, max_sine, max_shift):
    """Turn the edges of each group of nearly parallel ones about their middles to the group's mean direction."""
    for i in range(num_edges):
        _set_original_line(edge, i, line)
        line[i].group = -1
    for group in range(num_edges):
        seed = _longest(edge, num_edges, line, ZERO - 1)
        if seed < 0:
            break
        sum_x, sum_y, size = 0.0, 0.0, 0
        for i in range(num_edges):
            sine = abs(edge[seed].dir_x * edge[i].dir_y - edge[seed].dir_y * edge[i].dir_x)
            if line[i].group >= 0 or sine > max_sine or 0.5 * sine * edge[i].length > max_shift:
                continue
            along = edge[seed].dir_x * edge[i].dir_x + edge[seed].dir_y * edge[i].dir_y
            # the longer an edge, the less a given shift of its ends turns it
            weight = edge[i].length ** 2 * (1.0 if along > 0.0 else -1.0)
            sum_x += weight * edge[i].dir_x
            sum_y += weight * edge[i].dir_y
            line[i].group = group
            size += 1
        if size < 2:
            continue
        norm = np.hypot(sum_x, sum_y)
        for i in range(num_edges):
            if line[i].group == group:
                along = sum_x * edge[i].dir_x + sum_y * edge[i].dir_y
                line[i].dir_x = sum_x / norm if along > 0.0 else -sum_x / norm
                line[i].dir_y = sum_y / norm if along > 0.0 else -sum_y / norm
                line[i].is_original = 0


@inner
def _move_to_common_lines(edge, num_edges, line, max_offset):
    """Move lines of one direction that are at most ``max_offset`` apart to their mean."""
    for i in range(num_edges):
        line[i].group = -2 if line[i].is_original == 1 else -1
    for group in range(num_edges):
        seed = _longest(edge, num_edges, line, ZERO - 1)
        if seed < 0:
            break
        dir_x, dir_y = line[seed].dir_x, line[seed].dir_y
        total, length = 0.0, 0.0
        for i in range(num_edges):
            if line[i].group != -1 or line[i].dir_x != dir_x or line[i].dir_y != dir_y:
                continue
            offset = (line[i].y - line[seed].y) * dir_x - (line[i].x - line[seed].x) * dir_y
            if abs(offset) <= max_offset:
                line[i].group = group
                total += offset * edge[i].length
                length += edge[i].length
        at_x, at_y = line[seed].x - total / length * dir_y, line[seed].y + total / length * dir_x
        for i in range(num_edges):
            if line[i].group == group:
                along = (line[i].x - at_x) * dir_x + (line[i].y - at_y) * dir_y
                line[i].x, line[i].y = at_x + along * dir_x, at_y + along * dir_y


@inner
def _corners(edge, num_edges, line, max_shift, corner):
    """Compute the corners, where the lines meet. A line that moves a corner too far becomes the original one
    again; the result is then False, and the corners must be computed again."""
    settled = True
    for i in range(num_edges):
        h = edge[i].prev
        corner[i, 0], corner[i, 1] = edge[i].x, edge[i].y
        if line[h].is_original == 1 and line[i].is_original == 1:
            continue
        cross = line[h].dir_x * line[i].dir_y - line[h].dir_y * line[i].dir_x
        gap_x, gap_y = line[i].x - line[h].x, line[i].y - line[h].y
        along = (gap_x * line[i].dir_y - gap_y * line[i].dir_x) / cross
        x, y = line[h].x + along * line[h].dir_x, line[h].y + along * line[h].dir_y
        shift = np.hypot(x - edge[i].x, y - edge[i].y)
        if not shift <= max_shift:
            _set_original_line(edge, h, line)
            _set_original_line(edge, i, line)
            settled = False
        elif shift > _UNMOVED_M:
            corner[i, 0], corner[i, 1] = x, y
    return settled


@inner
def straighten(edge, num_edges, max_sine, max_shift, max_offset, line, corner):
    """Fill ``corner`` (num_edges, 2) with the straightened footprint, in the frame of ``edge``.

    edge: EDGE records filled by ``load_footprint``. No corner moves by more than ``max_shift`` metres.
    Returns False if nothing may change.
    """
    _turn_to_common_directions(edge, num_edges, line, max_sine, max_shift)
    _move_to_common_lines(edge, num_edges, line, max_offset)
    for _ in range(num_edges + 1):
        if _corners(edge, num_edges, line, max_shift, corner):
            break
    for i in range(num_edges):
        j = edge[i].next
        along = (corner[j, 0] - corner[i, 0]) * edge[i].dir_x + (corner[j, 1] - corner[i, 1]) * edge[i].dir_y
        if not along > 0.5 * edge[i].length:
            return False
    return True
