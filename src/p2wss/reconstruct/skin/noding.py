"""Edges of walls on one plane, split so that they meet in common points only."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise

import numpy as np
import shapely
from scipy.spatial import cKDTree

from p2wss.mesh.topology import groups
from p2wss.reconstruct.skin.solids import TOLERANCE_M, Face, tidy

_MAX_ROUNDS = 12
# segments at a smaller angle than this count as parallel: points on them are what they have in common
_PARALLEL = 1e-9

Edge = tuple[int, int]
# a segment, the way along it in metres, how far above or below it a point is, the point
Contact = tuple[int, float, float, int]


def node(point: np.ndarray, faces: Sequence[Face], walls: Iterable[int], step_m: float = 0.0) -> np.ndarray:
    """Split the edges of ``walls`` at points that lie on them and where they cross, in all faces that have the edge.

    step_m: an edge also takes in the points of other buildings that it passes up to this far above or below. Returns
    the points with those at crossings appended. Otherwise an edge stays within the tolerance of its line.
    """
    owners: dict[Edge, set[int]] = {}
    for wall in walls:
        for ring in faces[wall].rings:
            for edge in ring_edges(ring):
                owners.setdefault(edge, set()).add(faces[wall].building)
    split, point = split_edges(point, owners, step_m)
    if split:
        for face in faces:
            _apply(face, split)
    return point


def ring_edges(ring: Sequence[int]) -> list[Edge]:
    """The edges of a ring, each with the smaller number first."""
    return [(a, b) if a < b else (b, a) for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]


def split_edges(
    point: np.ndarray, owners: dict[Edge, set[int]], step_m: float = 0.0
) -> tuple[dict[Edge, list[int]], np.ndarray]:
    """For edges that meet others, the points from one end to the other, and all points with the new ones appended.

    owners: for every edge, smaller number first, the buildings that it belongs to.
    """
    chain: dict[Edge, list[int]] = {edge: [*edge] for edge in owners}
    of_point: dict[int, set[int]] = {}
    for edge, buildings in owners.items():
        for vertex in edge:
            of_point.setdefault(vertex, set()).update(buildings)
    for _ in range(_MAX_ROUNDS):
        segments: dict[Edge, set[int]] = {}
        for key, line in chain.items():
            for a, b in pairwise(line):
                segments.setdefault((a, b) if a < b else (b, a), set()).update(owners[key])
        if not segments:
            break
        inserted, point = _insertions(point, segments, of_point, step_m)
        if not inserted:
            break
        for edge, vertices in inserted.items():
            for vertex in vertices:
                of_point.setdefault(vertex, set()).update(segments[edge])
        chain = {key: _extended(line, inserted) for key, line in chain.items()}
    return {key: line for key, line in chain.items() if len(line) > 2}, point


def _insertions(
    point: np.ndarray, segments: dict[Edge, set[int]], of_point: dict[int, set[int]], step_m: float
) -> tuple[dict[Edge, list[int]], np.ndarray]:
    """The points to insert in each segment, in order from its first end, and all points.

    segments, of_point: the buildings of each.
    """
    segment = np.array(sorted(segments))
    ends = point[segment]
    reach = max(step_m, TOLERANCE_M)
    low, high = ends.min(axis=1) - reach, ends.max(axis=1) + reach
    boxes = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    i, j = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    near = (i < j) & (low[i, 2] <= high[j, 2]) & (low[j, 2] <= high[i, 2])
    i, j = i[near], j[near]
    on: list[Contact] = []
    has_point = np.zeros(len(i), bool)
    for first, second in ((i, j), (j, i)):
        for end in (0, 1):
            vertex = segment[first, end]
            at, rest, aside, above = _to_line(point[vertex], ends[second, 0], ends[second, 1])
            outside = (vertex != segment[second, 0]) & (vertex != segment[second, 1])
            # over an end of the edge there is no point of the edge to join
            within = (at > 0) & (rest > 0) & ((np.minimum(at, rest) > TOLERANCE_M) | (above <= TOLERANCE_M))
            hit = outside & within & (aside <= TOLERANCE_M) & (above <= reach)
            for k in np.flatnonzero(hit & (above > TOLERANCE_M)).tolist():
                # a building keeps its own steps
                edge = (int(segment[second[k], 0]), int(segment[second[k], 1]))
                hit[k] = not of_point[int(vertex[k])] & segments[edge]
            has_point |= hit
            columns = (second[hit], at[hit], above[hit], vertex[hit])
            on += zip(*(column.tolist() for column in columns), strict=True)
    if not on:
        separate = (segment[i][:, :, None] != segment[j][:, None, :]).all(axis=(1, 2)) & ~has_point
        on, point = _crossings(point, segment, i[separate], j[separate])
    result: dict[Edge, list[int]] = {}
    for number, contacts in groupby(sorted(set(on)), key=lambda contact: contact[0]):
        # of points over one place, the edge goes through the nearest
        nearest: list[Contact] = []
        for contact in contacts:
            if nearest and contact[1] - nearest[-1][1] <= TOLERANCE_M:
                nearest[-1] = min(nearest[-1], contact, key=lambda c: (c[2], c[3]))
            else:
                nearest.append(contact)
        edge = (int(segment[number, 0]), int(segment[number, 1]))
        result[edge] = list(dict.fromkeys(contact[3] for contact in nearest))
    return result, point


def _crossings(
    point: np.ndarray, segment: np.ndarray, i: np.ndarray, j: np.ndarray
) -> tuple[list[Contact], np.ndarray]:
    """Where segments cross between their ends, and all points."""
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
    if not len(place):
        return [], point
    used = np.unique(segment)
    apart, nearest = cKDTree(point[used]).query(place)
    is_new = apart > TOLERANCE_M
    # new points at one place are one, the lexicographically smallest, whatever the order of the segments
    fresh = np.flatnonzero(is_new)
    fresh = fresh[np.lexsort(place[fresh].T[::-1])]
    number = used[nearest]
    if len(fresh):
        cluster = groups(len(fresh), cKDTree(place[fresh]).query_pairs(TOLERANCE_M, output_type="ndarray"))
        _, first, cluster = np.unique(cluster, return_index=True, return_inverse=True)
        number[fresh] = len(point) + cluster
        point = np.vstack([point, place[fresh[first]]])
    on = [
        (segment_number, at, 0.0, vertex)
        for numbers, shares, lengths in ((i, s, uu), (j, t, vv))
        for segment_number, at, vertex in zip(
            numbers[crossing].tolist(),
            (shares * np.sqrt(lengths))[crossing].tolist(),
            number.tolist(),
            strict=True,
        )
    ]
    on = [contact for contact in on if contact[3] not in segment[contact[0]]]
    return on, point


def _to_line(
    place: np.ndarray, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where lines pass points in plan, or upright lines in height: the way there from the start and on to the end, and
    the distance of the point, aside and in height."""
    along = end - start
    upright = np.hypot(along[:, 0], along[:, 1]) <= TOLERANCE_M
    along_plan = np.where(upright[:, None], along, along * (1, 1, 0))
    length = np.maximum(np.linalg.norm(along_plan, axis=1), 1e-9)
    share = ((place - start) * along_plan).sum(axis=1) / length**2
    apart = place - start - share[:, None] * along
    return share * length, (1 - share) * length, np.hypot(apart[:, 0], apart[:, 1]), np.abs(apart[:, 2])


def _extended(line: list[int], inserted: dict[Edge, list[int]]) -> list[int]:
    result = [line[0]]
    for a, b in pairwise(line):
        between = inserted.get((a, b), []) if a < b else inserted.get((b, a), [])[::-1]
        result += [vertex for vertex in between if vertex not in result]
        result.append(b)
    return result


def _apply(face: Face, split: dict[Edge, list[int]]) -> None:
    changed = False
    rings = []
    for ring in face.rings:
        result: list[int] = []
        for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
            line = split.get((a, b) if a < b else (b, a))
            if line is None:
                result.append(a)
            else:
                changed = True
                result += line[:-1] if a < b else line[:0:-1]
        rings.append(result)
    if changed:
        face.rings = [ring for ring in map(tidy, rings) if ring]
        face.triangles = None
