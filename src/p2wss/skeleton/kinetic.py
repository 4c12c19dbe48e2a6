"""The weighted straight skeleton by kinetic simulation: every edge moves inwards, the events of the wavefront
are processed in order of height, and the paths of its vertices are the arcs of the skeleton.

Height takes the place of time. The edge with angle ``a`` moves by ``cot(a)`` metres in plan per metre of
height, so an edge of 90 degrees stands exactly still. An edge of 0 degrees is infinitely fast: first, in phase
0, such edges sweep alone at height 0, while all others stand still, until they can reach nothing more; phase 1
then runs with the real speeds on what remains. A piece is the part of an edge on the wavefront, between two of
its vertices.

Rules for the cases that the definition leaves open:

* A wavefront on which every edge stands still is capped flat at once, and so is one that reaches the maximum
  height.
* Where two pieces become collinear neighbours at different speeds, the faster swallows the slower.
* Neighbours that face each other (antiparallel) close up towards the nearer end at once.

Courtyards are further wavefronts. A reflex vertex that runs into its own wavefront splits it in two; one that
runs into another wavefront joins the two into one. Both change the links in the same way.

Weighted skeletons and their ambiguities: Held and Palfrader, *Straight skeletons with additive and
multiplicative weights and their application to the algorithmic generation of roofs and terrains*, 2017.
"""

import numpy as np

from p2wss.skeleton.compiled import ZERO, embedded, inner
from p2wss.skeleton.records import (
    ARC,
    EDGE,
    NODE,
    NUM_ALIVE,
    NUM_AMBIGUOUS,
    NUM_ARCS,
    NUM_CAPS,
    NUM_COUNTS,
    NUM_HOLES,
    NUM_LOOPS,
    NUM_NODES,
    NUM_VERTICES,
    VERTEX,
    SkeletonWork,
)
from p2wss.skeleton.rings import crosses, to_segment_m2
from p2wss.skeleton.status import BROKEN_WAVEFRONT, NO_EVENT, OK, OVERFLOW, TOO_MANY_EVENTS

_PARALLEL = 1e-7  # sine below which two edges are parallel
_OBLIQUE = 1e-3  # sine above which the point where two edges meet is precise
_REFLEX = -1e-9
_LENGTH_M = 1e-7  # a piece shorter than this has vanished
_JUMP_M = 1e-6  # a piece moves at most this far when it swallows a piece that is almost on its line
_AREA_M2 = 1e-6  # twice the area of a loop that has vanished
_STILL = 1e-12  # a rate of change below this counts as zero
_TIE = 1e-10  # if events are closer than this in height, collapses come before splits
_NEVER = np.inf

_ORDINARY, _COLLINEAR, _FACING = 0, 1, 2  # kinds of wavefront vertex
_UNKNOWN, _NOTHING = -2, -1  # values of split_from


@inner
def _vertex_velocity(edge: np.ndarray, left: int, right: int) -> tuple[float, float, int]:
    """Velocity of the vertex between two moving lines, and its kind."""
    left_nx, left_ny = -edge[left].dir_y, edge[left].dir_x
    right_nx, right_ny = -edge[right].dir_y, edge[right].dir_x
    left_speed, right_speed = edge[left].speed, edge[right].speed
    cross = left_nx * right_ny - left_ny * right_nx
    if abs(cross) < _PARALLEL:
        if left_nx * right_nx + left_ny * right_ny > 0:
            if abs(left_speed - right_speed) < 1e-9:
                return left_nx * left_speed, left_ny * left_speed, _ORDINARY
            return 0.0, 0.0, _COLLINEAR
        if left_speed + right_speed == 0.0:
            return 0.0, 0.0, _ORDINARY
        return 0.0, 0.0, _FACING
    vel_x = (left_speed * right_ny - left_ny * right_speed) / cross
    vel_y = (left_nx * right_speed - left_speed * right_nx) / cross
    return vel_x, vel_y, _ORDINARY


@inner
def _position(node: np.ndarray, vertex: np.ndarray, v: int, t: float) -> tuple[float, float]:
    dt = t - vertex[v].birth
    return node[vertex[v].node].x + dt * vertex[v].vel_x, node[vertex[v].node].y + dt * vertex[v].vel_y


@inner
def _start_moving(edge: np.ndarray, vertex: np.ndarray, v: int, t: float) -> None:
    """Set velocity and kind of a vertex from its two edges, and clear its events."""
    left, right = vertex[v].left, vertex[v].right
    vertex[v].vel_x, vertex[v].vel_y, vertex[v].kind = _vertex_velocity(edge, left, right)
    turn = edge[left].dir_x * edge[right].dir_y - edge[left].dir_y * edge[right].dir_x
    vertex[v].birth = t
    vertex[v].reflex = 1 if vertex[v].kind == _ORDINARY and turn < _REFLEX else 0
    vertex[v].collapse_time = vertex[v].split_time = _NEVER
    vertex[v].split_from = _UNKNOWN


@inner
def _add_vertex(
    edge: np.ndarray,
    vertex: np.ndarray,
    counts: np.ndarray,
    edges: tuple[int, int],
    neighbours: tuple[int, int],
    at_node: int,
    t: float,
) -> int:
    """Add a vertex to the wavefront and return its number; the caller sets its loop. edges: (left, right). neighbours:
    (previous, next)."""
    before, after = neighbours
    v = counts[NUM_VERTICES]
    counts[NUM_VERTICES] += 1
    counts[NUM_ALIVE] += 1
    vertex[v].left, vertex[v].right = edges
    vertex[v].prev, vertex[v].next = neighbours
    vertex[v].node = at_node
    vertex[v].alive = 1
    vertex[before].next = v
    vertex[after].prev = v
    _start_moving(edge, vertex, v, t)
    return v


@inner
def _kill(vertex: np.ndarray, counts: np.ndarray, v: int) -> None:
    if vertex[v].alive == 1:
        vertex[v].alive = 0
        counts[NUM_ALIVE] -= 1


@inner
def _add_node(node: np.ndarray, counts: np.ndarray, x: float, y: float, z: float) -> int:
    k = counts[NUM_NODES]
    counts[NUM_NODES] += 1
    node[k].x, node[k].y, node[k].z = x, y, z
    return k


@inner
def _add_arc(arc: np.ndarray, counts: np.ndarray, start: int, end: int, left: int, right: int) -> None:
    k = counts[NUM_ARCS]
    counts[NUM_ARCS] += 1
    arc[k].start, arc[k].end = start, end
    arc[k].left, arc[k].right = left, right


@inner
def _collapse_time(edge: np.ndarray, node: np.ndarray, vertex: np.ndarray, v: int, t: float) -> float:
    """Height at which the piece from v to its successor vanishes; _NEVER if it does not shrink."""
    w = vertex[v].next
    if vertex[v].kind != _ORDINARY or vertex[w].kind != _ORDINARY:
        return _NEVER
    e = vertex[v].right
    v_x, v_y = _position(node, vertex, v, t)
    w_x, w_y = _position(node, vertex, w, t)
    length = (w_x - v_x) * edge[e].dir_x + (w_y - v_y) * edge[e].dir_y
    growth = (vertex[w].vel_x - vertex[v].vel_x) * edge[e].dir_x + (vertex[w].vel_y - vertex[v].vel_y) * edge[
        e
    ].dir_y
    if growth < -_STILL:
        return t + max(length, 0.0) / -growth
    # without this, a piece of no length between equal speeds would never vanish
    if length < _LENGTH_M and growth < _LENGTH_M:
        return t
    return _NEVER


@inner
def _beyond(edge: np.ndarray, e: int, x: float, y: float, t: float) -> float:
    """Signed distance of a place from the line of edge e at height t, positive on the side that the edge moves to."""
    return (y - edge[e].y) * edge[e].dir_x - (x - edge[e].x) * edge[e].dir_y - edge[e].speed * t


@inner
def _meeting_point(
    edge: np.ndarray, left: int, right: int, x: float, y: float, t: float
) -> tuple[float, float]:
    """Where the lines of two edges meet at height t; the nearby place (x, y) itself if they are almost parallel. A
    vertex that starts at this point does not carry on the errors of earlier events."""
    cross = edge[left].dir_x * edge[right].dir_y - edge[left].dir_y * edge[right].dir_x
    if abs(cross) < _OBLIQUE:
        return x, y
    from_left, from_right = _beyond(edge, left, x, y, t) / cross, _beyond(edge, right, x, y, t) / cross
    return (
        x + from_right * edge[left].dir_x - from_left * edge[right].dir_x,
        y + from_right * edge[left].dir_y - from_left * edge[right].dir_y,
    )


@inner
def _split_time(edge: np.ndarray, node: np.ndarray, vertex: np.ndarray, v: int, a: int, t: float) -> float:
    """Height at which the reflex vertex v runs into the piece that starts at vertex a."""
    b = vertex[a].next
    e = vertex[a].right
    if a == v or b == v or e == vertex[v].left or e == vertex[v].right:
        return _NEVER
    if vertex[a].kind != _ORDINARY or vertex[b].kind != _ORDINARY:
        return _NEVER
    dir_x, dir_y = edge[e].dir_x, edge[e].dir_y
    approach = vertex[v].vel_y * dir_x - vertex[v].vel_x * dir_y - edge[e].speed
    if approach >= -_STILL:
        return _NEVER
    v_x, v_y = _position(node, vertex, v, t)
    a_x, a_y = _position(node, vertex, a, t)
    gap = _beyond(edge, e, v_x, v_y, t)
    if gap <= -_JUMP_M:
        return _NEVER
    dt = max(gap, 0.0) / -approach
    hit_x, hit_y = v_x + dt * vertex[v].vel_x, v_y + dt * vertex[v].vel_y
    after_a = (hit_x - a_x - dt * vertex[a].vel_x) * dir_x + (hit_y - a_y - dt * vertex[a].vel_y) * dir_y
    if after_a <= -_LENGTH_M:
        return _NEVER
    b_x, b_y = _position(node, vertex, b, t + dt)
    before_b = (b_x - hit_x) * dir_x + (b_y - hit_y) * dir_y
    if before_b <= -_LENGTH_M:
        return _NEVER
    return t + dt


@inner
def _try_split(edge: np.ndarray, node: np.ndarray, vertex: np.ndarray, v: int, a: int, t: float) -> None:
    time = _split_time(edge, node, vertex, v, a, t)
    if time < vertex[v].split_time - _TIE:
        vertex[v].split_time = time
        vertex[v].split_from = a
        vertex[v].split_to = vertex[a].next


@inner
def _find_split(
    edge: np.ndarray, node: np.ndarray, vertex: np.ndarray, counts: np.ndarray, v: int, t: float
) -> None:
    """Find the first split of v among all pieces; once no courtyard is left, among the pieces of its own wavefront."""
    vertex[v].split_time = _NEVER
    vertex[v].split_from = _NOTHING
    if counts[NUM_HOLES] == 0:
        a = vertex[v].next
        for _ in range(counts[NUM_VERTICES]):
            if a == v:
                break
            _try_split(edge, node, vertex, v, a, t)
            a = vertex[a].next
    else:
        for a in range(counts[NUM_VERTICES]):
            if vertex[a].alive == 1:
                _try_split(edge, node, vertex, v, a, t)


@embedded
def _refresh_pieces(
    edge: np.ndarray,
    node: np.ndarray,
    vertex: np.ndarray,
    counts: np.ndarray,
    first: int,
    second: int,
    t: float,
) -> None:
    """Update the stored events after the pieces that end or start at two vertices have changed."""
    for u in (first, second):
        if u >= 0 and vertex[u].alive == 1:
            p = vertex[u].prev
            vertex[p].collapse_time = _collapse_time(edge, node, vertex, p, t)
            vertex[u].collapse_time = _collapse_time(edge, node, vertex, u, t)
    for v in range(counts[NUM_VERTICES]):
        if vertex[v].alive == 0 or vertex[v].reflex == 0:
            continue
        a = vertex[v].split_from
        stale = a == _UNKNOWN
        if a >= 0:
            stale = vertex[a].alive == 0 or vertex[a].next != vertex[v].split_to
            if counts[NUM_HOLES] == 0 and vertex[a].loop != vertex[v].loop:
                stale = True
        if stale:
            _find_split(edge, node, vertex, counts, v, t)
            continue
        for u in (first, second):
            if u >= 0 and vertex[u].alive == 1:  # noqa: SIM102
                if counts[NUM_HOLES] > 0 or vertex[u].loop == vertex[v].loop:
                    _try_split(edge, node, vertex, v, vertex[u].prev, t)
                    _try_split(edge, node, vertex, v, u, t)


@inner
def _loop_moves(edge: np.ndarray, vertex: np.ndarray, v: int, limit: int) -> tuple[int, bool]:
    """(Number of vertices of the loop of v, or limit + 1 if it does not close; whether any edge moves.)"""
    moves = False
    w = v
    for k in range(limit):
        if edge[vertex[w].right].speed > 0.0:
            moves = True
        w = vertex[w].next
        if w == v:
            return k + 1, moves
    return limit + 1, moves


@inner
def _loop_area(node: np.ndarray, vertex: np.ndarray, v: int, t: float, limit: int) -> float:
    """Twice the signed area of the loop of v."""
    area = 0.0
    x0, y0 = _position(node, vertex, v, t)
    a_x, a_y = 0.0, 0.0
    w = vertex[v].next
    for _ in range(limit):
        if w == v:
            break
        b_x, b_y = _position(node, vertex, w, t)
        b_x -= x0
        b_y -= y0
        area += a_x * b_y - a_y * b_x
        a_x, a_y = b_x, b_y
        w = vertex[w].next
    return area


@inner
def _depth2(
    node: np.ndarray, vertex: np.ndarray, v: int, place: tuple[float, float], t: float, limit: int
) -> float:
    """Squared distance of a place from the loop of v, negative outside."""
    x, y = place
    inside, nearest2 = False, np.inf
    w = v
    a_x, a_y = _position(node, vertex, w, t)
    for _ in range(limit):
        w = vertex[w].next
        b_x, b_y = _position(node, vertex, w, t)
        if crosses(a_x, a_y, b_x, b_y, x, y):
            inside = not inside
        nearest2 = min(nearest2, to_segment_m2(place, (a_x, a_y), (b_x, b_y)))
        a_x, a_y = b_x, b_y
        if w == v:
            break
    return nearest2 if inside else -nearest2


@inner
def _loop_inside_loop(
    node: np.ndarray, vertex: np.ndarray, v: int, outline: int, t: float, limit: int
) -> bool:
    """Whether the loop of v is inside the loop of ``outline``. As the two may touch, the vertex or middle of a piece
    that is farthest from the other loop decides."""
    best = 0.0
    w = v
    a_x, a_y = _position(node, vertex, w, t)
    for _ in range(limit):
        w = vertex[w].next
        b_x, b_y = _position(node, vertex, w, t)
        for place in ((b_x, b_y), (0.5 * (a_x + b_x), 0.5 * (a_y + b_y))):
            depth2 = _depth2(node, vertex, outline, place, t, limit)
            if abs(depth2) > abs(best):
                best = depth2
        a_x, a_y = b_x, b_y
        if w == v:
            break
    return best > 0.0


@inner
def _region_outline(node: np.ndarray, vertex: np.ndarray, counts: np.ndarray, v: int, t: float) -> int:
    """A vertex of the outer wavefront of the region that the loop of v bounds; v itself if its loop is that
    wavefront."""
    limit = counts[NUM_VERTICES]
    if _loop_area(node, vertex, v, t, limit) > 0.0:
        return v
    best, best_area = v, np.inf
    for w in range(limit):
        if vertex[w].alive == 0 or not _is_first_of_loop(vertex, w, limit):
            continue
        area = _loop_area(node, vertex, w, t, limit)
        if 0.0 < area < best_area and _loop_inside_loop(node, vertex, v, w, t, limit):
            best, best_area = w, area
    return best


@inner
def _is_first_of_loop(vertex: np.ndarray, v: int, limit: int) -> bool:
    w = vertex[v].next
    for _ in range(limit):
        if w == v:
            return True
        if w < v:
            return False
        w = vertex[w].next
    return False


@inner
def _cap_loop(work: SkeletonWork, v: int, t: float, cap: int) -> None:
    """End the loop of v at height t along the boundary of the horizontal face number ``cap``."""
    node, vertex, arc, counts = work.node, work.vertex, work.arc, work.counts
    limit = counts[NUM_VERTICES]
    first, last = ZERO - 1, ZERO - 1
    w = v
    for _ in range(limit):
        x, y = _position(node, vertex, w, t)
        here = vertex[w].node
        if t > node[here].z:
            here = _add_node(node, counts, x, y, t)
            _add_arc(arc, counts, vertex[w].node, here, vertex[w].left, vertex[w].right)
        if last >= 0:
            _add_arc(arc, counts, last, here, cap, vertex[w].left)
        else:
            first = here
        last = here
        _kill(vertex, counts, w)
        w = vertex[w].next
        if w == v:
            break
    _add_arc(arc, counts, last, first, cap, vertex[v].left)


@inner
def _name_loop(vertex: np.ndarray, v: int, name: int, limit: int) -> None:
    w = v
    for _ in range(limit):
        vertex[w].loop = name
        w = vertex[w].next
        if w == v:
            break


@inner
def _cap(work: SkeletonWork, num_edges: int, region: int, t: float) -> None:
    """End the loops with the name ``region``, or all loops if it is -1, in one cap at height t."""
    vertex, counts = work.vertex, work.counts
    cap = counts[NUM_CAPS]
    work.cap_height[cap] = t
    counts[NUM_CAPS] += 1
    for v in range(counts[NUM_VERTICES]):
        if vertex[v].alive == 1 and (region == _NOTHING or vertex[v].loop == region):
            _cap_loop(work, v, t, num_edges + cap)


@inner
def _end_still_region(work: SkeletonWork, num_edges: int, v: int, phase: int, t: float) -> None:
    """The loop of v stands still: if its whole region does, freeze it (phase 0) or cap it (phase 1)."""
    edge, node, vertex, counts = work.edge, work.node, work.vertex, work.counts
    limit = counts[NUM_VERTICES]
    region = vertex[v].loop
    num_holes = 0
    if counts[NUM_HOLES] > 0:
        region = vertex[_region_outline(node, vertex, counts, v, t)].loop
        for pass_number in range(2):  # examine the whole region before changing anything
            for w in range(limit):
                if vertex[w].alive == 0 or not _is_first_of_loop(vertex, w, limit):
                    continue
                outline = _region_outline(node, vertex, counts, w, t)
                if vertex[outline].loop != region:
                    continue
                if pass_number == 0 and _loop_moves(edge, vertex, w, limit)[1]:
                    return
                if pass_number == 1 and vertex[w].loop != region:
                    _name_loop(vertex, w, region, limit)
                    num_holes += 1
    if phase == 1:
        counts[NUM_HOLES] -= num_holes
        _cap(work, num_edges, region, t)
        return
    for w in range(limit):
        if vertex[w].alive == 1 and vertex[w].loop == region:
            vertex[w].collapse_time = vertex[w].split_time = _NEVER
            vertex[w].split_from = _NOTHING


@inner
def _settle(work: SkeletonWork, num_edges: int, v: int, phase: int, t: float) -> bool:
    """End the loop of v if it has two vertices or nothing in its region moves. False if the links are
    broken."""
    edge, vertex, counts = work.edge, work.vertex, work.counts
    if vertex[v].alive == 0:
        return True
    size, moves = _loop_moves(edge, vertex, v, counts[NUM_VERTICES])
    if size > counts[NUM_VERTICES]:
        return False
    if size <= 2:
        w = vertex[v].next
        if size == 2 and vertex[v].node != vertex[w].node:
            _add_arc(work.arc, counts, vertex[v].node, vertex[w].node, vertex[v].left, vertex[v].right)
        _kill(vertex, counts, v)
        _kill(vertex, counts, w)
    elif not moves:
        _end_still_region(work, num_edges, v, phase, t)
    return True


@inner
def _merge(work: SkeletonWork, v: int, w: int, x: float, y: float, t: float) -> int:
    """The piece from v to its successor w vanishes about (x, y): one vertex replaces both."""
    node, vertex, arc, counts = work.node, work.vertex, work.arc, work.counts
    x, y = _meeting_point(work.edge, vertex[v].left, vertex[w].right, x, y, t)
    here = _add_node(node, counts, x, y, t)
    _add_arc(arc, counts, vertex[v].node, here, vertex[v].left, vertex[v].right)
    _add_arc(arc, counts, vertex[w].node, here, vertex[w].left, vertex[w].right)
    _kill(vertex, counts, v)
    _kill(vertex, counts, w)
    edges, neighbours = (vertex[v].left, vertex[w].right), (vertex[v].prev, vertex[w].next)
    merged = _add_vertex(work.edge, vertex, counts, edges, neighbours, here, t)
    vertex[merged].loop = vertex[v].loop
    return merged


@embedded
def _collapse(work: SkeletonWork, v: int, t: float) -> int:
    node, vertex = work.node, work.vertex
    w = vertex[v].next
    v_x, v_y = _position(node, vertex, v, t)
    w_x, w_y = _position(node, vertex, w, t)
    x, y = 0.5 * (v_x + w_x), 0.5 * (v_y + w_y)
    # the position of a much slower vertex is the more precise one
    v_speed2 = vertex[v].vel_x ** 2 + vertex[v].vel_y ** 2
    w_speed2 = vertex[w].vel_x ** 2 + vertex[w].vel_y ** 2
    if v_speed2 < 1e-2 * w_speed2:
        x, y = v_x, v_y
    elif w_speed2 < 1e-2 * v_speed2:
        x, y = w_x, w_y
    return _merge(work, v, w, x, y, t)


@embedded
def _close_degenerate(work: SkeletonWork, v: int, t: float) -> int:
    """A vertex between parallel edges of different speeds merges with a neighbour, at the neighbour's place."""
    edge, node, vertex = work.edge, work.node, work.vertex
    a, b = vertex[v].prev, vertex[v].next
    a_x, a_y = _position(node, vertex, a, t)
    b_x, b_y = _position(node, vertex, b, t)
    if vertex[v].kind == _FACING:
        x, y = node[vertex[v].node].x, node[vertex[v].node].y
        to_next = (b_x - x) ** 2 + (b_y - y) ** 2 <= (a_x - x) ** 2 + (a_y - y) ** 2
    else:
        to_next = edge[vertex[v].right].speed < edge[vertex[v].left].speed
        work.counts[NUM_AMBIGUOUS] += 1
    if to_next:
        return _merge(work, v, b, b_x, b_y, t)
    return _merge(work, a, v, a_x, a_y, t)


@embedded
def _split(work: SkeletonWork, v: int, t: float) -> tuple[int, int]:
    """v runs into a piece: its wavefront splits in two, or joins the other wavefront."""
    node, vertex, counts = work.node, work.vertex, work.counts
    a = vertex[v].split_from
    b = vertex[a].next
    e = vertex[a].right
    x, y = _position(node, vertex, v, t)
    here = _add_node(node, counts, x, y, t)
    _add_arc(work.arc, counts, vertex[v].node, here, vertex[v].left, vertex[v].right)
    _kill(vertex, counts, v)
    before, after = vertex[v].prev, vertex[v].next
    left, right, loop = vertex[v].left, vertex[v].right, vertex[v].loop
    joins = vertex[a].loop != loop
    first = _add_vertex(work.edge, vertex, counts, (left, e), (before, b), here, t)
    second = _add_vertex(work.edge, vertex, counts, (e, right), (a, after), here, t)
    vertex[first].loop = vertex[second].loop = loop
    limit = counts[NUM_VERTICES]
    if joins:
        counts[NUM_HOLES] -= 1
        _name_loop(vertex, first, loop, limit)
    else:
        _name_loop(vertex, second, counts[NUM_LOOPS], limit)
        counts[NUM_LOOPS] += 1
        # a courtyard that has just joined another wavefront may leave it again at the same place
        if (
            min(_loop_area(node, vertex, first, t, limit), _loop_area(node, vertex, second, t, limit))
            < -_AREA_M2
        ):
            counts[NUM_HOLES] += 1
    return first, second


@embedded
def _next_event(vertex: np.ndarray, counts: np.ndarray) -> tuple[float, int, bool]:
    """(Height, vertex, whether it is a split); vertex -1 if no event remains."""
    height, v_best = _NEVER, ZERO - 1
    for v in range(counts[NUM_VERTICES]):
        if vertex[v].alive == 1 and vertex[v].collapse_time < height:
            height, v_best = vertex[v].collapse_time, v
    is_split = False
    for v in range(counts[NUM_VERTICES]):
        if vertex[v].alive == 1 and vertex[v].split_time < height - _TIE:
            height, v_best, is_split = vertex[v].split_time, v, True
    return height, v_best, is_split


@embedded
def _start_phase(
    edge: np.ndarray, num_edges: int, vertex: np.ndarray, counts: np.ndarray, phase: int
) -> None:
    limit = counts[NUM_VERTICES]
    for e in range(num_edges):
        if phase == 1:
            edge[e].speed = edge[e].final_speed
        else:
            edge[e].speed = 1.0 if edge[e].angle_deg == 0.0 else 0.0
    counts[NUM_LOOPS] = 0
    for v in range(limit):
        if vertex[v].alive == 1:
            vertex[v].loop = _NOTHING
            _start_moving(edge, vertex, v, 0.0)
    for v in range(limit):
        if vertex[v].alive == 1 and vertex[v].loop == _NOTHING:
            _name_loop(vertex, v, counts[NUM_LOOPS], limit)
            counts[NUM_LOOPS] += 1


@embedded
def _run_phase(work: SkeletonWork, num_edges: int, phase: int, max_roof_height: float) -> int:
    edge, node, vertex, counts = work.edge, work.node, work.vertex, work.counts
    _start_phase(edge, num_edges, vertex, counts, phase)
    t = 0.0
    num_start = counts[NUM_VERTICES]
    for v in range(num_start):
        if vertex[v].alive == 1 and _is_first_of_loop(vertex, v, num_start):
            if not _settle(work, num_edges, v, phase, t):
                return BROKEN_WAVEFRONT
            if counts[NUM_LOOPS] == 1:
                break
    num_degenerate = 0
    for v in range(num_start):
        if vertex[v].alive == 1:
            vertex[v].collapse_time = _collapse_time(edge, node, vertex, v, t)
            if vertex[v].reflex == 1:
                _find_split(edge, node, vertex, counts, v, t)
            if vertex[v].kind != _ORDINARY:
                num_degenerate += 1
    first_degenerate = 0

    max_events = 20 * num_edges + 100
    for _ in range(max_events):
        if counts[NUM_ALIVE] == 0:
            return OK
        # one event adds at most two vertices, four arcs and a node; a cap adds a node and two arcs per vertex
        room = counts[NUM_ALIVE] + 4
        if counts[NUM_VERTICES] + 4 > len(vertex) or counts[NUM_NODES] + room > len(node):
            return OVERFLOW
        if counts[NUM_ARCS] + 2 * room > len(work.arc) or counts[NUM_CAPS] + 2 > len(work.cap_height):
            return OVERFLOW
        degenerate = ZERO - 1
        if num_degenerate > 0:
            num_degenerate = 0
            for v in range(first_degenerate, counts[NUM_VERTICES]):
                if vertex[v].alive == 1 and vertex[v].kind != _ORDINARY:
                    if degenerate < 0:
                        degenerate = v
                        first_degenerate = v
                    num_degenerate += 1
        second = ZERO - 1
        if degenerate >= 0:
            first = _close_degenerate(work, degenerate, t)
        else:
            height, v, is_split = _next_event(vertex, counts)
            if v < 0:
                if phase == 1:
                    return NO_EVENT
                break
            if phase == 1 and height > max_roof_height:
                _cap(work, num_edges, ZERO + _NOTHING, max_roof_height)
                return OK
            t = max(t, height)
            if is_split:
                first, second = _split(work, v, t)
            else:
                first = _collapse(work, v, t)
        if phase == 0:
            node[vertex[first].node].z = 0.0
        if vertex[first].kind != _ORDINARY:
            num_degenerate += 1
        if second >= 0 and vertex[second].kind != _ORDINARY:
            num_degenerate += 1
        if not _settle(work, num_edges, first, phase, t):
            return BROKEN_WAVEFRONT
        if second >= 0:  # noqa: SIM102
            if not _settle(work, num_edges, second, phase, t):
                return BROKEN_WAVEFRONT
        _refresh_pieces(edge, node, vertex, counts, first, second, t)
    if phase == 0 and counts[NUM_ALIVE] > 0:
        for v in range(counts[NUM_VERTICES]):
            if vertex[v].alive == 1 and edge[vertex[v].right].speed > 0.0:
                return NO_EVENT
        return OK
    return TOO_MANY_EVENTS


@inner
def simulate(work: SkeletonWork, num_edges: int, num_rings: int, max_roof_height: float) -> int:
    """Process all events of one polygon. Returns a ``Status``; never raises and always ends.

    work: the arrays of :func:`skeleton_work`. ``edge`` is filled up to ``num_edges`` by
    :func:`p2wss.skeleton.footprint.load_footprint` and :func:`p2wss.skeleton.footprint.set_angles`; everything else is
    overwritten. max_roof_height: metres above the eave, infinity for none. On return, ``counts`` has the numbers of
    nodes, arcs and caps. Face num_edges + c of an arc is the horizontal cap at ``cap_height[c]`` above the eave.
    """
    edge, node, vertex, counts = work.edge, work.node, work.vertex, work.counts
    counts[:] = 0
    counts[NUM_NODES] = counts[NUM_VERTICES] = counts[NUM_ALIVE] = num_edges
    counts[NUM_HOLES] = num_rings - 1
    first_phase = 1
    for i in range(num_edges):
        node[i].x, node[i].y, node[i].z = edge[i].x, edge[i].y, 0.0
        vertex[i].left, vertex[i].right, vertex[i].node = edge[i].prev, i, i
        vertex[i].prev, vertex[i].next = edge[i].prev, edge[i].next
        vertex[i].loop = 0
        vertex[i].alive = 1
        if edge[i].angle_deg == 0.0:
            first_phase = 0
    status = OK
    for phase in range(first_phase, 2):
        if status == OK and counts[NUM_ALIVE] > 0:
            status = _run_phase(work, num_edges, phase, max_roof_height)
    return status


def skeleton_work(max_edges: int) -> SkeletonWork:
    """Work arrays for polygons of up to ``max_edges`` edges over all their rings."""
    num_nodes = 8 * max_edges + 64
    return SkeletonWork(
        edge=np.zeros(max_edges, EDGE),
        node=np.zeros(num_nodes, NODE),
        vertex=np.zeros(num_nodes, VERTEX),
        arc=np.zeros(3 * num_nodes, ARC),
        cap_height=np.zeros(num_nodes),
        counts=np.zeros(NUM_COUNTS, np.int64),
    )
