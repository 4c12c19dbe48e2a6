"""Where roofs end beside the edges of a footprint, and walls that move inwards where open ground lies within it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely

from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS
from p2wss.fit.directions import edge_ends
from p2wss.fit.points import median
from p2wss.skeleton import ordering
from p2wss.skeleton.compiled import ZERO, both, entry


class Rules(NamedTuple):
    """Where a roof ends beside an edge, and which edges move; all set by hand from what clouds of real houses show.

    min_edge_m: shorter edges stay. at_corner_m: points this near to the ends of an edge may belong to the next wall.
    bin_m: the end of the roof is sought for each piece of an edge of this length. bands_m: the roof behind an edge is a
    line through the median heights of the points at these distances from the edge, no steeper than the tangent
    ``steepest``. below_roof_m: points further below this line are on a wall or on the ground. min_points: the least
    number in each band. min_bins_share: the least share of the pieces of an edge that show the end of the roof.

    min_shift_m: a wall is moved by at least this much. min_remaining_m: the least length that remains of an edge.
    min_turn: the least sine of the turn at a corner for which the corner is where the lines of its edges meet.

    ground_share, beyond_m, most_building: beyond a wall that moves is open ground. More than ``ground_share`` of the
    points between the wall and the edge are of the ground. Up to ``beyond_m`` beyond the edge, there are at most
    ``most_building`` points of buildings for each point of the ground; further out, no points are at hand. In a row of
    houses, a neighbour's wall or lower roof is there instead. near_edge_m: points of the building this near to the end
    of the roof belong to the same edge.
    """

    min_edge_m: float = 2.0
    at_corner_m: float = 0.5
    bin_m: float = 1.0
    bands_m: tuple[float, float, float] = (1.0, 2.0, 3.0)
    steepest: float = 1.5
    below_roof_m: float = 0.7
    min_points: int = 3
    min_bins_share: float = 0.6
    min_shift_m: float = 0.3
    min_remaining_m: float = 0.5
    min_turn: float = 0.2
    ground_share: float = 0.2
    beyond_m: float = 1.0
    most_building: float = 0.25
    near_edge_m: float = 0.1


RULES = Rules()
_NEAR_M, _MIDDLE_M, _FAR_M = RULES.bands_m
_AT_CORNER_M = RULES.at_corner_m
# a network's footprint may have a vertex twice: the edge between has no direction, and stays
_LEAST_M = 1e-9


def move_walls(
    rings: Sequence[np.ndarray],
    roof_point_m: np.ndarray,
    point_m: np.ndarray,
    classification: np.ndarray,
    max_shift_m: float,
) -> list[np.ndarray]:
    """The rings with edges of the exterior moved inwards to where the points of the building (k, 3) begin, by at most
    ``max_shift_m``. The number of vertices stays the same, and vertices between two edges that stay do not move.

    Only an edge moves along which there is open ground instead of a roof, so never a party wall. point_m (m, 3),
    classification (m,): all points in and around the footprint.
    """
    ring = rings[0]
    ground_m, building_m = (point_m[classification == each, :2] for each in (GROUND_CLASS, BUILDING_CLASS))
    after = edge_ends([ring])[:, 1]
    shift_m = np.zeros(len(ring))
    for i, ends in enumerate(zip(ring, after, strict=True)):
        # first, as it is found in less time than where the roof begins
        if _is_open(*ends, max_shift_m, ground_m, building_m, 0.0):
            begins_m = _begins_m(*ends, roof_point_m, 0.0)
            within_m = min(median(begins_m), max_shift_m) if len(begins_m) else 0.0
            is_far = within_m >= RULES.min_shift_m
            if is_far and _is_open(*ends, within_m, ground_m, building_m, RULES.ground_share):
                shift_m[i] = within_m
    # a short edge between two edges that move, such as the chamfer of a corner, moves with them
    for i in np.flatnonzero(np.linalg.norm(after - ring, axis=1) < RULES.min_edge_m).tolist():
        shift_m[i] = min(shift_m[i - 1], shift_m[(i + 1) % len(ring)])
    moved = _moved_ring(ring, shift_m, 2 * max_shift_m)
    polygon, original = shapely.Polygon(moved, rings[1:]), shapely.Polygon(ring, rings[1:])
    if not polygon.is_valid or polygon.area < 0.5 * original.area:
        return list(rings)
    return [moved, *rings[1:]]


def _moved_ring(ring: np.ndarray, shift_m: np.ndarray, most_m: float) -> np.ndarray:
    """The ring (n, 2) after its edges have moved inwards by ``shift_m`` (n,), without turning. An edge stays if it
    would move a corner by more than ``most_m``, or make another edge or itself too short."""
    after = edge_ends([ring])[:, 1]
    length = np.linalg.norm(after - ring, axis=1)
    along = (after - ring) / np.maximum(length, _LEAST_M)[:, None]
    inward = np.column_stack([-along[:, 1], along[:, 0]])
    shift_m = shift_m.copy()
    while shift_m.any():
        moved = ring.copy()
        for i in range(len(ring)):
            shifts, matrix = shift_m[[i - 1, i]], inward[[i - 1, i]]
            if abs(np.linalg.det(matrix)) < RULES.min_turn:
                shifts = np.full(2, shifts.min())
            moved[i] += np.linalg.lstsq(matrix, shifts)[0]
        remaining = ((edge_ends([moved])[:, 1] - moved) * along).sum(axis=1)
        too_short = np.flatnonzero(remaining <= np.minimum(RULES.min_remaining_m, 0.5 * length))
        too_far = np.flatnonzero(np.linalg.norm(moved - ring, axis=1) > most_m)
        stays = np.concatenate([too_short - 1, too_short, too_short + 1, too_far - 1, too_far]) % len(ring)
        if not len(stays):
            return moved
        if not shift_m[stays].any():
            break
        shift_m[stays] = 0.0
    return ring


def overhangs_m(ring: np.ndarray, point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """How far the roof of class building reaches beyond each edge (e, 2), metres; negative where it ends within. NaN
    where the points do not show it, as along party walls: the ground must begin where the roof ends, within 1 m of the
    edge.

    ring: (e, 2), counter-clockwise. point_m (m, 3), classification (m,): all points up to 1 m around the footprint.
    """
    building_m, ground_m = (point_m[classification == each] for each in (BUILDING_CLASS, GROUND_CLASS))
    result, after = np.full(len(ring), np.nan), edge_ends([ring])[:, 1]
    for i in np.flatnonzero(np.linalg.norm(after - ring, axis=1) >= RULES.min_edge_m).tolist():
        start, end = ring[i], after[i]
        begins_m = _begins_m(start, end, building_m, -RULES.beyond_m)
        if not len(begins_m):
            continue
        ground_depth_m, depth_m = (_beside(start, end, each)[1] for each in (ground_m, building_m))
        # the roof ends a little beyond its last point: the median of this gap is ln 2 over the density
        num_behind = int(((depth_m > _NEAR_M) & (depth_m < _FAR_M)).sum())
        inner_length_m = np.hypot(*(end - start)) - 2 * _AT_CORNER_M
        gap_m = math.log(2) * (_FAR_M - _NEAR_M) * inner_length_m / max(num_behind, 1)
        reach_m = min(float(gap_m - median(begins_m)), RULES.beyond_m)
        outer_m = -reach_m - RULES.near_edge_m
        num_ground, num_building = (
            int(((depth < outer_m) & (depth >= -RULES.beyond_m)).sum()) for depth in (ground_depth_m, depth_m)
        )
        if num_ground >= RULES.min_points and num_building <= RULES.most_building * num_ground:
            result[i] = reach_m
    return result


def mean_overhang_m(ring: np.ndarray, point_m: np.ndarray, classification: np.ndarray) -> float:
    """The mean of :func:`overhangs_m` over the length of the edges that show one; NaN if none does."""
    overhang_m = overhangs_m(ring, point_m, classification)
    is_known = np.isfinite(overhang_m)
    if not is_known.any():
        return float("nan")
    length_m = np.hypot(*(edge_ends([ring])[:, 1] - ring).T)
    return float((overhang_m * length_m)[is_known].sum() / length_m[is_known].sum())


@both
def _beside(
    start: np.ndarray, end: np.ndarray, point_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(share along the edge from 0 to 1, depth behind the edge in metres, row) of the points (m, 2 or 3) that are
    beside an edge, but not near its ends."""
    length = max(np.hypot(end[0] - start[0], end[1] - start[1]), _LEAST_M)
    x, y = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    share, depth, row = np.empty(len(point_m)), np.empty(len(point_m)), np.empty(len(point_m), np.int64)
    num = 0
    for k in range(len(point_m)):
        to_x, to_y = point_m[k, 0] - start[0], point_m[k, 1] - start[1]
        place_m = to_x * x + to_y * y - _AT_CORNER_M
        if 0 < place_m < length - 2 * _AT_CORNER_M:
            share[num], depth[num], row[num] = place_m / (length - 2 * _AT_CORNER_M), to_y * x - to_x * y, k
            num += 1
    return share[:num], depth[:num], row[:num]


@entry
def _begins_m(start: np.ndarray, end: np.ndarray, point_m: np.ndarray, least_m: float) -> np.ndarray:
    """How far behind an edge the roof begins, ``least_m`` or more, for each piece of the edge that shows it; empty if
    too few pieces do. A piece is ``bin_m`` long."""
    length = np.hypot(end[0] - start[0], end[1] - start[1])
    if length < RULES.min_edge_m:
        return np.zeros(0)
    share, depth, row = _beside(start, end, point_m)
    num_bins = max(1, int((length - 2 * _AT_CORNER_M) / RULES.bin_m))
    begins_m, num_begins = np.empty(num_bins), 0
    near_z, next_z = np.empty(len(row)), np.empty(len(row))
    bins, order = ordering.sorted_by(np.minimum((share * num_bins).astype(np.int64), num_bins - 1), num_bins)
    for number in range(num_bins):
        num_near = num_next = ZERO
        here = order[bins[number] : bins[number + 1]]
        for k in here:
            if _NEAR_M < depth[k] <= _NEAR_M + 1.0:
                near_z[num_near], num_near = point_m[row[k], 2], num_near + 1
            elif _MIDDLE_M < depth[k] <= _MIDDLE_M + 1.0 and depth[k] < _FAR_M:
                next_z[num_next], num_next = point_m[row[k], 2], num_next + 1
        if min(num_near, num_next) < RULES.min_points:
            continue
        height_m = ordering.median(near_z, num_near)
        slope = min(max(ordering.median(next_z, num_next) - height_m, 0.0), RULES.steepest)
        first_m = np.inf
        for k in here:
            roof_m = height_m + slope * (depth[k] - (_NEAR_M + 0.5))
            if least_m < depth[k] < _FAR_M and point_m[row[k], 2] > roof_m - RULES.below_roof_m:
                first_m = min(first_m, depth[k])
        begins_m[num_begins], num_begins = first_m, num_begins + 1
    return begins_m[: num_begins if num_begins >= RULES.min_bins_share * num_bins else 0]


def _is_open(
    start: np.ndarray,
    end: np.ndarray,
    shift_m: float,
    ground_m: np.ndarray,
    building_m: np.ndarray,
    ground_share: float,
) -> bool:
    """Whether points (n, 2) of the ground and of the building show open ground on both sides of an edge. More than
    ``ground_share`` of the points up to ``shift_m`` within the edge must be of the ground."""
    inside, beyond = [], []
    for xy_m in (ground_m, building_m):
        _, depth, _ = _beside(start, end, xy_m)
        inside.append(int(((depth > 0) & (depth < shift_m)).sum()))
        if not inside[0]:
            return False
        beyond.append(int(((depth < 0) & (depth > -RULES.beyond_m)).sum()))
    return inside[0] > ground_share * sum(inside) and beyond[1] <= RULES.most_building * beyond[0]
