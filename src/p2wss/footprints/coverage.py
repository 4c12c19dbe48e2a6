"""Clean footprints as coverages, block by block, so that neighbours keep their shared walls.

A block is a set of footprints that touch, nearly touch or overlap; often it is a single footprint. Its footprints get
common nodes (:mod:`p2wss.footprints.common_nodes`), and are simplified along the lines between the nodes where walls
meet (arcs). All blocks are cleaned at once, but the result for a block does not depend on other blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely

from p2wss import skeleton
from p2wss.config import Scenes
from p2wss.data import polygon_arrays
from p2wss.footprints.common_nodes import join_rings, previous_in_ring, without_repeats
from p2wss.skeleton.groups import groups
from p2wss.skeleton.types import Polygons, cross, distinct, next_in_ring, numbered

# a vertex nearer than this to the line between its neighbours lies within an edge
_WITHIN_EDGE_M = 1e-6
# a vertex nearer than this to the line is moved onto it, as solids have no walls that bend by less; rounds of moving
_STRAIGHT_M, _NUM_ROUNDS = 5e-3, 6
# a vertex is removed if walls turn by less there, or if it is nearer to the line between its neighbours
_MIN_TURN_DEG, _MIN_OFFSET_M = 3.0, 0.02
# two walls have a reliable intersection if the sine of their angle is at least this
_MIN_SINE = 0.2
# a wall must not turn by more than the angle, unless it is shorter than the length, as pieces of a curve are, or does
# not lead from end to end: the share of its length along the line between the ends is less than the last number
_MIN_WALL_M, _MAX_TURN_DEG, _MIN_FORWARD = 1.5, 1.0, 0.85
# a narrower overlap is rounding, a wider one has two records of the same house; between, it is a wall of neighbours
_MIN_OVERLAP_M, _MAX_OVERLAP_M = 2e-3, 0.5


def block_numbers(shapes: np.ndarray, snap_m: float) -> np.ndarray:
    """int64 (n,): the block of each polygon. Polygons at most ``snap_m`` apart are in one block; an empty polygon is a
    block of its own."""
    a, b = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=snap_m)
    return groups(len(shapes), np.column_stack([a, b]))


def clean_coverage(shapes: np.ndarray, settings: Scenes) -> np.ndarray:
    """The polygons cleaned as coverages, one per block: object array in the same order. None for a polygon that cannot
    be part of its coverage, for instance because it is so narrow that it collapses.

    shapes: valid polygons. settings: ``snap_m``, ``simplify_m`` and ``min_edge_m`` are used. Exteriors become
    counter-clockwise, courtyards clockwise. The two sides of a shared wall lie on the same line, and their corners are
    bit-identical. Overlaps of neighbours up to half a metre wide are divided; wider overlaps remain. The result for a
    polygon depends only on its block, and not on the order of the polygons. Never raises for valid polygons.
    """
    result = np.full(len(shapes), None, dtype=object)
    if not len(shapes):
        return result
    shapes = shapely.orient_polygons(shapes)
    bounds = shapely.bounds(shapes)
    block = block_numbers(shapes, settings.snap_m)
    origin = np.full((block.max() + 1, 2), np.inf)
    np.minimum.at(origin, block, np.floor(bounds[:, :2]))
    pending = [np.lexsort((shapely.area(shapes), *bounds.T[::-1]))]
    while pending:
        rows = pending.pop()
        polygons, is_whole = _clean(shapes[rows], origin[block[rows]], block[rows], settings)
        if is_whole.all():
            shapes[rows], is_divided = _divided(shapes[rows], polygons, settings.snap_m)
            again = np.isin(block[rows], block[rows[is_divided]])
            result[rows[~again]] = polygons[~again]
            pending += [rows[again]] if again.any() else []
            continue
        # blocks that lose a polygon are cleaned again without it
        loses = np.isin(block[rows], block[rows[~is_whole]])
        pending += [part for part in (rows[~loses], rows[loses & is_whole]) if len(part)]
    return result


def _clean(
    shapes: np.ndarray, origin: np.ndarray, block: np.ndarray, settings: Scenes
) -> tuple[np.ndarray, np.ndarray]:
    """(cleaned polygons, whether each can be part of its coverage). The polygons are of use only if all can be. block:
    (n,), the block of each polygon. origin: (n, 2), the corner of this block."""
    polygons = polygon_arrays.to_polygons(shapes)
    nodes = join_rings(polygons, settings.snap_m)
    of_node = np.zeros(len(nodes.xy_m), np.int64)
    before = _Rings(nodes.node, nodes.ring_offset, polygons.polygon_offset)
    of_node[nodes.node] = before.polygon_of_vertex
    xy_m = nodes.xy_m - origin[of_node]
    node = _contract(xy_m, nodes.node, nodes.ring_offset, settings.min_edge_m)
    rings = _Rings(*_without_spikes(*without_repeats(node, nodes.ring_offset)), polygons.polygon_offset)
    is_whole = rings.are_whole(xy_m)
    if not is_whole.all():
        return np.zeros(0, object), is_whole
    arcs = _Arcs.of_rings(rings, xy_m)
    start_m = polygons.xy_m[previous_in_ring(polygons.ring_offset)]
    line_m = np.stack([start_m, polygons.xy_m], axis=1)[nodes.input_end]
    line_m -= origin[before.polygon_of_vertex][:, None]
    line_m = arcs.lines_of_edges(np.column_stack([node[previous_in_ring(nodes.ring_offset)], node]), line_m)
    # simplified walls may cross: then they keep more of their vertices
    tolerances = np.array([settings.simplify_m, 0.0, -1.0])
    level = np.zeros(len(arcs.offset) - 1, np.int64)
    for _ in tolerances:
        kept = arcs.simplified(xy_m, tolerances[level], settings.min_edge_m)
        kept, refitted_m = arcs.refitted(kept, xy_m, line_m, settings)
        rings = arcs.rings(kept, polygons.polygon_offset)
        is_whole = rings.are_whole(xy_m)
        if is_whole.all():
            break
        level[arcs.of_polygons(~is_whole, polygons.polygon_offset)] += 1
    else:
        return np.zeros(0, object), is_whole
    # if refitted walls cross, all nodes of the block go back: the result for a block must not depend on other blocks
    crossing = np.isin(block, block[~rings.are_whole(refitted_m)])[rings.polygon_of_vertex]
    refitted_m[rings.node[crossing]] = xy_m[rings.node[crossing]]
    xy_m = rings.straightened(refitted_m)
    result = rings.without_inner(xy_m).polygons(xy_m + origin[of_node])
    # the kernel rejects a polygon that is hardly more than a spike
    return polygon_arrays.to_geometries(result), kernel_status(result) == skeleton.Status.OK


def _divided(shapes: np.ndarray, cleaned: np.ndarray, snap_m: float) -> tuple[np.ndarray, np.ndarray]:
    """(the polygons without the common areas of two, whether each polygon had one). Common areas are divided where the
    cleaned polygons still overlap, unless wider than half a metre. The area goes to the polygon with which fewer
    corners are left."""
    first, second = shapely.STRtree(cleaned).query(cleaned, predicate="intersects")
    pairs = np.column_stack([first, second])[first < second]
    overlaps = _is_wide(shapely.intersection(*cleaned[pairs.T]), _MIN_OVERLAP_M)
    shapes, is_divided = shapes.copy(), np.zeros(len(shapes), bool)
    for pair in np.unique(pairs[overlaps], axis=0):
        common = shapely.intersection(*shapes[pair])
        # opened, as spikes would be left beside overlaps that snapping closes
        rest = _buffered(_buffered(shapely.difference(shapes[pair], common), -snap_m / 2), snap_m / 2)
        rest = np.array([max(shapely.get_parts(each), key=shapely.area) for each in rest])
        is_left = (shapely.area(rest) > shapely.area(shapes[pair]) / 2).all()
        if is_left and _is_wide(common, _MIN_OVERLAP_M) and not _is_wide(common, _MAX_OVERLAP_M):
            loses = (shapely.get_num_coordinates(rest) - shapely.get_num_coordinates(shapes[pair])).argmin()
            shapes[pair[loses]] = shapely.orient_polygons(rest[loses])
            is_divided[pair] = True
    return shapes, is_divided


def _buffered(shapes: np.ndarray, distance_m: float) -> np.ndarray:
    """The polygons with their edges moved outwards by a distance, inwards if it is negative."""
    return np.asarray(shapely.buffer(shapes, distance_m, join_style="mitre"))


def _is_wide(shapes: np.ndarray, width_m: float) -> np.ndarray:
    """bool (n,): whether a circle with the diameter ``width_m`` fits into each polygon."""
    return ~shapely.is_empty(shapely.buffer(shapes, -width_m / 2))


def kernel_status(polygons: Polygons) -> np.ndarray:
    """The kernel's :class:`p2wss.skeleton.Status` for each polygon with a flat roof, (n,)."""
    flat = np.full(len(polygons.xy_m), 90.0)
    return skeleton.build(polygons, flat, np.ones(len(polygons))).status


@dataclass(frozen=True)
class _Rings:
    """Rings of nodes. Polygon p has the rings ``polygon_offset[p]:polygon_offset[p + 1]``. A ring of fewer than three
    nodes does not count. If the exterior of a polygon does not count, none of its rings does."""

    node: np.ndarray
    ring_offset: np.ndarray
    polygon_offset: np.ndarray

    @property
    def polygon_of_vertex(self) -> np.ndarray:
        """The polygon of each element of ``node``, int64."""
        of_ring = np.repeat(np.arange(len(self.polygon_offset) - 1), np.diff(self.polygon_offset))
        return np.repeat(of_ring, np.diff(self.ring_offset))

    def polygons(self, xy_m: np.ndarray) -> Polygons:
        """The polygons, with the nodes at these places."""
        count = np.diff(self.ring_offset)
        of_ring = np.repeat(np.arange(len(self.polygon_offset) - 1), np.diff(self.polygon_offset))
        is_ring = (count > 2) & (count[self.polygon_offset[:-1]] > 2)[of_ring]
        num_rings = np.bincount(of_ring[is_ring], minlength=len(self.polygon_offset) - 1)
        return Polygons(
            xy_m[self.node[np.repeat(is_ring, count)]],
            np.concatenate([[0], np.cumsum(count[is_ring])]).astype(np.int64),
            np.concatenate([[0], np.cumsum(num_rings)]).astype(np.int64),
        )

    def are_whole(self, xy_m: np.ndarray) -> np.ndarray:
        """Whether each polygon is valid and has not collapsed, bool (n,)."""
        shapes = polygon_arrays.to_geometries(self.polygons(xy_m))
        return shapely.is_valid(shapes) & ~shapely.is_empty(shapes)

    def _is_inner(self, xy_m: np.ndarray, most_m: float) -> np.ndarray:
        """Whether each vertex lies between its neighbours, nearer than ``most_m`` to the line through them."""
        here = xy_m[self.node]
        before, after = here[previous_in_ring(self.ring_offset)], here[next_in_ring(self.ring_offset)]
        u, v = here - before, after - here
        # without a division, as both neighbours of a spike's tip are in one place
        is_near = np.abs(cross(u, v)) < most_m * np.hypot(*(after - before).T)
        return np.asarray(is_near & ((u * v).sum(axis=1) > 0))

    def straightened(self, xy_m: np.ndarray) -> np.ndarray:
        """The places of the nodes after straightening: a node at which a wall hardly turns moves onto the line between
        the ends of the wall, of the longest wall if there are several. Such a node is a corner of a neighbouring
        building: the neighbour's wall still ends there, and this wall becomes a plane. Walls of two buildings with a
        common edge count as one wall, as otherwise each would move its nodes and bend the other."""
        xy_m, num = xy_m.copy(), len(xy_m)
        before, after = previous_in_ring(self.ring_offset), next_in_ring(self.ring_offset)
        pair, edge = numbered(np.sort(np.column_stack([self.node, self.node[after]]), axis=1) @ [num, 1])
        for _ in range(_NUM_ROUNDS):
            row = np.flatnonzero(self._is_inner(xy_m, _STRAIGHT_M))
            linked = edge[np.column_stack([before[row], row])]
            wall, member = num * groups(len(pair), linked), distinct(linked)
            # an end of a wall is a node with only one of its edges
            end, count = np.unique(wall[member] + np.divmod(pair[member], num), return_counts=True)
            end, here = end[count == 1], wall[linked[:, 0]]
            first, last = np.searchsorted(end, here), np.searchsorted(end, here + num) - 1
            # the line between the ends may be too far away, if the wall turns a little several times; then the line
            # between the neighbours is used
            is_wall = first < last
            ends = np.stack([end[first[is_wall]] % num, end[last[is_wall]] % num])
            start_m, end_m = xy_m[np.hstack([ends, self.node[[before[row], after[row]]]])]
            along, node = end_m - start_m, self.node[np.append(row[is_wall], row)]
            length_m = np.hypot(*along.T)
            share = ((xy_m[node] - start_m) * along).sum(axis=1) / length_m**2
            foot_m = start_m + share[:, None] * along
            step_m = np.hypot(*(foot_m - xy_m[node]).T)
            order = np.lexsort((*foot_m.T, -length_m, node))
            order = order[(step_m < _STRAIGHT_M)[order]]
            nearest = order[np.unique(node[order], return_index=True)[1]]
            xy_m[node[nearest]] = foot_m[nearest]
        return xy_m

    def without_inner(self, xy_m: np.ndarray) -> _Rings:
        """The rings without the vertices that lie within their edges, which are only corners of neighbours."""
        keep = ~self._is_inner(xy_m, _WITHIN_EDGE_M)
        num_kept = np.concatenate([[0], np.cumsum(keep)])
        return _Rings(self.node[keep], num_kept[self.ring_offset], self.polygon_offset)


@dataclass(frozen=True)
class _Arcs:
    """The lines between the nodes where walls meet. node: the nodes of all arcs, both ends included; arc k has
    ``node[offset[k]:offset[k + 1]]``. of_ring: for each ring its arcs in order: (arc, whether it is followed
    backwards)."""

    node: np.ndarray
    offset: np.ndarray
    of_ring: list[list[tuple[int, bool]]]

    @classmethod
    def of_rings(cls, rings: _Rings, xy_m: np.ndarray) -> _Arcs:
        """The arcs of rings of nodes at these places."""
        ends = np.sort(np.column_stack([rings.node, rings.node[next_in_ring(rings.ring_offset)]]), axis=1)
        degree = np.bincount(np.unique(ends, axis=0).ravel(), minlength=len(xy_m))
        numbers: dict[tuple[int, ...], int] = {}
        of_ring: list[list[tuple[int, bool]]] = []
        for first, last in pairwise(rings.ring_offset.tolist()):
            ring = rings.node[first:last]
            meets = np.flatnonzero(degree[ring] != 2)
            if not len(meets):
                # a ring of its own begins at the vertex farthest from the middle, which is a corner
                meets = np.array([np.hypot(*(xy_m[ring] - xy_m[ring].mean(axis=0)).T).argmax()])
            ring = np.roll(ring, -meets[0])
            cuts = [*(meets - meets[0]).tolist(), len(ring)]
            closed = [*ring.tolist(), int(ring[0])]
            members = []
            for a, b in pairwise(cuts):
                arc = tuple(closed[a : b + 1])
                is_back = arc[::-1] < arc
                number = numbers.setdefault(arc[::-1] if is_back else arc, len(numbers))
                members.append((number, is_back))
            of_ring.append(members)
        offset = np.concatenate([[0], np.cumsum([len(arc) for arc in numbers])]).astype(np.int64)
        return cls(np.concatenate(list(numbers)), offset, of_ring)

    @property
    def _arc(self) -> np.ndarray:
        """The arc of each element of ``node``, int64."""
        return np.repeat(np.arange(len(self.offset) - 1), np.diff(self.offset))

    @property
    def _edges(self) -> np.ndarray:
        """int64: the elements of ``node`` from which an edge leads to the next one, all but the last of each arc."""
        return np.delete(np.arange(len(self.node)), self.offset[1:] - 1)

    def of_polygons(self, mask: np.ndarray, polygon_offset: np.ndarray) -> list[int]:
        """The arcs of the polygons for which ``mask`` is True, ascending."""
        rings = [
            r for p in np.flatnonzero(mask).tolist() for r in range(polygon_offset[p], polygon_offset[p + 1])
        ]
        return sorted({number for r in rings for number, _ in self.of_ring[r]})

    def rings(self, kept: np.ndarray, polygon_offset: np.ndarray) -> _Rings:
        """The rings that the arcs form if only the ``kept`` elements of ``node`` stay."""
        arcs = [self.node[a:b][kept[a:b]] for a, b in pairwise(self.offset.tolist())]
        # without the last node of each arc, as the next arc begins with it
        rings = [
            np.concatenate([arcs[k][:0:-1] if is_back else arcs[k][:-1] for k, is_back in members])
            for members in self.of_ring
        ]
        offset = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])]).astype(np.int64)
        return _Rings(np.concatenate(rings), offset, polygon_offset)

    def simplified(self, xy_m: np.ndarray, tolerance_m: np.ndarray, min_edge_m: float) -> np.ndarray:
        """bool: whether each element of ``node`` stays when arcs are simplified. tolerance_m: of each arc; an arc with
        a negative tolerance keeps all."""
        arc = self._arc
        kept = ((np.diff(self.offset) == 2) | (tolerance_m < 0))[arc]
        row = np.flatnonzero(~kept)
        if len(row):
            which, number = np.unique(arc[row], return_inverse=True)
            # the third coordinate carries the position of each vertex
            vertex_m = np.column_stack([xy_m[self.node[row]], row])
            lines = shapely.linestrings(vertex_m, indices=number)
            simple = shapely.simplify(lines, tolerance_m[which], preserve_topology=False)
            row = np.rint(shapely.get_coordinates(simple, include_z=True)[:, 2]).astype(np.int64)
            kept[row[_thinned(xy_m, self.node[row], arc[row], min_edge_m)]] = True
        return kept

    def lines_of_edges(self, ends: np.ndarray, line_m: np.ndarray) -> np.ndarray:
        """float64 (m, 2, 2): the ends of the input's edge that each edge of the arcs is part of; of the longest one if
        there are several. ends: (n, 2), nodes of edges; line_m: (n, 2, 2), the ends of the input's edge of each."""
        num, edge = self.node.max() + 1, self._edges
        key = np.sort(ends, axis=1) @ [num, 1]
        order = np.lexsort((_length_m(line_m), key))
        wanted = np.sort(np.column_stack([self.node[edge], self.node[edge + 1]]), axis=1) @ [num, 1]
        return np.asarray(line_m[order[np.searchsorted(key[order], wanted, side="right") - 1]])

    def refitted(
        self, kept: np.ndarray, xy_m: np.ndarray, line_m: np.ndarray, settings: Scenes
    ) -> tuple[np.ndarray, np.ndarray]:
        """(which elements of ``node`` stay, the places of the nodes), so that simplified walls keep their directions.

        A simplified wall gets the line of the longest edge of the input that it replaces. A kept node moves to where
        the lines of the longest two walls at it meet, if that is at most ``simplify_m`` away. A wall may still turn, as
        beside a step between parallel walls that is deeper than ``simplify_m``. Then the vertex farthest from the new
        wall stays, too. line_m: as :meth:`lines_of_edges` returns it."""
        edge, length_m, step_m = self._edges, _length_m(line_m), line_m[:, 1] - line_m[:, 0]
        edge_m = xy_m[self.node[edge + 1]] - xy_m[self.node[edge]]
        max_sine, kept = np.sin(np.radians(_MAX_TURN_DEG)), kept.copy()
        while True:
            first = np.flatnonzero(kept[edge])
            last, section = np.append(first[1:], len(edge)) - 1, np.cumsum(kept[edge]) - 1
            ends = self.node[[edge[first], edge[last] + 1]]
            places_m = _moved(xy_m, ends, line_m[_largest(length_m, section)], settings.simplify_m)
            along = places_m[ends[1]] - places_m[ends[0]]
            # in a collapsed ring, walls have no length
            along /= np.maximum(np.hypot(*along.T), _WITHIN_EDGE_M)[:, None]
            turn_m = np.abs(cross(along[section], step_m))
            # an edge that goes far aside or back, as of a spike, does not count
            forward_m = (along[section] * edge_m).sum(axis=1)
            is_turned = (turn_m > max_sine * length_m) & (forward_m > _MIN_FORWARD * np.hypot(*edge_m.T))
            turned_m = np.where(is_turned, length_m, 0)
            most = _largest(turned_m, section)
            is_parallel = (
                np.abs(cross(step_m[most][section], step_m)) <= max_sine * length_m * length_m[most][section]
            )
            wall_m = np.add.reduceat(np.where(is_parallel, turned_m, 0), first)
            turns = (wall_m > _MIN_WALL_M) & (wall_m * turn_m[most] > settings.min_edge_m * length_m[most])
            turns &= first < last
            if not turns.any():
                return kept, places_m
            start_m, end_m = xy_m[ends]
            off_m = np.abs(cross((end_m - start_m)[section], xy_m[self.node[edge]] - start_m[section]))
            off_m[first] = -1
            kept[edge[_largest(off_m, section)[turns]]] = True


def _length_m(line_m: np.ndarray) -> np.ndarray:
    """The length of each line, (n,)."""
    return np.asarray(np.hypot(*(line_m[:, 1] - line_m[:, 0]).T))


def _largest(value: np.ndarray, section: np.ndarray) -> np.ndarray:
    """int64: the element with the largest value in each section, the first one of equal values. section: the section of
    each element, ascending and without gaps."""
    order = np.lexsort((-value, section))
    return order[np.unique(section, return_index=True)[1]]


def _moved(xy_m: np.ndarray, ends: np.ndarray, line_m: np.ndarray, most_m: float) -> np.ndarray:
    """The places of the nodes after each has moved to where the longest wall at it meets the next longest one that is
    not nearly parallel, if that is at most ``most_m`` away. ends: (2, n), the nodes at the ends of walls. line_m:
    (n, 2, 2), the lines of the walls."""
    node, line_m = ends.T.ravel(), np.repeat(line_m, 2, axis=0)
    length_m = _length_m(line_m)
    order = np.lexsort((-length_m, node))
    node, line_m, length_m = node[order], line_m[order], length_m[order]
    first = np.searchsorted(node, node)
    start_m, step = line_m[:, 0], line_m[:, 1] - line_m[:, 0]
    turn, off = (cross(each, step) for each in (step[first], start_m - start_m[first]))
    row = np.flatnonzero(np.abs(turn) > _MIN_SINE * length_m * length_m[first])
    row = row[np.unique(node[row], return_index=True)[1]]
    place_m = start_m[first[row]] + (off[row] / turn[row])[:, None] * step[first[row]]
    move_m = np.hypot(*(place_m - xy_m[node[row]]).T)
    # a smaller move is rounding
    moves = (move_m > _WITHIN_EDGE_M) & (move_m <= most_m)
    result = xy_m.copy()
    result[node[row[moves]]] = place_m[moves]
    return result


def _thinned(xy_m: np.ndarray, node: np.ndarray, arc: np.ndarray, min_edge_m: float) -> np.ndarray:
    """int64: the vertices that stay in arcs. The ends of an arc stay. Others are removed one by one, the nearest to the
    line between its neighbours first, while there are vertices that have an edge shorter than ``min_edge_m``, at which
    the wall turns by less than 3 degrees, that are a spike (a reversal within 3 degrees), or that are within 2 cm of
    this line. node, arc: the node and the ascending arc of each vertex."""
    max_cosine = np.cos(np.radians(_MIN_TURN_DEG))
    row, (_, arc) = np.arange(len(node)), np.unique(arc, return_inverse=True)
    while len(node) > 2:
        inner = np.flatnonzero((arc[1:-1] == arc[:-2]) & (arc[1:-1] == arc[2:])) + 1
        first = np.searchsorted(arc, np.arange(arc[-1] + 1))
        last = np.searchsorted(arc, np.arange(arc[-1] + 1), side="right") - 1
        is_closed = node[first] == node[last]
        # a closed arc keeps three vertices
        inner = inner[~is_closed[arc[inner]] | ((last - first)[arc[inner]] > 3)]
        u, v = xy_m[node[inner]] - xy_m[node[inner - 1]], xy_m[node[inner + 1]] - xy_m[node[inner]]
        u_m, v_m = np.hypot(*u.T), np.hypot(*v.T)
        chord_m = np.hypot(*(u + v).T)
        area_m2, along = np.abs(cross(u, v)), (u * v).sum(axis=1)
        is_spike = along <= -max_cosine * u_m * v_m
        offset_m = area_m2 / np.maximum(np.where(is_spike, np.maximum(u_m, v_m), chord_m), 1e-12)
        removable = is_spike | (np.minimum(u_m, v_m) < min_edge_m)
        removable |= (along >= max_cosine * u_m * v_m) | (offset_m < _MIN_OFFSET_M)
        inner, offset_m = inner[removable], offset_m[removable]
        if not len(inner):
            break
        order = np.lexsort((node[inner], offset_m, arc[inner]))
        _, least = np.unique(arc[inner][order], return_index=True)
        keep = np.ones(len(node), bool)
        keep[inner[order[least]]] = False
        row, node, arc = row[keep], node[keep], arc[keep]
    return row


def _contract(xy_m: np.ndarray, node: np.ndarray, ring_offset: np.ndarray, min_edge_m: float) -> np.ndarray:
    """The node of each vertex after short edges at nodes where walls meet have been contracted, to the node where most
    walls meet."""
    ends = np.sort(np.column_stack([node, node[next_in_ring(ring_offset)]]), axis=1)
    edges = np.unique(ends[ends[:, 0] != ends[:, 1]], axis=0)
    length_m = np.hypot(*(xy_m[edges[:, 0]] - xy_m[edges[:, 1]]).T)
    degree = np.bincount(edges.ravel(), minlength=len(xy_m))
    is_short = (length_m < min_edge_m) & (degree[edges] > 2).any(axis=1)
    cluster = groups(len(xy_m), edges[is_short])
    # the first node if there are several with as many walls
    most_first = np.lexsort((-degree, cluster))
    _, place = np.unique(cluster[most_first], return_index=True)
    return most_first[place][cluster[node]]


def _without_spikes(node: np.ndarray, ring_offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(nodes, ring offsets) of the rings without spikes, where a ring turns back to the node before."""
    while True:
        tip = node[previous_in_ring(ring_offset)] == node[next_in_ring(ring_offset)]
        # a ring of only tips has collapsed: it keeps its first vertex
        counts = np.diff(ring_offset)
        tip &= np.repeat(counts > 2, counts)
        if not tip.any():
            return node, ring_offset
        counts = np.add.reduceat(~tip, ring_offset[:-1])
        tip[ring_offset[:-1][counts == 0]] = False
        counts = np.maximum(counts, 1)
        node, ring_offset = without_repeats(
            node[~tip], np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        )
