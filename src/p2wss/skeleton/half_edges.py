"""From the arcs of the skeleton to the directed edges of the faces of a closed solid.

Every face is a collection of directed edges under one label. Edges that occur in both directions under one
label cancel, which is how coplanar neighbours merge: a gable triangle with the wall below it, the flat pieces
that 0 degree edges have swept, roof pieces that share a plane.
"""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import ZERO, inner
from p2wss.skeleton.records import (
    NUM_ARCS,
    NUM_NODES,
    MeshWork,
    SkeletonWork,
    flat_label,
    ground_label,
    num_labels,
    wall_label,
)
from p2wss.skeleton.status import OK, OVERFLOW

_WELD_M = 1e-5  # nodes nearer to each other than this are merged
_STRAIGHT_M = 1e-6  # a point nearer to a line than this lies on it
_PARALLEL = 1e-7


@inner
def _face_label(
    edge: np.ndarray, num_edges: int, cap_height: np.ndarray, counts: np.ndarray, face: int
) -> int:
    """The label of the face number of an arc: a vertical face has that of its wall; all faces at the eave have
    one label."""
    if face < num_edges:
        if edge[face].angle_deg == 0.0:
            return flat_label(num_edges, counts)
        if edge[face].angle_deg == 90.0:
            return wall_label(num_edges, counts, face)
        return face
    if cap_height[face - num_edges] <= _WELD_M:
        return flat_label(num_edges, counts)
    return face


@inner
def find(parent: np.ndarray, a: int) -> int:
    """The number that stands for all that a has been merged with."""
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@inner
def _weld(parent: np.ndarray, a: int, b: int, num_edges: int) -> None:
    """Merge two nodes. The footprint's corners keep their numbers and are not merged with each other."""
    a, b = find(parent, a), find(parent, b)
    if a > b:
        a, b = b, a
    if a != b and b >= num_edges:
        parent[b] = a


@inner
def _weld_nodes(
    num_edges: int,
    node: np.ndarray,
    arc: np.ndarray,
    counts: np.ndarray,
    parent: np.ndarray,
    weld_up_to: float,
) -> None:
    """Merge the ends of very short arcs, and nodes at one place up to the height ``weld_up_to``."""
    num_nodes = counts[NUM_NODES]
    for k in range(num_nodes):
        parent[k] = k
    for k in range(counts[NUM_ARCS]):
        a, b = arc[k].start, arc[k].end
        dx, dy, dz = node[a].x - node[b].x, node[a].y - node[b].y, node[a].z - node[b].z
        if dx * dx + dy * dy + dz * dz < _WELD_M * _WELD_M:
            _weld(parent, a, b, num_edges)
    for b in range(num_edges, num_nodes):
        if node[b].z > weld_up_to or parent[b] != b:
            continue
        for a in range(b):
            if (
                abs(node[a].x - node[b].x) < _WELD_M
                and abs(node[a].y - node[b].y) < _WELD_M
                and abs(node[a].z - node[b].z) < _WELD_M
            ):
                _weld(parent, a, b, num_edges)
                break


@inner
def _same_line(edge: np.ndarray, i: int, j: int) -> bool:
    if abs(edge[i].dir_x * edge[j].dir_y - edge[i].dir_y * edge[j].dir_x) > _PARALLEL:
        return False
    if edge[i].dir_x * edge[j].dir_x + edge[i].dir_y * edge[j].dir_y < 0.0:
        return False
    offset = (edge[j].x - edge[i].x) * edge[i].dir_y - (edge[j].y - edge[i].y) * edge[i].dir_x
    return abs(offset) < _STRAIGHT_M


@inner
def _join_coplanar_labels(
    edge: np.ndarray,
    num_edges: int,
    arc: np.ndarray,
    cap_height: np.ndarray,
    counts: np.ndarray,
    label_parent: np.ndarray,
) -> None:
    """Give neighbouring roof faces of one plane one label."""
    for k in range(num_labels(num_edges, counts)):
        label_parent[k] = k
    for k in range(counts[NUM_ARCS]):
        i, j = arc[k].left, arc[k].right
        if i >= num_edges or j >= num_edges or i == j:
            continue
        if edge[i].angle_deg == edge[j].angle_deg and edge[i].angle_deg > 0.0 and _same_line(edge, i, j):
            a = find(label_parent, _face_label(edge, num_edges, cap_height, counts, i))
            b = find(label_parent, _face_label(edge, num_edges, cap_height, counts, j))
            label_parent[max(a, b)] = min(a, b)


@inner
def _add(half: np.ndarray, label_head: np.ndarray, num_half: int, start: int, end: int, label: int) -> int:
    half[num_half].start = start
    half[num_half].end = end
    half[num_half].label = label
    half[num_half].alive = 1
    half[num_half].next_in_label = label_head[label]
    label_head[label] = num_half
    return num_half + 1


@inner
def _add_subdivided(
    node: np.ndarray, mesh_work: MeshWork, num_half: int, start: int, end: int, label: int, num_cut: int
) -> int:
    """Add an edge, cut at those of the nodes ``cut_node[:num_cut]`` that lie on it. Returns the number of
    half-edges, or -1 if there is no room."""
    half, label_head, cut_node = mesh_work.half, mesh_work.label_head, mesh_work.cut_node
    on_edge, on_at = mesh_work.on_edge, mesh_work.on_at
    # the same order of computation in both directions, so that both are cut in the same way
    a, b = min(start, end), max(start, end)
    dx, dy, dz = node[b].x - node[a].x, node[b].y - node[a].y, node[b].z - node[a].z
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    num_on = 0
    if length > _STRAIGHT_M:
        dx, dy, dz = dx / length, dy / length, dz / length
        for k in range(num_cut):
            m = cut_node[k]
            qx, qy, qz = node[m].x - node[a].x, node[m].y - node[a].y, node[m].z - node[a].z
            along = qx * dx + qy * dy + qz * dz
            if along <= _STRAIGHT_M or along >= length - _STRAIGHT_M or m in (a, b):
                continue
            qx, qy, qz = qx - along * dx, qy - along * dy, qz - along * dz
            if qx * qx + qy * qy + qz * qz < _STRAIGHT_M * _STRAIGHT_M:
                at = num_on
                while at > 0 and on_at[at - 1] > along:
                    on_at[at] = on_at[at - 1]
                    on_edge[at] = on_edge[at - 1]
                    at -= 1
                on_at[at] = along
                on_edge[at] = m
                num_on += 1
    if num_half + num_on + 1 > len(half):
        return -1
    last = start
    for k in range(num_on):
        m = on_edge[k] if start == a else on_edge[num_on - 1 - k]
        num_half = _add(half, label_head, num_half, last, m, label)
        last = m
    return _add(half, label_head, num_half, last, end, label)


@inner
def _cancel_label(half: np.ndarray, label_head: np.ndarray, label: int) -> None:
    """Cancel pairs of opposite edges under one label."""
    k = label_head[label]
    while k >= 0:
        if half[k].alive == 1:
            m = half[k].next_in_label
            while m >= 0:
                if half[m].alive == 1 and half[m].start == half[k].end and half[m].end == half[k].start:
                    half[m].alive = 0
                    half[k].alive = 0
                    break
                m = half[m].next_in_label
        k = half[k].next_in_label


@inner
def collect_half_edges(
    num_edges: int, skeleton_work: SkeletonWork, mesh_work: MeshWork, thorough: bool
) -> tuple[int, int]:
    """Directed edges of all faces of the solid, by label. Returns (status, number of half-edges).

    Points 0..num_nodes-1 are the skeleton's nodes, num_nodes + i is corner i on the ground.
    What different 0 degree edges sweep may touch at the eave, so edges there are cut where nodes lie on them.
    Elsewhere that happens by coincidence only (two unrelated events at one place and height), so it is done
    only if ``thorough``.
    """
    edge, node, arc = skeleton_work.edge, skeleton_work.node, skeleton_work.arc
    cap_height, counts = skeleton_work.cap_height, skeleton_work.counts
    parent, label_parent, label_head = mesh_work.parent, mesh_work.label_parent, mesh_work.label_head
    half = mesh_work.half
    num_nodes = counts[NUM_NODES]
    labels = num_labels(num_edges, counts)
    if labels > len(label_head) or num_nodes + num_edges > len(mesh_work.out_head):
        return OVERFLOW, 0
    num_flat = 0
    for i in range(num_edges):
        if edge[i].angle_deg == 0.0:
            num_flat += 1
    cut_up_to = -1.0
    if 0 < num_flat < num_edges:
        cut_up_to = 1e-9
    if thorough:
        cut_up_to = np.inf
    _weld_nodes(num_edges, node, arc, counts, parent, cut_up_to)
    _join_coplanar_labels(edge, num_edges, arc, cap_height, counts, label_parent)
    for label in range(labels):
        label_head[label] = -1
    num_cut = ZERO
    for k in range(num_nodes):
        if parent[k] == k and node[k].z <= cut_up_to:
            mesh_work.cut_node[num_cut] = k
            num_cut += 1
    num_half = ZERO
    ground = ground_label(num_edges, counts)
    for k in range(counts[NUM_ARCS] + num_edges):
        if k < counts[NUM_ARCS]:
            a, b = find(parent, arc[k].start), find(parent, arc[k].end)
            left = find(label_parent, _face_label(edge, num_edges, cap_height, counts, arc[k].left))
            right = find(label_parent, _face_label(edge, num_edges, cap_height, counts, arc[k].right))
        else:
            a = k - counts[NUM_ARCS]
            b = edge[a].next
            left = find(label_parent, _face_label(edge, num_edges, cap_height, counts, a))
            right = find(label_parent, wall_label(num_edges, counts, a))
            if num_half + 4 > len(half):
                return OVERFLOW, 0
            num_half = _add(half, label_head, num_half, num_nodes + b, num_nodes + a, ground)
            num_half = _add(half, label_head, num_half, num_nodes + a, num_nodes + b, right)
            num_half = _add(half, label_head, num_half, num_nodes + b, b, right)
            num_half = _add(half, label_head, num_half, a, num_nodes + a, right)
        if a == b or left == right:
            continue
        for side in range(2):
            if side == 1:
                a, b, left = b, a, right
            if node[a].z <= cut_up_to and node[b].z <= cut_up_to:
                num_half = _add_subdivided(node, mesh_work, num_half, a, b, left, num_cut)
            elif num_half < len(half):
                num_half = _add(half, label_head, num_half, a, b, left)
            else:
                num_half = -1
            if num_half < 0:
                return OVERFLOW, 0
    for label in range(labels):
        if label != ground and label_head[label] >= 0:
            _cancel_label(half, label_head, label)
    return OK, num_half


@inner
def drop_straight_points(
    half: np.ndarray, num_half: int, degree: np.ndarray, point: np.ndarray, num_points: int
) -> None:
    """Remove the points that, after faces have merged, lie on a straight line between two faces."""
    for k in range(num_points):
        degree[k] = 0
    for h in range(num_half):
        if half[h].alive == 1:
            degree[half[h].start] += 1
    for k in range(num_points):
        if degree[k] != 2:
            continue
        a, b = -1, -1
        for h in range(num_half):
            if half[h].alive == 1 and half[h].start == k:
                if a < 0:
                    a = half[h].end
                else:
                    b = half[h].end
        if a < 0 or b < 0 or a == b:
            continue
        dx, dy, dz = point[b, 0] - point[a, 0], point[b, 1] - point[a, 1], point[b, 2] - point[a, 2]
        ex, ey, ez = point[k, 0] - point[a, 0], point[k, 1] - point[a, 1], point[k, 2] - point[a, 2]
        cx, cy, cz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
        length2 = dx * dx + dy * dy + dz * dz
        if cx * cx + cy * cy + cz * cz > _STRAIGHT_M * _STRAIGHT_M * length2 or length2 == 0.0:
            continue
        for h in range(num_half):
            if half[h].alive == 0 or half[h].end != k:
                continue
            for m in range(num_half):
                if half[m].alive == 1 and half[m].start == k and half[m].label == half[h].label:
                    half[h].end = half[m].end
                    half[m].alive = 0
                    break
