"""Make nearly parallel edges of neighbouring footprints exactly parallel and nearly collinear ones collinear, shared
edges once for both sides.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from p2wss.mesh.topology import groups

# two lines at a node that meet at a smaller angle do not fix its place
_MIN_SINE = 0.2


class Edges(NamedTuple):
    """The edges of polygons that share nodes. xy_m: places of the nodes (n, 2). segment: int64 (m, 2), nodes of each
    edge. polygon, of_segment: int64 (k,), polygon ``polygon[i]`` has the edge ``of_segment[i]``."""

    xy_m: np.ndarray
    segment: np.ndarray
    polygon: np.ndarray
    of_segment: np.ndarray

    @property
    def along_m(self) -> np.ndarray:
        """From one end to the other, (m, 2)."""
        return self.xy_m[self.segment[:, 1]] - self.xy_m[self.segment[:, 0]]

    @property
    def bearing(self) -> np.ndarray:
        """Radians, (m,)."""
        return np.arctan2(self.along_m[:, 1], self.along_m[:, 0])

    @property
    def length_m(self) -> np.ndarray:
        """(m,)."""
        return np.hypot(self.along_m[:, 0], self.along_m[:, 1])


def straightened(
    edges: Edges, max_sine: float, max_shift_m: float, max_offset_m: float, is_free: np.ndarray
) -> np.ndarray:
    """New places of the nodes (n, 2), none further than ``max_shift_m`` from the old one.

    max_sine: of the angle between edges that become parallel. max_offset_m: distance of parallel lines that become one.
    is_free: bool (m,), edges whose direction stays free.

    Edges of a polygon that are parallel to within ``max_sine``, as far as that moves their ends by at most
    ``max_shift_m``, form a group. Groups that share an edge, or whose edges continue each other at a node, are joined
    while that still holds for all their edges. Each group gets its mean direction, weighted by squared length, and each
    chain of edges of a group one line in that direction. A node goes to where its lines meet. An edge that cannot
    follow its line keeps both its ends where other lines leave them.
    """
    xy_m, segment, along_m, length_m = edges.xy_m, edges.segment, edges.along_m, edges.length_m
    group = _groups(edges, max_sine, max_shift_m)
    axis = (
        np.bincount(group, length_m**2 * np.cos(2 * edges.bearing)),
        np.bincount(group, length_m**2 * np.sin(2 * edges.bearing)),
    )
    direction = np.arctan2(axis[1], axis[0]) / 2
    follows = (np.bincount(group)[group] > 1) & ~is_free
    normal = np.column_stack([-np.sin(direction), np.cos(direction)])
    middle_offset = (normal[group] * (xy_m[segment[:, 0]] + along_m / 2)).sum(axis=1)
    while follows.any():
        edge = np.flatnonzero(follows)
        line = _lines(segment[edge], group[edge])
        total_m = np.bincount(line, length_m[edge])
        offset = np.bincount(line, length_m[edge] * middle_offset[edge]) / total_m
        group_of_line = np.zeros(len(total_m), np.int64)
        group_of_line[line] = group[edge]
        line, offset, total_m, group_of_line = _joined_lines(
            line, offset, total_m, group_of_line, max_offset_m
        )
        place_m, release = _places(
            edges, edge, line, _Lines(offset, total_m, normal[group_of_line]), max_shift_m
        )
        moved_m = place_m[segment[:, 1]] - place_m[segment[:, 0]]
        shrunk = ~((moved_m * along_m).sum(axis=1) > 0.5 * length_m**2)
        if shrunk.any():
            release = np.union1d(release, np.flatnonzero(np.isin(segment, segment[shrunk]).any(axis=1)))
        if not follows[release].any():
            return place_m
        follows[release] = False
    return xy_m


def _groups(edges: Edges, max_sine: float, max_shift_m: float) -> np.ndarray:
    """The group of each edge, int64 (m,)."""
    polygon, of_segment, bearing, length_m = edges.polygon, edges.of_segment, edges.bearing, edges.length_m
    group = np.full(len(polygon), -1)
    rest = np.lexsort((of_segment, -length_m[of_segment], polygon))
    num_groups = 0
    while len(rest):
        owners, first = np.unique(polygon[rest], return_index=True)
        owner = np.searchsorted(owners, polygon[rest])
        seed, edge = of_segment[rest[first]][owner], of_segment[rest]
        sine = np.abs(np.sin(bearing[edge] - bearing[seed]))
        fits = (sine <= max_sine) & (0.5 * sine * length_m[edge] <= max_shift_m)
        group[rest[fits]] = num_groups + owner[fits]
        num_groups += len(owners)
        rest = rest[~fits]
    by_group = np.argsort(group, kind="stable")
    members = np.split(of_segment[by_group], np.cumsum(np.bincount(group))[:-1])
    group = _joined_groups(edges, _links(edges, group, max_sine), members, max_sine, max_shift_m)[group]
    # an edge in two groups follows the one of more weight
    weight = np.zeros(num_groups)
    pairs = np.unique(np.column_stack([group, of_segment]), axis=0)
    np.add.at(weight, pairs[:, 0], length_m[pairs[:, 1]] ** 2)
    order = np.lexsort((-pairs[:, 0], weight[pairs[:, 0]], pairs[:, 1]))
    result = np.zeros(len(edges.segment), np.int64)
    result[pairs[order, 1]] = pairs[order, 0]
    return result


def _links(edges: Edges, group: np.ndarray, max_sine: float) -> list[tuple[int, int]]:
    """Pairs of groups that share an edge or continue each other at a node, those of the longest edges first."""
    segment, bearing, length_m = edges.segment, edges.bearing, edges.length_m
    links: list[tuple[float, int, int, int, int]] = []
    groups_of: dict[int, list[int]] = {}
    for edge, number in zip(edges.of_segment.tolist(), group.tolist(), strict=True):
        groups_of.setdefault(edge, []).append(number)
    for edge, numbers in groups_of.items():
        links += [(-length_m[edge], edge, edge, *pair) for pair in combinations(numbers, 2)]
    at_node = np.argsort(segment.ravel(), kind="stable")
    counts = np.bincount(segment.ravel(), minlength=len(edges.xy_m))
    starts = np.cumsum(counts) - counts
    for node in np.flatnonzero(counts > 2).tolist():
        half_edges = at_node[starts[node] : starts[node] + counts[node]].tolist()
        for a, b in combinations(half_edges, 2):
            e, f = a // 2, b // 2
            turn = bearing[f] - bearing[e] + np.pi * ((a & 1) == (b & 1))
            if abs(np.sin(turn)) <= max_sine and np.cos(turn) > 0:
                weight = -min(length_m[e], length_m[f])
                links += [(weight, e, f, g, h) for g in groups_of[e] for h in groups_of[f] if g != h]
    return [(g, h) for _, _, _, g, h in sorted(links)]


def _joined_groups(
    edges: Edges,
    links: list[tuple[int, int]],
    members: list[np.ndarray],
    max_sine: float,
    max_shift_m: float,
) -> np.ndarray:
    """The number of the group that each group has become part of. members: the edges of each group."""
    bearing, length_m = edges.bearing, edges.length_m
    root = np.arange(len(members))
    for g, h in links:
        while root[g] != g:
            g = int(root[g])
        while root[h] != h:
            h = int(root[h])
        if g == h:
            continue
        both = np.union1d(members[g], members[h])
        weight = length_m[both] ** 2
        direction = (
            np.arctan2((weight * np.sin(2 * bearing[both])).sum(), (weight * np.cos(2 * bearing[both])).sum())
            / 2
        )
        sine = np.abs(np.sin(bearing[both] - direction))
        if (sine > max_sine).any() or (0.5 * sine * length_m[both] > max_shift_m).any():
            continue
        root[max(g, h)] = min(g, h)
        members[min(g, h)] = both
    while (root[root] != root).any():
        root = root[root]
    return root


def _lines(segment: np.ndarray, group: np.ndarray) -> np.ndarray:
    """The number of the line of each edge: edges of a group that meet at a node are on one line."""
    count = len(segment)
    half_edges = np.column_stack([segment.ravel(), np.repeat(group, 2)])
    _, meeting = np.unique(half_edges, axis=0, return_inverse=True)
    meeting = meeting.reshape(-1)
    size = count + meeting.max() + 1
    label = groups(size, np.column_stack([np.repeat(np.arange(count), 2), count + meeting]))[:count]
    return np.unique(label, return_inverse=True)[1].reshape(-1)


def _joined_lines(
    line: np.ndarray, offset: np.ndarray, total_m: np.ndarray, group: np.ndarray, max_offset_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(line of each edge; offset, length and group of each line) with nearly collinear lines of a group joined."""
    order = np.lexsort((offset, group))
    number = np.zeros(len(order), np.int64)
    first = order[0]
    for previous, k in zip(order[:-1].tolist(), order[1:].tolist(), strict=True):
        if group[k] != group[first] or offset[k] - offset[first] > max_offset_m:
            first = k
            number[k] = number[previous] + 1
        else:
            number[k] = number[previous]
    sums = np.bincount(number, total_m)
    means = np.bincount(number, offset * total_m) / sums
    groups = np.zeros(len(sums), np.int64)
    groups[number] = group
    return number[line], means, sums, groups


class _Lines(NamedTuple):
    """Of each line: distance from the origin along the normal, length of its edges, normal."""

    offset: np.ndarray
    total_m: np.ndarray
    normal: np.ndarray


def _places(
    edges: Edges, edge: np.ndarray, line: np.ndarray, lines: _Lines, max_shift_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """(places of the nodes, edges that must not follow their lines). edge: those that follow ``line``."""
    xy_m, segment, (offset, total_m, normal) = edges.xy_m, edges.segment, lines
    half_edges = np.column_stack([segment[edge].ravel(), np.repeat(line, 2)])
    pairs, count = np.unique(half_edges, axis=0, return_counts=True)
    # at each node the lines that run through it come first, then the longer ones
    order = np.lexsort((pairs[:, 1], -total_m[pairs[:, 1]], -count, pairs[:, 0]))
    node, of_line = pairs[order].T
    starts = np.flatnonzero(np.diff(node, prepend=-1))
    rank = np.arange(len(node)) - np.repeat(starts, np.diff(np.append(starts, len(node))))
    first = np.full(len(xy_m), -1)
    second = first.copy()
    first[node[rank == 0]] = of_line[rank == 0]
    is_unused = rank > 0
    n_first = normal[first[node]]
    sine = np.abs(n_first[:, 0] * normal[of_line, 1] - n_first[:, 1] * normal[of_line, 0])
    steep = np.flatnonzero(is_unused & (sine >= _MIN_SINE))
    chosen, at = np.unique(node[steep], return_index=True)
    second[chosen] = of_line[steep[at]]
    is_unused[steep[at]] = False
    release = [_edges_at(segment, edge, line, node[is_unused], of_line[is_unused])]

    place_m = xy_m.copy()
    on_one, on_two = (first >= 0) & (second < 0), second >= 0
    gap = offset[first[on_one]] - (normal[first[on_one]] * xy_m[on_one]).sum(axis=1)
    place_m[on_one] += gap[:, None] * normal[first[on_one]]
    a, b = normal[first[on_two]], normal[second[on_two]]
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    u, v = offset[first[on_two]], offset[second[on_two]]
    place_m[on_two] = np.column_stack([u * b[:, 1] - v * a[:, 1], v * a[:, 0] - u * b[:, 0]]) / cross[:, None]
    shift_m = np.hypot(*(place_m - xy_m).T)
    if (shift_m > max_shift_m).any():
        worst = np.zeros(len(offset))
        np.maximum.at(worst, of_line, shift_m[node])
        too_far = (shift_m[node] > max_shift_m) & (shift_m[node] >= worst[of_line])
        bad = np.unique(node[too_far])
        gap_first = np.abs(offset[first[bad]] - (normal[first[bad]] * xy_m[bad]).sum(axis=1))
        gap_second = np.abs(offset[second[bad]] - (normal[second[bad]] * xy_m[bad]).sum(axis=1))
        farther = np.where((second[bad] >= 0) & (gap_second >= gap_first), second[bad], first[bad])
        release.append(_edges_at(segment, edge, line, bad, farther))
    return place_m, np.unique(np.concatenate(release))


def _edges_at(
    segment: np.ndarray, edge: np.ndarray, line: np.ndarray, node: np.ndarray, of_line: np.ndarray
) -> np.ndarray:
    """The edges of line ``of_line[k]`` that end at ``node[k]``, for any k."""
    size = int(line.max()) + 1
    keys = node * size + of_line
    ends_there = np.isin(segment[edge] * size + line[:, None], keys).any(axis=1)
    return edge[ends_there]
