"""From the arcs of the skeleton to the directed edges of the faces of a closed solid.

Every face is a collection of directed edges under one label. Edges that occur in both directions under one
label cancel, which is how coplanar neighbours merge: a gable triangle with the wall below it, the flat pieces
that 0 degree edges have swept, roof pieces that share a plane.
"""

from typing import NamedTuple

import numpy as np

from p2wss.skeleton.compiled import ZERO, embedded, inner
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

_SAME_PLACE_M = 1e-5  # nodes that are nearer together in plan than this are at one place
_STRAIGHT_M = 1e-6  # an edge that is nearer to the line of another edge than this is on that line
_BENT_M = (
    10.0 * _SAME_PLACE_M
)  # how far a place beside a point between two planes may move the point, unless the planes are almost parallel
_PARALLEL = 1e-7


@inner
def _face_label(
    edge: np.ndarray, num_edges: int, cap_height: np.ndarray, counts: np.ndarray, face: int
) -> int:
    """The label of a face of an arc, by its number. A vertical face has the label of its wall. All faces at the eave
    have one label."""
    if face < num_edges:
        if edge[face].angle_deg == 0.0:
            return flat_label(num_edges, counts)
        if edge[face].angle_deg == 90.0:
            return wall_label(num_edges, counts, face)
        return face
    if cap_height[face - num_edges] <= _SAME_PLACE_M:
        return flat_label(num_edges, counts)
    return face


@inner
def find(parent: np.ndarray, a: int) -> int:
    """The number that stands for ``a`` and for all numbers that it has been merged with."""
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


class _Places(NamedTuple):
    """Places, where nodes of the skeleton are merged. edge, num_edges: of the footprint. number: the node that stands
    for all nodes at each place, in ``number[:num]``, with its coordinates ``x`` and ``y``. storey_m: two nodes at one
    place in plan with a larger difference in height are different places, one above the other at a wall."""

    edge: np.ndarray
    num_edges: int
    node: np.ndarray
    number: np.ndarray
    x: np.ndarray
    y: np.ndarray
    num: int
    storey_m: float


@embedded
def _storey(edge: np.ndarray, num_edges: int) -> float:
    """``storey_m`` of :class:`_Places`: twice the tolerance in plan, and twice what the steepest roof rises over it."""
    slowest = np.inf
    for e in range(num_edges):
        if 0.0 < edge[e].final_speed < slowest:
            slowest = edge[e].final_speed
    return 2.0 * (1.0 + 1.0 / slowest) * _SAME_PLACE_M


@embedded
def _num_about(places: _Places, x: float, y: float) -> int:
    """How many places differ from a point by less than the tolerance both in x and in y."""
    count = 0
    for m in range(places.num):
        count += (abs(places.x[m] - x) < _SAME_PLACE_M) & (abs(places.y[m] - y) < _SAME_PLACE_M)
    return count


@inner
def _nearest_place(places: _Places, k: int) -> int:
    """The node that stands for the nearest place that node k is at; k if it is at none."""
    node = places.node
    best, best_m = k, _SAME_PLACE_M
    for m in range(places.num):
        a = places.number[m]
        dx, dy = node[k].x - node[a].x, node[k].y - node[a].y
        distance = np.sqrt(dx * dx + dy * dy)
        if distance < best_m and abs(node[k].z - node[a].z) < places.storey_m:
            best, best_m = a, distance
    return best


@embedded
def _gather_nodes(
    edge: np.ndarray, num_edges: int, node: np.ndarray, num_nodes: int, mesh_work: MeshWork
) -> _Places:
    """Merge nodes at one place: ``parent[k]`` becomes the node that stands for the place of node k, its first one.
    Corners of the footprint come first."""
    number, x, y, parent = mesh_work.place, mesh_work.place_x, mesh_work.place_y, mesh_work.parent
    storey_m = _storey(edge, num_edges)
    places = _Places(edge, num_edges, node, number, x, y, ZERO, storey_m)
    for k in range(num_nodes):
        parent[k] = k
        if _num_about(places, node[k].x, node[k].y) > 0:
            parent[k] = _nearest_place(places, k)
        if parent[k] == k:
            number[places.num], x[places.num], y[places.num] = k, node[k].x, node[k].y
            places = _Places(edge, num_edges, node, number, x, y, places.num + 1, storey_m)
    for k in range(num_nodes):
        if parent[k] != k:  # a later place may be nearer
            parent[k] = _nearest_place(places, k)
    return places


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
    """Give neighbouring roof faces in the same plane one label."""
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
    half[num_half].start, half[num_half].end, half[num_half].label = start, end, label
    half[num_half].alive = 1
    half[num_half].next_in_label = label_head[label]
    label_head[label] = num_half
    return num_half + 1


@inner
def _direction(node: np.ndarray, a: int, b: int) -> tuple[float, float, float, float]:
    """From node a to node b: the steps in x, y and z for each metre in plan, and the length in plan, metres."""
    dx, dy, dz = node[b].x - node[a].x, node[b].y - node[a].y, node[b].z - node[a].z
    length = np.sqrt(dx * dx + dy * dy)
    return dx / length, dy / length, dz / length, length


@inner
def _is_behind(places: _Places, faces: tuple[int, int], k: int) -> bool:
    """Whether place k is behind the footprint edge of one of two faces, as on the other side of a notch. Then it does
    not count as near to places at that edge."""
    edge, node = places.edge, places.node
    for e in faces:
        if e >= places.num_edges:
            continue
        qx, qy = node[k].x - edge[e].x, node[k].y - edge[e].y
        along, inwards = qx * edge[e].dir_x + qy * edge[e].dir_y, qy * edge[e].dir_x - qx * edge[e].dir_y
        if inwards < -_STRAIGHT_M and 0.0 < along < edge[e].length:
            return True
    return False


@inner
def _put_ahead(
    node: np.ndarray, ahead: np.ndarray, num_ahead: int, k: int, way: tuple[float, float, float]
) -> int:
    """Insert node k into the nodes ahead on a way, which are in reverse order. Returns the number of nodes ahead."""
    at = num_ahead
    while at > 1:
        w = ahead[at - 1]
        dx, dy, dz = node[w].x - node[k].x, node[w].y - node[k].y, node[w].z - node[k].z
        if dx * way[0] + dy * way[1] + dz * way[2] > 0.0:
            break
        ahead[at] = w
        at -= 1
    ahead[at] = k
    return num_ahead + 1


@inner
def _put_storeys_ahead(places: _Places, mesh_work: MeshWork, ends: tuple[int, int], end_place: int) -> int:
    """:func:`_put_cells_ahead` for an arc that rises along a wall: the places between its ends in height."""
    node, ahead = places.node, mesh_work.ahead
    a, b = ends
    rise = node[b].z - node[a].z
    ahead[0] = end_place
    num_ahead = ZERO + 1
    for m in range(places.num):
        k = places.number[m]
        qx, qy = node[k].x - node[a].x, node[k].y - node[a].y
        from_a, from_b = (node[k].z - node[a].z) * rise, (node[b].z - node[k].z) * rise
        is_between = min(from_a, from_b) > places.storey_m * abs(rise)
        if is_between and qx * qx + qy * qy < _SAME_PLACE_M * _SAME_PLACE_M:
            num_ahead = _put_ahead(node, ahead, num_ahead, k, (0.0, 0.0, rise))
    return num_ahead


@inner
def _put_cells_ahead(
    places: _Places,
    mesh_work: MeshWork,
    ends: tuple[int, int],
    end_places: tuple[int, int],
    faces: tuple[int, int],
) -> int:
    """Write to ``ahead`` the places whose cells an arc between two faces runs through, in reverse order and without the
    place of its start. The cell of a place is all points that are nearer to it than to any other place, up to the
    tolerance. Returns the number of places.
    """
    node, near, ahead = places.node, mesh_work.near, mesh_work.ahead
    a, b = ends
    dx, dy, dz, length = _direction(node, a, b)
    ahead[0] = end_places[1]
    num_ahead = ZERO + 1
    if length < _SAME_PLACE_M and abs(node[b].z - node[a].z) > places.storey_m:
        return _put_storeys_ahead(places, mesh_work, ends, end_places[1])
    if length == 0.0:
        return num_ahead
    num_near = ZERO
    for m in range(places.num):
        k = places.number[m]
        qx, qy = node[k].x - node[a].x, node[k].y - node[a].y
        across, along = abs(qx * dy - qy * dx), qx * dx + qy * dy
        is_near = across < _SAME_PLACE_M and -_SAME_PLACE_M < along < length + _SAME_PLACE_M
        is_near = is_near and abs(node[k].z - node[a].z - along * dz) < places.storey_m
        if is_near and not _is_behind(places, faces, k):
            near[num_near] = k
            num_near += 1
    for i in range(num_near):
        k = near[i]
        if k == end_places[0] or k == end_places[1]:
            continue
        qx, qy = node[k].x - node[a].x, node[k].y - node[a].y
        across, along = abs(qx * dy - qy * dx), qx * dx + qy * dy
        reach = np.sqrt(_SAME_PLACE_M * _SAME_PLACE_M - across * across)
        first, last = max(along - reach, 0.0), min(along + reach, length)
        for j in range(num_near):
            wx, wy = node[near[j]].x - node[k].x, node[near[j]].y - node[k].y
            ahead_of_it = wx * dx + wy * dy
            limit = 0.5 * (wx * (wx + 2.0 * qx) + wy * (wy + 2.0 * qy))
            if ahead_of_it > 0.0:
                last = min(last, limit / ahead_of_it)
            elif ahead_of_it < 0.0:
                first = max(first, limit / ahead_of_it)
        if first < last:
            num_ahead = _put_ahead(node, ahead, num_ahead, k, (dx, dy, 0.0))
    return num_ahead


@inner
def _place_on_edge(places: _Places, a: int, b: int, faces: tuple[int, int]) -> int:
    """The nearest place that the edge from a to b, between two faces, almost touches; -1 for none."""
    node = places.node
    dx, dy, dz, length = _direction(node, a, b)
    best, best_m = -1, 0.5 * _SAME_PLACE_M
    for m in range(places.num):
        k = places.number[m]
        qx, qy = node[k].x - node[a].x, node[k].y - node[a].y
        across = abs(qx * dy - qy * dx)
        along = qx * dx + qy * dy
        is_near = across < best_m and 0.0 < along < length and k != a and k != b
        is_near = is_near and abs(node[k].z - node[a].z - along * dz) < places.storey_m
        if is_near and not _is_behind(places, faces, k):
            best, best_m = k, across
    return best


@embedded
def _is_alone(places: _Places, a: int, b: int) -> bool:
    """Whether an arc from place a to place b is near to no other place."""
    a_x, a_y = places.node[a].x, places.node[a].y
    dx, dy, _, length = _direction(places.node, a, b)
    count = 0
    for m in range(places.num):  # without branches, so that several are compared at once
        qx, qy = places.x[m] - a_x, places.y[m] - a_y
        along = qx * dx + qy * dy
        count += (
            (abs(qx * dy - qy * dx) < _SAME_PLACE_M)
            & (along > -_SAME_PLACE_M)
            & (along < length + _SAME_PLACE_M)
        )
    return count == 2


@embedded
def _add_arc(
    places: _Places,
    mesh_work: MeshWork,
    num_half: int,
    ends: tuple[int, int],
    faces: tuple[int, int],
    labels: tuple[int, int],
) -> int:
    """Add an arc (start, end) under the labels of its left and right face, by way of all places that it passes through.
    Returns the number of half-edges, or -1 if there is no room.

    This is snap rounding with cells around places instead of a grid: arcs that do not cross before do not cross
    afterwards. (Guibas and Marimont, *Rounding arrangements dynamically*, 1998.)
    """
    half, label_head, ahead = mesh_work.half, mesh_work.label_head, mesh_work.ahead
    a, b = mesh_work.parent[ends[0]], mesh_work.parent[ends[1]]
    is_alone = a == ends[0] and b == ends[1] and _is_alone(places, a, b)
    num_ahead, ahead[0] = ZERO + 1, b
    if not is_alone:
        num_ahead = _put_cells_ahead(places, mesh_work, ends, (a, b), faces)
    while num_ahead > 0:
        b = ahead[num_ahead - 1]
        if a == b:
            num_ahead -= 1
            continue
        k = -1 if is_alone else _place_on_edge(places, a, b, faces)
        if k >= 0:
            if num_ahead == len(ahead):
                return -1
            ahead[num_ahead] = k
            num_ahead += 1
            continue
        if num_half + 2 > len(half):
            return -1
        num_half = _add(half, label_head, num_half, a, b, labels[0])
        num_half = _add(half, label_head, num_half, b, a, labels[1])
        a = b
        num_ahead -= 1
    return num_half


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
def collect_half_edges(num_edges: int, skeleton_work: SkeletonWork, mesh_work: MeshWork) -> tuple[int, int]:
    """Directed edges of all faces of the solid, by label. Returns (status, number of half-edges).

    Points 0..num_nodes-1 are the skeleton's nodes, num_nodes + i is corner i on the ground. Nodes that are nearer
    together than the tolerance become one place, and arcs that pass by a place go through it. What is between
    them vanishes, as it would if the events had been simultaneous.
    """
    edge, node, arc = skeleton_work.edge, skeleton_work.node, skeleton_work.arc
    cap_height, counts = skeleton_work.cap_height, skeleton_work.counts
    half, label_parent, label_head = mesh_work.half, mesh_work.label_parent, mesh_work.label_head
    num_nodes = counts[NUM_NODES]
    labels = num_labels(num_edges, counts)
    if labels > len(label_head) or num_nodes + num_edges > len(mesh_work.out_head):
        return OVERFLOW, 0
    places = _gather_nodes(edge, num_edges, node, num_nodes, mesh_work)
    _join_coplanar_labels(edge, num_edges, arc, cap_height, counts, label_parent)
    label_head[:labels] = -1
    num_half = ZERO
    ground = ground_label(num_edges, counts)
    for k in range(counts[NUM_ARCS] + num_edges):
        if k < counts[NUM_ARCS]:
            a, b = arc[k].start, arc[k].end
            left = find(label_parent, _face_label(edge, num_edges, cap_height, counts, arc[k].left))
            right = find(label_parent, _face_label(edge, num_edges, cap_height, counts, arc[k].right))
            faces = arc[k].left, arc[k].right
        else:
            a = k - counts[NUM_ARCS]
            faces = a, a
            b = edge[a].next
            left = find(label_parent, _face_label(edge, num_edges, cap_height, counts, a))
            right = find(label_parent, wall_label(num_edges, counts, a))
            if num_half + 4 > len(half):
                return OVERFLOW, 0
            num_half = _add(half, label_head, num_half, num_nodes + b, num_nodes + a, ground)
            num_half = _add(half, label_head, num_half, num_nodes + a, num_nodes + b, right)
            num_half = _add(half, label_head, num_half, num_nodes + b, b, right)
            num_half = _add(half, label_head, num_half, a, num_nodes + a, right)
        if left == right:
            continue
        num_half = _add_arc(places, mesh_work, num_half, (a, b), faces, (left, right))
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
    """Remove the points that only two faces share, if they are on the line where the two planes meet, up to the
    tolerance."""
    degree[:num_points] = 0
    for h in range(num_half):
        if half[h].alive == 1:
            degree[half[h].start] += 1
    for k in range(num_points):
        if degree[k] != 2:
            continue
        a, b = -1, -1
        for h in range(num_half):
            if half[h].alive == 1 and half[h].start == k:
                a, b = b, half[h].end
        if a == b:
            continue
        dx, dy, dz = point[b, 0] - point[a, 0], point[b, 1] - point[a, 1], point[b, 2] - point[a, 2]
        ex, ey, ez = point[k, 0] - point[a, 0], point[k, 1] - point[a, 1], point[k, 2] - point[a, 2]
        cx, cy, cz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
        length2 = dx * dx + dy * dy + dz * dz
        if cx * cx + cy * cy + cz * cz > _BENT_M * _BENT_M * length2 or length2 == 0.0:
            continue
        for h in range(num_half):
            if half[h].alive == 0 or half[h].end != k:
                continue
            for m in range(num_half):
                if half[m].alive == 1 and half[m].start == k and half[m].label == half[h].label:
                    half[h].end = half[m].end
                    half[m].alive = 0
                    break
            for m in range(num_half):  # the rest of a face without area
                if (
                    half[m].alive == 1
                    and half[m].label == half[h].label
                    and half[m].start == half[h].end
                    and half[m].end == half[h].start
                ):
                    half[m].alive = 0
                    half[h].alive = 0
                    break
