"""Where roofs end beside the edges of a footprint, and walls that move inwards where open ground lies within it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS

# shorter edges stay; points this near to the ends of an edge may belong to the next wall
_MIN_EDGE_M, _AT_CORNER_M = 2.0, 0.5
_BIN_M = 1.0
# the roof behind an edge is a line through the median heights of the points at these distances from it, no steeper
# than this
_NEAR_M, _MIDDLE_M, _FAR_M, _STEEPEST = 1.0, 2.0, 3.0, 1.5
# points further below it are on a wall or on the ground
_BELOW_ROOF_M = 0.7
_MIN_POINTS, _MIN_BINS_SHARE = 3, 0.6
# a wall is moved by at least this much; a quarter of the bins at most may show less
_MIN_SHIFT_M = 0.3
# an edge of at least this length is turned if that reduces the mean distance to where the roof begins to this share
_MIN_TURNED_M, _TURNED_RATIO = 5.0, 0.7
# what remains of an edge at least
_MIN_REMAINING_M = 0.5
# Beyond the wall is open ground: it has at least this share of the points between the wall and the edge, and within
# this distance beyond the edge at most so many points are of buildings for each of the ground. In a row of houses, a
# neighbour's wall or lower roof is there instead.
_GROUND_SHARE, _BEYOND_M, _MOST_BUILDING = 0.2, 1.0, 0.25
# an overhang has at least so many points of the ground beyond it; points further out than this are not at hand
_MIN_GROUND_POINTS, _MAX_OVERHANG_M = 3, 1.0
# the points of the building this near to the end of the roof are of the same edge
_NEAR_EDGE_M = 0.1
# nearly straight corners cannot be found from the lines of their edges
_MIN_TURN = 0.2


def move_walls(
    rings: Sequence[np.ndarray],
    roof_point_m: np.ndarray,
    point_m: np.ndarray,
    classification: np.ndarray,
    max_shift_m: float,
) -> list[np.ndarray]:
    """The rings with edges of the exterior moved inwards to where the points of the building (k, 3) begin, by at most
    ``max_shift_m``. The number of vertices stays, and those between edges that stay.

    Only an edge moves along which there is open ground instead of a roof, so never a party wall. point_m (m, 3),
    classification (m,): all points in and around the footprint.
    """
    ring = rings[0]
    if max_shift_m < _MIN_SHIFT_M or len(roof_point_m) < _MIN_POINTS:
        return list(rings)
    ground_m, building_m = (point_m[classification == each, :2] for each in (GROUND_CLASS, BUILDING_CLASS))
    after = np.roll(ring, -1, axis=0)
    # of the start and the end of each edge
    shift_m = np.zeros((len(ring), 2))
    for i, ends in enumerate(zip(ring, after, strict=True)):
        if not _is_open(*ends, max_shift_m, ground_m, building_m, 0.0):
            continue
        shifts = _shifts_m(*ends, roof_point_m, max_shift_m)
        if shifts.any() and _is_open(*ends, float(shifts.mean()), ground_m, building_m, _GROUND_SHARE):
            shift_m[i] = shifts
    if not shift_m.any():
        return list(rings)
    # a short edge between two that move, the chamfer of a corner, moves with them
    for i in np.flatnonzero(np.linalg.norm(after - ring, axis=1) < _MIN_EDGE_M).tolist():
        beside = shift_m[i - 1, 1], shift_m[(i + 1) % len(ring), 0]
        shift_m[i] = min(beside, key=abs) if beside[0] * beside[1] > 0 else 0.0
    moved = _moved_ring(ring, shift_m, 2 * max_shift_m)
    polygon, original = shapely.Polygon(moved, rings[1:]), shapely.Polygon(ring, rings[1:])
    if not polygon.is_valid or polygon.area < 0.5 * original.area:
        return list(rings)
    return [moved, *rings[1:]]


def _moved_ring(ring: np.ndarray, shift_m: np.ndarray, most_m: float) -> np.ndarray:
    """The ring (n, 2) after the start and the end of each edge have moved inwards by ``shift_m`` (n, 2). An edge
    stays where it would move a corner by more than ``most_m``, or turn an edge round or leave hardly anything of
    it."""
    after = np.roll(ring, -1, axis=0)
    length = np.linalg.norm(after - ring, axis=1, keepdims=True)
    along = (after - ring) / length
    inward = np.column_stack([-along[:, 1], along[:, 0]])
    shift_m = shift_m.copy()
    while shift_m.any():
        start, end = ring + shift_m[:, :1] * inward, after + shift_m[:, 1:] * inward
        direction = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
        normal = np.column_stack([-direction[:, 1], direction[:, 0]])
        moved = ring.copy()
        for i in range(len(ring)):
            if shift_m[i - 1].any() or shift_m[i].any():
                matrix = normal[[i - 1, i]]
                shifts = np.array([(end[i - 1] - ring[i]) @ matrix[0], (start[i] - ring[i]) @ matrix[1]])
                if abs(np.linalg.det(matrix)) < _MIN_TURN:
                    shifts[:] = shifts[np.abs(shifts).argmin()]
                moved[i] += np.linalg.lstsq(matrix, shifts)[0]
        remaining = ((np.roll(moved, -1, axis=0) - moved) * along).sum(axis=1)
        too_short = np.flatnonzero(remaining <= np.minimum(_MIN_REMAINING_M, 0.5 * length[:, 0]))
        too_far = np.flatnonzero(np.linalg.norm(moved - ring, axis=1) > most_m)
        stays = np.concatenate([too_short - 1, too_short, too_short + 1, too_far - 1, too_far]) % len(ring)
        if not len(stays):
            return moved
        if not shift_m[stays].any():
            break
        shift_m[stays] = 0.0
    return ring


def overhangs_m(ring: np.ndarray, point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """How far the roof of class building reaches beyond each edge (e, 2), negative where it ends within; NaN where the
    points do not show it, as along party walls: the ground must begin where the roof ends, within 1 m of the edge.

    ring: (e, 2), counter-clockwise. point_m (m, 3), classification (m,): all points up to 1 m around the footprint.
    """
    building_m, ground_m = (point_m[classification == each] for each in (BUILDING_CLASS, GROUND_CLASS))
    result = np.full(len(ring), np.nan)
    if len(building_m) < _MIN_POINTS or len(ground_m) < _MIN_GROUND_POINTS:
        return result
    for i, (start, end) in enumerate(zip(ring, np.roll(ring, -1, axis=0), strict=True)):
        length = float(np.hypot(*(end - start)))
        along = (end - start) / length
        depths_m = []
        for xy_m in (building_m[:, :2], ground_m[:, :2]):
            place, depth = (xy_m - start) @ along, (xy_m - start) @ np.array([-along[1], along[0]])
            depths_m.append(depth[(place > _AT_CORNER_M) & (place < length - _AT_CORNER_M)])
        # without ground, as along party walls, there is nothing to find
        if ((depths_m[1] >= -_MAX_OVERHANG_M) & (depths_m[1] < _FAR_M)).sum() < _MIN_GROUND_POINTS:
            continue
        _, begins_m = _begins_m(start, end, building_m, -_MAX_OVERHANG_M)
        if not len(begins_m):
            continue
        # the roof ends a little beyond its last point: half of these gaps are longer than ln 2 over the density
        num_behind = int(((depths_m[0] > _NEAR_M) & (depths_m[0] < _FAR_M)).sum())
        gap_m = np.log(2) * (_FAR_M - _NEAR_M) * (length - 2 * _AT_CORNER_M) / max(num_behind, 1)
        reach_m = min(float(gap_m - np.median(begins_m)), _MAX_OVERHANG_M)
        outer_m = -reach_m - _NEAR_EDGE_M
        beyond = [int(((depth < outer_m) & (depth >= -_MAX_OVERHANG_M)).sum()) for depth in depths_m[::-1]]
        if beyond[0] >= _MIN_GROUND_POINTS and beyond[1] <= _MOST_BUILDING * beyond[0]:
            result[i] = reach_m
    return result


def mean_overhang_m(ring: np.ndarray, point_m: np.ndarray, classification: np.ndarray) -> float:
    """The mean of :func:`overhangs_m` over the length of the edges that show one; NaN if none does."""
    overhang_m = overhangs_m(ring, point_m, classification)
    is_known = np.isfinite(overhang_m)
    if not is_known.any():
        return float("nan")
    length_m = np.hypot(*(np.roll(ring, -1, axis=0) - ring).T)
    return float(np.average(overhang_m[is_known], weights=length_m[is_known]))


def _shifts_m(start: np.ndarray, end: np.ndarray, point_m: np.ndarray, max_shift_m: float) -> np.ndarray:
    """How far behind the start and the end of an edge the roof begins, zeros where it does so at the edge or where that
    is not clear."""
    at, begins_m = _begins_m(start, end, point_m, 0.0)
    if not len(begins_m):
        return np.zeros(2)
    level_m = float(np.median(begins_m))
    first, second = np.triu_indices(len(at), 1)
    is_far = at[second] - at[first] > 0.3
    if np.hypot(*(end - start)) >= _MIN_TURNED_M and is_far.any():
        # the drawn edge may be turned against the wall: the median of the slopes of all pairs is robust
        slopes_m = (begins_m[second] - begins_m[first])[is_far] / (at[second] - at[first])[is_far]
        rise_m = float(np.median(slopes_m))
        ends_m = float(np.median(begins_m - rise_m * at)) + rise_m * np.array([0.0, 1.0])
        turned, straight = (np.abs(begins_m - line).mean() for line in (ends_m[0] + rise_m * at, level_m))
        if turned < _TURNED_RATIO * straight and ends_m.max() >= _MIN_SHIFT_M:
            return np.clip(ends_m, 0.0, max_shift_m)
    if np.quantile(begins_m, 0.25) < _MIN_SHIFT_M:
        return np.zeros(2)
    return np.full(2, min(level_m, max_shift_m))


def _begins_m(
    start: np.ndarray, end: np.ndarray, point_m: np.ndarray, least_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """(place along the edge from 0 to 1, how far behind it the roof begins there, ``least_m`` or more) for each metre
    of its length; empty where too few show it."""
    length = float(np.hypot(*(end - start)))
    if length < _MIN_EDGE_M:
        return np.zeros(0), np.zeros(0)
    along = (end - start) / length
    offset = point_m[:, :2] - start
    place, depth = offset @ along, offset @ np.array([-along[1], along[0]])
    near = (place > _AT_CORNER_M) & (place < length - _AT_CORNER_M) & (depth > least_m) & (depth < _FAR_M)
    place, depth, z = place[near] - _AT_CORNER_M, depth[near], point_m[near, 2]
    num_bins = max(1, int((length - 2 * _AT_CORNER_M) / _BIN_M))
    number = np.minimum((place * num_bins / (length - 2 * _AT_CORNER_M)).astype(int), num_bins - 1)
    at, begins_m = [], []
    for k in range(num_bins):
        here = number == k
        bands = [here & (depth > low) & (depth <= low + 1.0) for low in (_NEAR_M, _MIDDLE_M)]
        if min(band.sum() for band in bands) >= _MIN_POINTS:
            height_m, next_m = (_median(z[band]) for band in bands)
            slope = min(max(next_m - height_m, 0.0), _STEEPEST)
            roof_m = height_m + slope * (depth - (_NEAR_M + 0.5))
            at.append((k + 0.5) / num_bins)
            begins_m.append(depth[here & (z > roof_m - _BELOW_ROOF_M)].min())
    if len(begins_m) < _MIN_BINS_SHARE * num_bins:
        return np.zeros(0), np.zeros(0)
    return np.array(at), np.array(begins_m)


def _median(value: np.ndarray) -> float:
    ordered = np.sort(value)  # numpy's own takes several times as long for a few values
    return float(ordered[(len(value) - 1) // 2] + ordered[len(value) // 2]) / 2


def _is_open(
    start: np.ndarray,
    end: np.ndarray,
    shift_m: float,
    ground_m: np.ndarray,
    building_m: np.ndarray,
    ground_share: float,
) -> bool:
    """Whether points (n, 2) of the ground and of the building show open ground on both sides of an edge: more than
    ``ground_share`` of the points within it are of the ground."""
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    inside, beyond = [], []
    for xy_m in (ground_m, building_m):
        place, depth = (xy_m - start) @ along, (xy_m - start) @ np.array([-along[1], along[0]])
        near = (place > _AT_CORNER_M) & (place < length - _AT_CORNER_M)
        inside.append(int((near & (depth > 0) & (depth < shift_m)).sum()))
        if not inside[0]:
            return False
        beyond.append(int((near & (depth < 0) & (depth > -_BEYOND_M)).sum()))
    return inside[0] > ground_share * sum(inside) and beyond[1] <= _MOST_BUILDING * beyond[0]
