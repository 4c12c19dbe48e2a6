"""From the arcs of the skeleton to the faces of a closed solid: roofs, walls, caps and ground as polygons.

Every face is a bag of directed edges under one label. Edges that occur in both directions under one label
cancel, which is how coplanar neighbours merge: a gable triangle with the wall below it, the flat pieces
that 0 degree edges have swept, roof pieces that share a plane. What is left is walked into rings.
"""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import ZERO, inner
from p2wss.skeleton.records import NUM_ARCS, NUM_CAPS, NUM_NODES
from p2wss.skeleton.status import Status

_OK = int(Status.OK)
_OVERFLOW = int(Status.OVERFLOW)
_OPEN_FACE = int(Status.OPEN_FACE)

_WELD_M = 1e-5  # nodes nearer than this are one
_STRAIGHT_M = 1e-6  # a point nearer than this to a line lies on it
_PARALLEL = 1e-7


@inner
def num_labels(num_edges, counts):
    return 2 * num_edges + counts[NUM_CAPS] + 2


@inner
def wall_label(num_edges, counts, e):
    return num_edges + counts[NUM_CAPS] + e


@inner
def flat_label(num_edges, counts):
    return 2 * num_edges + counts[NUM_CAPS]


@inner
def ground_label(num_edges, counts):
    return 2 * num_edges + counts[NUM_CAPS] + 1


@inner
def _face_label(edge, num_edges, cap_height, counts, face):
    """The label of a face number of an arc: vertical faces join their wall, faces at the eave are one."""
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
def _find(parent, a):
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@inner
def _weld(parent, a, b, num_edges):
    """Make two nodes one; the footprint's corners stay apart and stay themselves."""
    a, b = _find(parent, a), _find(parent, b)
    if a > b:
        a, b = b, a
    if a != b and b >= num_edges:
        parent[b] = a


@inner
def _weld_nodes(num_edges, node, arc, counts, parent, weld_up_to):
    """Join the ends of very short arcs, and nodes in one place up to the height ``weld_up_to``."""
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
def _same_line(edge, i, j):
    if abs(edge[i].dir_x * edge[j].dir_y - edge[i].dir_y * edge[j].dir_x) > _PARALLEL:
        return False
    if edge[i].dir_x * edge[j].dir_x + edge[i].dir_y * edge[j].dir_y < 0.0:
        return False
    offset = (edge[j].x - edge[i].x) * edge[i].dir_y - (edge[j].y - edge[i].y) * edge[i].dir_x
    return abs(offset) < _STRAIGHT_M


@inner
def _join_coplanar_labels(edge, num_edges, arc, cap_height, counts, label_parent):
    """Neighbouring roof faces of one plane get one label."""
    for k in range(num_labels(num_edges, counts)):
        label_parent[k] = k
    for k in range(counts[NUM_ARCS]):
        i, j = arc[k].left, arc[k].right
        if i >= num_edges or j >= num_edges or i == j:
            continue
        if edge[i].angle_deg == edge[j].angle_deg and edge[i].angle_deg > 0.0 and _same_line(edge, i, j):
            a = _find(label_parent, _face_label(edge, num_edges, cap_height, counts, i))
            b = _find(label_parent, _face_label(edge, num_edges, cap_height, counts, j))
            label_parent[max(a, b)] = min(a, b)


@inner
def _put(half, label_head, num_half, start, end, label):
    half[num_half].start = start
    half[num_half].end = end
    half[num_half].label = label
    half[num_half].alive = 1
    half[num_half].next_in_label = label_head[label]
    label_head[label] = num_half
    return num_half + 1


@inner
def _put_subdivided(half, label_head, num_half, start, end, label, node, cut_node, num_cut, on_edge, on_at):
    """Put an edge, cut at every one of the nodes ``cut_node[:num_cut]`` that lies on it. -1: no room."""
    # the same order of computation in both directions, so that both are cut alike
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
        num_half = _put(half, label_head, num_half, last, m, label)
        last = m
    return _put(half, label_head, num_half, last, end, label)


@inner
def _cancel_label(half, label_head, label):
    """Drop pairs of opposite edges under one label."""
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
def collect_half_edges(edge, num_edges, node, arc, cap_height, counts, mesh_work, thorough):
    """Directed edges of all faces of the solid, by label. Returns (status, number of half-edges).

    Points 0..num_nodes-1 are the skeleton's nodes, num_nodes + i is the foot of corner i on the ground.
    What 0 degree edges sweep may touch at the eave: edges there are cut where nodes lie on them. Elsewhere
    that takes a coincidence (two unrelated events in one place at one height), so it is done only if
    ``thorough``.
    """
    parent, label_parent, label_head = mesh_work.parent, mesh_work.label_parent, mesh_work.label_head
    half = mesh_work.half
    num_nodes = counts[NUM_NODES]
    labels = num_labels(num_edges, counts)
    if labels > len(label_head) or num_nodes + num_edges > len(mesh_work.out_head):
        return _OVERFLOW, 0
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
            a, b = _find(parent, arc[k].start), _find(parent, arc[k].end)
            left = _find(label_parent, _face_label(edge, num_edges, cap_height, counts, arc[k].left))
            right = _find(label_parent, _face_label(edge, num_edges, cap_height, counts, arc[k].right))
        else:
            a = k - counts[NUM_ARCS]
            b = edge[a].next
            left = _find(label_parent, _face_label(edge, num_edges, cap_height, counts, a))
            right = _find(label_parent, wall_label(num_edges, counts, a))
            if num_half + 4 > len(half):
                return _OVERFLOW, 0
            num_half = _put(half, label_head, num_half, num_nodes + b, num_nodes + a, ground)
            num_half = _put(half, label_head, num_half, num_nodes + a, num_nodes + b, right)
            num_half = _put(half, label_head, num_half, num_nodes + b, b, right)
            num_half = _put(half, label_head, num_half, a, num_nodes + a, right)
        if a == b or left == right:
            continue
        for side in range(2):
            if side == 1:
                a, b, left = b, a, right
            if node[a].z <= cut_up_to and node[b].z <= cut_up_to:
                num_half = _put_subdivided(
                    half, label_head, num_half, a, b, left, node, mesh_work.cut_node, num_cut,
                    mesh_work.on_edge, mesh_work.on_at,
                )  # fmt: skip
            elif num_half < len(half):
                num_half = _put(half, label_head, num_half, a, b, left)
            else:
                num_half = -1
            if num_half < 0:
                return _OVERFLOW, 0
    for label in range(labels):
        if label != ground and label_head[label] >= 0:
            _cancel_label(half, label_head, label)
    return _OK, num_half


@inner
def drop_straight_points(half, num_half, degree, point, num_points):
    """Take out the points where two merged faces have left nothing but a straight line between two faces."""
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


@inner
def plane_point(edge, num_edges, counts, point, label, k):
    """Coordinates (u, v) of a point in the plane of a face, such that a face seen from outside turns left."""
    first_wall = num_edges + counts[NUM_CAPS]
    if first_wall <= label < first_wall + num_edges:
        e = label - first_wall
        u = (point[k, 0] - edge[e].x) * edge[e].dir_x + (point[k, 1] - edge[e].y) * edge[e].dir_y
        return u, point[k, 2]
    if label == ground_label(num_edges, counts):
        return point[k, 0], -point[k, 1]
    return point[k, 0], point[k, 1]


@inner
def _next_half(half, out_head, edge, num_edges, counts, point, label, start, here):
    """The unused half-edge that goes on from ``here``; at a pinch, the one that keeps the face on the
    left."""
    best, best_turn = -1, 0.0
    several = False
    h = out_head[here]
    while h >= 0:
        if half[h].alive == 1:
            if best >= 0:
                several = True
            best = h
        h = half[h].next_out
    if not several:
        return best
    u0, v0 = plane_point(edge, num_edges, counts, point, label, here)
    u1, v1 = plane_point(edge, num_edges, counts, point, label, start)
    back = np.arctan2(v1 - v0, u1 - u0)
    best = -1
    h = out_head[here]
    while h >= 0:
        if half[h].alive == 1:
            u2, v2 = plane_point(edge, num_edges, counts, point, label, half[h].end)
            turn = back - np.arctan2(v2 - v0, u2 - u0)  # clockwise from the way back
            if turn <= 1e-12:
                turn += 2.0 * np.pi
            if best < 0 or turn < best_turn:
                best, best_turn = h, turn
        h = half[h].next_out
    return best


@inner
def _ring_area(edge, num_edges, counts, point, label, ring_point, first, last):
    area = 0.0
    u0, v0 = plane_point(edge, num_edges, counts, point, label, ring_point[first])
    a_u, a_v = 0.0, 0.0
    for k in range(first + 1, last):
        b_u, b_v = plane_point(edge, num_edges, counts, point, label, ring_point[k])
        b_u -= u0
        b_v -= v0
        area += a_u * b_v - a_v * b_u
        a_u, a_v = b_u, b_v
    return 0.5 * area


@inner
def _inside(edge, num_edges, counts, point, label, ring_point, first, last, u, v):
    inside = False
    a_u, a_v = plane_point(edge, num_edges, counts, point, label, ring_point[last - 1])
    for k in range(first, last):
        b_u, b_v = plane_point(edge, num_edges, counts, point, label, ring_point[k])
        if (a_v > v) != (b_v > v) and u < a_u + (v - a_v) / (b_v - a_v) * (b_u - a_u):
            inside = not inside
        a_u, a_v = b_u, b_v
    return inside


@inner
def trace_faces(edge, num_edges, counts, num_half, point, mesh_work):
    """Walk the half-edges into faces, each an outer ring and its holes. Returns (status, number of faces).

    Fills ``ring_point`` (points of all rings), ``ring_start`` (where ring r starts), ``ring_order`` and
    ``face``: face f has the label ``face[f].label`` and the rings ``ring_order[first_ring:last_ring]``.
    """
    half, out_head, label_head = mesh_work.half, mesh_work.out_head, mesh_work.label_head
    ring_point, ring_start = mesh_work.ring_point, mesh_work.ring_start
    ring_order, ring_area, face = mesh_work.ring_order, mesh_work.ring_area, mesh_work.face
    num_points = counts[NUM_NODES] + num_edges
    for k in range(num_points):
        out_head[k] = -1
    num_ring_points, num_rings, num_faces, num_ordered = 0, 0, 0, 0
    ring_start[0] = 0
    for label in range(num_labels(num_edges, counts)):
        h = label_head[label]
        while h >= 0:
            if half[h].alive == 1:
                half[h].next_out = out_head[half[h].start]
                out_head[half[h].start] = h
            h = half[h].next_in_label
        first_ring = num_rings
        first = label_head[label]
        while first >= 0:
            if half[first].alive != 1:
                first = half[first].next_in_label
                continue
            h = first
            origin = half[first].start
            while True:
                half[h].alive = 2  # taken
                if num_ring_points + 1 > len(ring_point):
                    return _OVERFLOW, 0
                ring_point[num_ring_points] = half[h].start
                num_ring_points += 1
                here = half[h].end
                following = _next_half(
                    half, out_head, edge, num_edges, counts, point, label, half[h].start, here
                )
                if here == origin:
                    # at a pinch the ring may have to pass through its origin once more
                    if following < 0:
                        break
                    half[first].alive = 1
                    again = _next_half(
                        half, out_head, edge, num_edges, counts, point, label, half[h].start, here
                    )
                    half[first].alive = 2
                    if again == first:
                        break
                if following < 0:
                    return _OPEN_FACE, 0
                h = following
            num_rings += 1
            if num_rings + 1 > len(ring_start):
                return _OVERFLOW, 0
            ring_start[num_rings] = num_ring_points
            if ring_start[num_rings] - ring_start[num_rings - 1] < 3:
                return _OPEN_FACE, 0
            ring_area[num_rings - 1] = _ring_area(
                edge, num_edges, counts, point, label, ring_point, ring_start[num_rings - 1], num_ring_points
            )
        h = label_head[label]
        while h >= 0:
            out_head[half[h].start] = -1
            h = half[h].next_in_label
        for ring in range(first_ring, num_rings):
            if ring_area[ring] <= 0.0:
                continue
            face[num_faces].label = label
            face[num_faces].first_ring = num_ordered
            ring_order[num_ordered] = ring
            num_ordered += 1
            for hole in range(first_ring, num_rings):
                if ring_area[hole] > 0.0:
                    continue
                u, v = plane_point(edge, num_edges, counts, point, label, ring_point[ring_start[hole]])
                owner, owner_area = -1, np.inf
                for other in range(first_ring, num_rings):
                    if 0.0 < ring_area[other] < owner_area and _inside(
                        edge, num_edges, counts, point, label, ring_point,
                        ring_start[other], ring_start[other + 1], u, v,
                    ):  # fmt: skip
                        owner, owner_area = other, ring_area[other]
                if owner == ring:
                    ring_order[num_ordered] = hole
                    num_ordered += 1
            face[num_faces].last_ring = num_ordered
            num_faces += 1
    if num_ordered != num_rings:
        return _OPEN_FACE, 0  # a hole that lies in no face
    return _OK, num_faces
