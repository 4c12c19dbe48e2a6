"""Join the rings of neighbouring footprints in common nodes, so that both sides of a wall have the same vertices."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.skeleton.types import Polygons, next_in_ring


@dataclass(frozen=True)
class Nodes:
    """Rings that share nodes.

    xy_m: float64 (n, 2), the places of the nodes. node: int64 (num_vertices,), the node of each vertex of the rings.
    ring_offset: ring r has the vertices ``ring_offset[r]:ring_offset[r + 1]``. No ring has the same node twice in a
    row, but a ring may have fewer than three nodes. input_end: int64 (num_vertices,); the edge that ends at a vertex is
    part of an edge of the input, and this is the input's vertex at which that edge ends.
    """

    xy_m: np.ndarray
    node: np.ndarray
    ring_offset: np.ndarray
    input_end: np.ndarray


def join_rings(polygons: Polygons, snap_m: float) -> Nodes:
    """The nodes of all rings. Vertices of different polygons at most ``snap_m`` apart become one node at their mean,
    the nearest ones first. Then a node at most ``snap_m`` from an edge of another polygon moves onto it and divides it.

    polygons: with coordinates that are accurate enough for distances. The result for a polygon depends only on polygons
    to which a chain of such neighbours leads, not on the order of the polygons.
    """
    polygon_of_ring = np.repeat(np.arange(len(polygons)), np.diff(polygons.polygon_offset))
    polygon = np.repeat(polygon_of_ring, np.diff(polygons.ring_offset))
    xy_m, node = np.unique(polygons.xy_m + 0.0, axis=0, return_inverse=True)
    xy_m, node = _merge_vertices(xy_m, node.reshape(-1), polygon, snap_m)
    return _divide_edges(xy_m, node, polygons.ring_offset, polygon_of_ring, snap_m)


def without_repeats(node: np.ndarray, ring_offset: np.ndarray, *others: np.ndarray) -> tuple[np.ndarray, ...]:
    """(nodes, ring offsets, *others) of at least one ring, without consecutive equal nodes. others: further arrays with
    a value per vertex."""
    keep = node != node[previous_in_ring(ring_offset)]
    # a ring of one repeated node keeps its first vertex
    counts = np.add.reduceat(keep, ring_offset[:-1])
    keep[ring_offset[:-1][counts == 0]] = True
    offset = np.concatenate([[0], np.cumsum(np.maximum(counts, 1))])
    return node[keep], offset, *(other[keep] for other in others)


def previous_in_ring(ring_offset: np.ndarray) -> np.ndarray:
    """The index of the vertex before each vertex in its ring. No ring may be empty."""
    previous = np.arange(-1, ring_offset[-1] - 1)
    previous[ring_offset[:-1]] = ring_offset[1:] - 1
    return previous


def _polygons_of(number: np.ndarray, polygon: np.ndarray) -> dict[int, set[int]]:
    """The polygons of each node or edge, by the number of the node or edge."""
    result: defaultdict[int, set[int]] = defaultdict(set)
    for k, p in zip(number.tolist(), polygon.tolist(), strict=True):
        result[k].add(p)
    return result


def _merge_vertices(
    xy_m: np.ndarray, node: np.ndarray, polygon: np.ndarray, snap_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """(places of nodes, node of each vertex) after close nodes of different polygons are merged. Merged nodes are all
    within ``snap_m`` of each other."""
    point = np.asarray(shapely.points(xy_m), object)
    pairs = shapely.STRtree(point).query(point, predicate="dwithin", distance=snap_m * 1.001)
    first, second = pairs = pairs[:, pairs[0] < pairs[1]]
    distance = np.hypot(*(xy_m[first] - xy_m[second]).T)
    near = distance <= snap_m
    first, second, distance = first[near], second[near], distance[near]
    order = np.lexsort((second, first, distance))
    involved = np.isin(node, pairs)
    polygons_of = _polygons_of(node[involved], polygon[involved])
    cluster = {k: k for k in polygons_of}
    members = {k: [k] for k in polygons_of}
    for a, b in zip(first[order].tolist(), second[order].tolist(), strict=True):
        p, q = cluster[a], cluster[b]
        if p == q or polygons_of[p] & polygons_of[q]:
            continue
        gap = xy_m[members[p]][:, None] - xy_m[members[q]][None]
        if np.hypot(gap[..., 0], gap[..., 1]).max() > snap_m:
            continue
        p, q = min(p, q), max(p, q)
        polygons_of[p] |= polygons_of.pop(q)
        for k in members[q]:
            cluster[k] = p
        members[p] += members.pop(q)
    number = np.arange(len(xy_m))
    xy_m = xy_m.copy()
    for p, group in members.items():
        if len(group) > 1:
            number[group] = p
            xy_m[p] = xy_m[sorted(group)].mean(axis=0)
    return xy_m, number[node]


def _divide_edges(
    xy_m: np.ndarray, node: np.ndarray, ring_offset: np.ndarray, polygon_of_ring: np.ndarray, snap_m: float
) -> Nodes:
    """Move nodes onto near edges of other polygons, and insert them there."""
    node, ring_offset, input_end = without_repeats(node, ring_offset, np.arange(len(node)))
    polygon = np.repeat(polygon_of_ring, np.diff(ring_offset))
    end = node[next_in_ring(ring_offset)]
    ends = np.sort(np.column_stack([node, end]), axis=1)
    edges, edge = np.unique(ends, axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    used = np.unique(node)
    lines = shapely.linestrings(xy_m[edges])
    points = shapely.points(xy_m[used])
    which, of_edge = shapely.STRtree(lines).query(points, predicate="dwithin", distance=snap_m)
    at = used[which]
    apart = (edges[of_edge] != at[:, None]).all(axis=1)
    at, of_edge = at[apart], of_edge[apart]
    start_m, along_m = xy_m[edges[of_edge, 0]], xy_m[edges[of_edge, 1]] - xy_m[edges[of_edge, 0]]
    share = ((xy_m[at] - start_m) * along_m).sum(axis=1) / np.maximum((along_m**2).sum(axis=1), 1e-30)
    foot_m = start_m + share[:, None] * along_m
    distance = np.hypot(*(xy_m[at] - foot_m).T)
    inner = np.flatnonzero((share > 0) & (share < 1))
    inner = inner[np.lexsort((of_edge[inner], at[inner], distance[inner]))]
    nodes_involved, edges_involved = np.isin(node, at[inner]), np.isin(edge, of_edge[inner])
    polygons_of = _polygons_of(node[nodes_involved], polygon[nodes_involved])
    polygons_at = _polygons_of(edge[edges_involved], polygon[edges_involved])
    inserted: list[int] = []
    moved: dict[int, np.ndarray] = {}
    for i in inner.tolist():
        k, e = int(at[i]), int(of_edge[i])
        if polygons_of[k] & polygons_at[e]:
            continue
        polygons_of[k] |= polygons_at[e]
        inserted.append(i)
        moved.setdefault(k, foot_m[i])
    xy_m = xy_m.copy()
    for k, foot in moved.items():
        xy_m[k] = foot
    # each vertex of a ring, followed by the nodes inserted in the edge from it, in the order of the ring
    rows = np.array(inserted, int)
    by_edge = rows[np.argsort(of_edge[rows], kind="stable")]
    low, high = np.searchsorted(of_edge[by_edge], edge), np.searchsorted(of_edge[by_edge], edge, side="right")
    counts = high - low
    source = by_edge[np.repeat(low - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())]
    vertex = np.repeat(np.arange(len(node)), counts)
    forward = node[vertex] == edges[edge[vertex], 0]
    place = np.concatenate([np.arange(len(node)), vertex])
    key = np.concatenate([np.full(len(node), -np.inf), np.where(forward, share[source], -share[source])])
    order = np.lexsort((key, place))
    all_nodes = np.concatenate([node, at[source]])[order]
    num_added = np.concatenate([[0], np.cumsum(counts)])[ring_offset]
    all_ends = np.concatenate([input_end, input_end[next_in_ring(ring_offset)[vertex]]])[order]
    return Nodes(xy_m, *without_repeats(all_nodes, ring_offset + num_added, all_ends))
