"""The points that a roof is fitted to."""

import numpy as np
import shapely

from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS, NOISE_CLASSES, PLANT_CLASSES, has_class
from p2wss.data.points import MIN_CLASSIFIED_POINTS
from p2wss.skeleton.groups import cell_neighbours, groups
from p2wss.skeleton.nearest import nearest
from p2wss.skeleton.types import numbered

_CELL_M = 0.5
# Returns from walls, in a cell of the plan of this size: less than this share of its points is within about this height
# of such a return, and two points are at least so far above it.
_WALL_CELL_M, _WALL_SHARE, _SAME_HEIGHT_M, _BELOW_TOP_M = 0.6, 0.25, 0.3, 2.0

# Shafts: areas of at least ``_MIN_SHAFT_M2``, made of discs without points on the roof. The radius of a disc is
# ``_SHAFT_RADIUS_M``, or ``_NUM_GAPS`` distances between points if that is more. At least ``_LOW_SHARE`` of the area is
# near to low points. A point is low if it is ``_BELOW_ROOF_M`` below each of the ``_NUM_BESIDE`` nearest points on the
# roof. The floor is at the ``_FLOOR_QUANTILE`` of the low points. It gets points at ``_FLOOR_STEP`` times the spacing
# of the points, so that it outweighs the few returns from walls.
_MIN_SHAFT_M2, _SHAFT_RADIUS_M, _NUM_GAPS, _LOW_SHARE = 1.5, 0.6, 2.0, 0.2
_FLOOR_STEP = 0.7
_BELOW_ROOF_M, _NUM_BESIDE, _MIN_LOW_POINTS, _FLOOR_QUANTILE = 2.0, 4, 3, 0.2


def _spread(value: np.ndarray) -> np.ndarray:
    """The lower 16 bits of each number with a zero bit between any two."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        value = (value | (value << shift)) & mask
    return value


_SPREAD = _spread(np.arange(1 << 16))


def wall_hits(point_m: np.ndarray) -> np.ndarray:
    """Which of the points (m, 3) on a building are returns from its walls, bool (m,).

    Seen from above, a wall is a column of points at all heights: in a cell of the plan, few points are as high as
    one of them, and some are far above. A low roof beside a wall has most of its cell's points at its height.
    """
    if len(point_m) < MIN_CLASSIFIED_POINTS:
        return np.zeros(len(point_m), bool)
    size = np.array([_WALL_CELL_M, _WALL_CELL_M, _SAME_HEIGHT_M])
    x, y, z = np.floor((point_m - point_m.min(axis=0)) / size).astype(np.int64).T
    _, column = numbered(x * (y.max() + 1) + y)
    count = np.bincount(column)
    height, last = point_m[np.lexsort((point_m[:, 2], column)), 2], np.cumsum(count) - 1
    second_highest_m = height[np.maximum(last - 1, last - count + 1)]
    below = point_m[:, 2] < second_highest_m[column] - _BELOW_TOP_M
    if not below.any():
        return below
    # numbers of levels, with a gap between the levels of two columns
    num_levels = int(z.max()) + 3
    levels, level, num_at = np.unique(column * num_levels + z + 1, return_inverse=True, return_counts=True)
    num_near = num_at.copy()
    touches = np.flatnonzero(np.diff(levels) == 1)
    num_near[touches] += num_at[touches + 1]
    num_near[touches + 1] += num_at[touches]
    return below & (num_near[level] < _WALL_SHARE * count[column])


def ground_points(
    polygon: shapely.Polygon, point_m: np.ndarray, classification: np.ndarray, inside_m: float
) -> np.ndarray:
    """The points (k, 3) of class ground that lie more than ``inside_m`` within the polygon, where a roof would hide
    the ground."""
    ground_m = point_m[classification == GROUND_CLASS]
    return ground_m[shapely.contains_xy(polygon.buffer(-inside_m), ground_m[:, 0], ground_m[:, 1])]


def shaft_points(
    polygon: shapely.Polygon,
    point_m: np.ndarray,
    classification: np.ndarray,
    roof_m: np.ndarray,
    inside_m: float,
) -> np.ndarray:
    """Points (k, 3) on the floors of shafts and other places within the polygon that no roof covers: compact areas
    without points on the roof (r, 3), r >= 4, where points are far below the roof beside them. Points less than
    ``inside_m`` within the polygon do not count, as the building's own walls are seen from outside, too.

    Walls hide most of such a floor, so that it gets twice as many points as a roof, at the height of the low points.
    """
    low_m = point_m[~has_class(classification, (BUILDING_CLASS, *PLANT_CLASSES, *NOISE_CLASSES))]
    low_m = low_m[shapely.contains_xy(polygon.buffer(-inside_m), low_m[:, 0], low_m[:, 1])]
    if len(low_m) < _MIN_LOW_POINTS:
        return np.zeros((0, 3))
    _, beside = nearest(roof_m[:, :2], low_m[:, :2], _NUM_BESIDE)
    low_m = low_m[low_m[:, 2] < roof_m[beside, 2].min(axis=1) - _BELOW_ROOF_M]
    if len(low_m) < _MIN_LOW_POINTS:
        return np.zeros((0, 3))
    gap_m = max(float((polygon.area / len(roof_m)) ** 0.5), _CELL_M / 4)
    start_m, end_m = point_m[:, :2].min(axis=0), point_m[:, :2].max(axis=0)
    step_m = _FLOOR_STEP * gap_m
    x_m, y_m = (np.arange(a, b, step_m) for a, b in zip(start_m, end_m, strict=True))
    is_free = shapely.contains_xy(polygon, x_m[:, None], y_m)
    column, row = np.nonzero(is_free)
    place_m = np.column_stack([x_m[column], y_m[row]])
    # the places that are in a disc without points on the roof
    radius_m = max(_SHAFT_RADIUS_M, _NUM_GAPS * gap_m)
    middle_m = place_m[nearest(roof_m[:, :2], place_m)[0][:, 0] > radius_m]
    if not len(middle_m):
        return np.zeros((0, 3))
    chosen = nearest(middle_m, place_m)[0][:, 0] < radius_m
    place_m, is_free[is_free] = place_m[chosen], chosen
    area_at = np.full(is_free.shape, -1, np.int32)
    area_at[is_free] = area = groups(len(place_m), np.column_stack(cell_neighbours(is_free)))
    cell = np.minimum(np.rint((low_m[:, :2] - start_m) / step_m).astype(int), np.array(is_free.shape) - 1)
    area_of_low = area_at[tuple(cell.T)]
    floors = [np.zeros((0, 3))]
    for number in np.flatnonzero(np.bincount(area) * step_m**2 >= _MIN_SHAFT_M2):
        floor_m, low_z = place_m[area == number], low_m[area_of_low == number, 2]
        is_seen = nearest(low_m[:, :2], floor_m)[0] < radius_m
        if len(low_z) >= _MIN_LOW_POINTS and is_seen.sum() >= _LOW_SHARE * len(floor_m):
            floor_z = np.quantile(low_z, _FLOOR_QUANTILE)
            floors.append(np.column_stack([floor_m, np.full(len(floor_m), floor_z)]))
    return np.concatenate(floors)


def median(value: np.ndarray) -> float:
    """The median of values (n,), at least one."""
    ordered = np.sort(value)  # numpy's own takes several times as long for a few values
    return float(ordered[(len(value) - 1) // 2] + ordered[len(value) // 2]) / 2


def quantile(value: np.ndarray, share: float) -> float:
    """The quantile of some values (n,), interpolated as by numpy, whose own function takes ten times as long for a few
    values. share: 0 to 1."""
    ordered, place = np.sort(value), share * (len(value) - 1)
    low, high = ordered[int(place)], ordered[min(int(place) + 1, len(value) - 1)]
    rest = place % 1
    return float(high - (high - low) * (1 - rest) if rest >= 0.5 else low + (high - low) * rest)


def even_order(point_m: np.ndarray) -> np.ndarray:
    """Indices of points (m, 3) along a space-filling curve, whatever their order in the file. Every k-th point in
    this order makes an even sample."""
    x, y, z = np.ascontiguousarray(point_m.T)
    cell_x, cell_y = (np.floor((each - each.min()) / _CELL_M).astype(np.int64) & 0xFFFF for each in (x, y))
    return np.lexsort((z, y, x, _SPREAD[cell_x] | (_SPREAD[cell_y] << 1)))


def every_kth(num_points: int, max_count: int) -> np.ndarray:
    """At most ``max_count`` of the indices 0 to ``num_points`` - 1, evenly spaced."""
    if num_points <= max_count:
        return np.arange(num_points)
    return ((np.arange(max_count) + 0.5) * num_points / max_count).astype(np.int64)
