"""Edges of walls on one plane, split so that they meet in common points only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from p2wss.reconstruction.skin.solids import LEVEL_M, TOLERANCE_M, Face, tidy
from p2wss.skeleton.groups import groups
from p2wss.skeleton.nearest import nearest

_MAX_ROUNDS = 12
# segments at a smaller angle than this count as parallel: points on them are what they have in common
_PARALLEL = 1e-9

Edge = tuple[int, int]
# (segment, the way along it in metres, the point on it), each (n,)
Contacts = tuple[np.ndarray, np.ndarray, np.ndarray]


def node(point: np.ndarray, faces: Sequence[Face], walls: Sequence[int]) -> np.ndarray:
    """Split the edges of ``walls`` at points that lie on them and where they cross, in all faces that have the edge.

    Returns the points with those at crossings appended. An edge stays within the tolerance of its line.
    """
    for _ in range(_MAX_ROUNDS):
        segment = np.array(
            sorted({edge for wall in walls for ring in faces[wall].rings for edge in ring_edges(ring)})
        )
        if not len(segment):
            break
        ends = point[segment]
        low, high = ends.min(axis=1) - TOLERANCE_M, ends.max(axis=1) + TOLERANCE_M
        boxes = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
        tree = shapely.STRtree(boxes)
        contacts = _points_on(point, segment, tree)
        if not len(contacts[0]):
            i, j = tree.query(boxes)
            contacts, point = _crossings(point, segment, i[i < j], j[i < j])
        if not len(contacts[0]):
            break
        split: dict[Edge, list[int]] = {}
        number, at, vertex = contacts
        order = np.lexsort([vertex, at, number])
        for (a, b), v in zip(segment[number[order]].tolist(), vertex[order].tolist(), strict=True):
            split.setdefault((a, b), []).append(v)
        for face in faces:
            _apply(face, split)
    return point


def ring_edges(ring: Sequence[int]) -> list[Edge]:
    """The edges of a ring, each with the smaller number first."""
    return [(a, b) if a < b else (b, a) for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]


def _points_on(point: np.ndarray, segment: np.ndarray, tree: shapely.STRtree) -> Contacts:
    """The ends of other segments that lie on segments, between their ends. tree: of their boxes in plan."""
    ends = np.unique(segment)
    at_end, number = tree.query(shapely.points(point[ends, :2]))
    vertex = ends[at_end]
    start = point[segment[number, 0]]
    along, to_vertex = point[segment[number, 1]] - start, point[vertex] - start
    length = np.linalg.norm(along, axis=1)
    at = (to_vertex * along).sum(axis=1) / length
    aside = np.linalg.norm(to_vertex - (at / length)[:, None] * along, axis=1)
    on = (vertex[:, None] != segment[number]).all(axis=1) & (at > 0) & (at < length) & (aside <= TOLERANCE_M)
    # what is beside an upright edge, but not over its place, is where a steep edge crosses another
    on &= (along[:, :2] != 0).any(axis=1) | (to_vertex[:, :2] == 0).all(axis=1)
    return number[on], at[on], vertex[on]


def _crossings(
    point: np.ndarray, segment: np.ndarray, i: np.ndarray, j: np.ndarray
) -> tuple[Contacts, np.ndarray]:
    """Where segments ``i`` and ``j`` cross between their ends, and all points."""
    p, q = point[segment[i, 0]], point[segment[j, 0]]
    u, v = point[segment[i, 1]] - p, point[segment[j, 1]] - q
    w = q - p
    uu, uv, vv = (u * u).sum(axis=1), (u * v).sum(axis=1), (v * v).sum(axis=1)
    uw, vw = (u * w).sum(axis=1), (v * w).sum(axis=1)
    determinant = uu * vv - uv * uv
    crossing = determinant > _PARALLEL * uu * vv
    safe = np.where(crossing, determinant, 1)
    s, t = (vv * uw - uv * vw) / safe, (uv * uw - uu * vw) / safe
    on_first, on_second = p + s[:, None] * u, q + t[:, None] * v
    apart = np.linalg.norm(on_first - on_second, axis=1)
    crossing &= (s > 0) & (s < 1) & (t > 0) & (t < 1) & (apart <= TOLERANCE_M)
    place = (on_first + on_second)[crossing] / 2
    # over one place of the plan, a vertical edge keeps its x and y
    for vector, start in ((u, p), (v, q)):
        upright = np.hypot(vector[crossing, 0], vector[crossing, 1]) <= TOLERANCE_M
        place[upright, :2] = start[crossing][upright, :2]
    used, scale = np.unique(segment), np.array([1, 1, TOLERANCE_M / LEVEL_M])
    away, found = nearest(point[used] * scale, place * scale)
    vertex = used[found[:, 0]]
    # new points at one place are one, the lexicographically smallest, whatever the order of the segments
    fresh = np.flatnonzero(away[:, 0] > TOLERANCE_M)
    if len(fresh):
        fresh = fresh[np.lexsort(place[fresh].T[::-1])]
        plan = np.asarray(shapely.points(place[fresh, :2]), object)
        near = shapely.STRtree(plan).query(plan, predicate="dwithin", distance=TOLERANCE_M)
        between = (place[fresh[near[0]]] - place[fresh[near[1]]]) * scale
        is_near = np.linalg.norm(between, axis=1) <= TOLERANCE_M
        cluster = groups(len(fresh), near.T[is_near])
        _, first, cluster = np.unique(cluster, return_index=True, return_inverse=True)
        vertex[fresh] = len(point) + cluster
        point = np.vstack([point, place[fresh[first]]])
    number = np.concatenate([i[crossing], j[crossing]])
    at = np.concatenate([(s * np.sqrt(uu))[crossing], (t * np.sqrt(vv))[crossing]])
    vertex = np.tile(vertex, 2)
    is_new = (vertex[:, None] != segment[number]).all(axis=1)
    return (number[is_new], at[is_new], vertex[is_new]), point


def _apply(face: Face, split: dict[Edge, list[int]]) -> None:
    changed = False
    rings = []
    for ring in face.rings:
        result: list[int] = []
        for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
            between = split.get((a, b)) or split.get((b, a), [])[::-1]
            changed |= bool(between)
            result += [a, *between]
        rings.append(result)
    if changed:
        face.rings = [ring for ring in map(tidy, rings) if ring]
        face.triangles = None
