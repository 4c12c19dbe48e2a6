"""Edges of walls on one plane, split so that they meet in common points only."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
import shapely
from scipy.spatial import cKDTree

from p2wss.reconstruct.skin.solids import TOLERANCE_M, Face, tidy

_MAX_ROUNDS = 12
# segments at a smaller angle than this count as parallel: points on them are what they have in common
_PARALLEL = 1e-9

Edge = tuple[int, int]


def node(point: np.ndarray, faces: Sequence[Face], walls: Iterable[int], step_m: float = 0.0) -> np.ndarray:
    """Split the edges of ``walls`` at points that lie on them and where they cross, in all faces that have the edge.

    Returns the points with those at crossings appended. An edge that is split stays within the tolerance of its line.
    """
    chain: dict[Edge, list[int]] = {}
    for wall in walls:
        for ring in faces[wall].rings:
            for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
                key = (a, b) if a < b else (b, a)
                chain[key] = [*key]
    for _ in range(_MAX_ROUNDS):
        segments = {(a, b) if a < b else (b, a) for line in chain.values() for a, b in pairwise(line)}
        if not segments:
            break
        inserted, point = _insertions(point, np.array(sorted(segments)), max(step_m, TOLERANCE_M))
        if not inserted:
            break
        chain = {key: _extended(line, inserted) for key, line in chain.items()}
    split = {key: line for key, line in chain.items() if len(line) > 2}
    if split:
        for face in faces:
            _apply(face, split)
    return point


def _insertions(
    point: np.ndarray, segment: np.ndarray, step_m: float
) -> tuple[dict[Edge, list[int]], np.ndarray]:
    """The points to insert in each segment, in order from its first end, and all points."""
    ends = point[segment]
    low, high = ends.min(axis=1) - step_m, ends.max(axis=1) + step_m
    boxes = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    i, j = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    near = (i < j) & (low[i, 2] <= high[j, 2]) & (low[j, 2] <= high[i, 2])
    i, j = i[near], j[near]
    on: list[tuple[int, float, int]] = []
    has_point = np.zeros(len(i), bool)
    for first, second in ((i, j), (j, i)):
        for end in (0, 1):
            vertex = segment[first, end]
            share, apart = _to_line(point[vertex], ends[second, 0], ends[second, 1], step_m)
            outside = (vertex != segment[second, 0]) & (vertex != segment[second, 1])
            hit = outside & (share > 0) & (share < 1) & (apart <= TOLERANCE_M)
            has_point |= hit
            on += zip(second[hit].tolist(), share[hit].tolist(), vertex[hit].tolist(), strict=True)
    if not on:
        separate = (segment[i][:, :, None] != segment[j][:, None, :]).all(axis=(1, 2)) & ~has_point
        on, point = _crossings(point, segment, i[separate], j[separate])
    result: dict[Edge, list[int]] = {}
    for number, _, vertex in sorted(set(on)):
        line = result.setdefault((int(segment[number, 0]), int(segment[number, 1])), [])
        if vertex not in line:
            line.append(vertex)
    return result, point


def _crossings(
    point: np.ndarray, segment: np.ndarray, i: np.ndarray, j: np.ndarray
) -> tuple[list[tuple[int, float, int]], np.ndarray]:
    """Where segments cross between their ends: (segment, share of its length, point), and all points."""
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
    known, nearest = cKDTree(point[used]).query(place)
    order = np.lexsort(place.T[::-1])
    number = np.full(len(place), -1)
    number[known <= TOLERANCE_M] = used[nearest[known <= TOLERANCE_M]]
    extra: list[np.ndarray] = []
    for k in order[number[order] < 0].tolist():
        for m, other in enumerate(extra):
            if np.linalg.norm(other - place[k]) <= TOLERANCE_M:
                number[k] = len(point) + m
                break
        else:
            number[k] = len(point) + len(extra)
            extra.append(place[k])
    on = [
        *zip(i[crossing].tolist(), s[crossing].tolist(), number.tolist(), strict=True),
        *zip(j[crossing].tolist(), t[crossing].tolist(), number.tolist(), strict=True),
    ]
    on = [entry for entry in on if entry[2] not in segment[entry[0]]]
    return on, np.concatenate([point, *(place[None] for place in extra)])


def _to_line(
    place: np.ndarray, start: np.ndarray, end: np.ndarray, step_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where lines pass points in plan, upright ones in height: the share of the way from start to end, and the distance
    there, of which a height of ``step_m`` counts as the tolerance."""
    along = end - start
    upright = np.hypot(along[:, 0], along[:, 1]) <= TOLERANCE_M
    along_plan = np.where(upright[:, None], along, along * (1, 1, 0))
    share = ((place - start) * along_plan).sum(axis=1) / np.maximum((along_plan**2).sum(axis=1), 1e-18)
    apart = place - start - share[:, None] * along
    return share, np.maximum(np.hypot(apart[:, 0], apart[:, 1]), np.abs(apart[:, 2]) * TOLERANCE_M / step_m)


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
