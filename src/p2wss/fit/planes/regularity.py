"""Planes made regular where the points allow it: level, along a direction of the footprint, equally steep, the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss.fit.directions import turn_between
from p2wss.fit.planes.detection import RoofPlanes, fit, mean_distance
from p2wss.fit.settings import Detection
from p2wss.skeleton.angles import bearings
from p2wss.skeleton.compiled import allocating, entry
from p2wss.skeleton.ordering import median, sorted_by

# tangents: of a slope that may be level, and of a difference between slopes that may be equal
_NEARLY_LEVEL, _NEARLY_EQUAL = 0.14, 0.06
# radians: a slope that differs less from a direction of the footprint may be along it
_NEARLY_ALONG = np.radians(8)


def regular(planes: RoofPlanes, point_m: np.ndarray, along: Sequence[float]) -> np.ndarray:
    """Regular planes (k, 3) near to the detected planes. Some of them are the same. along: directions of the footprint,
    radians."""
    bearing = bearings(planes.plane[:, :2])
    turns = turn_between(bearing[:, None], np.array(along))
    turn = turns[np.arange(len(turns)), np.abs(turns).argmin(axis=1)]
    towards = np.where(np.abs(turn) < _NEARLY_ALONG, bearing - turn, np.nan)
    return np.asarray(_regular(planes.plane, planes.label, point_m, towards, planes.settings))


@entry
def _regular(
    plane: np.ndarray, label: np.ndarray, point_m: np.ndarray, towards: np.ndarray, settings: Detection
) -> np.ndarray:
    """:func:`regular`, compiled. towards: (k,), the direction along which each plane may rise, radians; NaN for
    none."""
    begin, order = sorted_by(label, len(plane))
    rows_of = [order[begin[i] : begin[i + 1]] for i in range(len(plane))]
    result = plane.copy()
    for i, rows in enumerate(rows_of):
        most_m = mean_distance(plane[i], point_m, rows) + settings.simpler_m
        level = _at_median(np.zeros(3), point_m, rows)
        if (
            np.hypot(plane[i, 0], plane[i, 1]) < _NEARLY_LEVEL
            and mean_distance(level, point_m, rows) < most_m
        ):
            result[i] = level
            continue
        if not np.isnan(towards[i]):
            turned = _along(point_m, rows, towards[i], settings.noise_m)
            if mean_distance(turned, point_m, rows) < most_m:
                result[i] = turned
    size = np.diff(begin)
    by_size = sorted_by(size.max() - size, size.max() + 1)[1]
    result = _equally_steep(result, point_m, rows_of, by_size, settings.simpler_m)
    for i, other in enumerate(_same(result, point_m, rows_of, by_size, settings.simpler_m)):
        # a plane that others are replaced by is not replaced itself
        result[i] = result[other]
    return result


@allocating
def _at_median(plane: np.ndarray, point_m: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """A plane (3,) moved up or down so that as many of the points in ``rows`` are above it as below."""
    above_m = np.empty(len(rows))
    for k, row in enumerate(rows):
        above_m[k] = point_m[row, 2] - point_m[row, 0] * plane[0] - point_m[row, 1] * plane[1]
    return np.array([plane[0], plane[1], median(above_m, len(rows))])


@allocating
def _along(point_m: np.ndarray, rows: np.ndarray, bearing: float, noise_m: float) -> np.ndarray:
    """The plane (3,) of the points in ``rows`` that rises along a bearing, radians."""
    x, y, profile_m = np.cos(bearing), np.sin(bearing), np.zeros((len(rows), 3))
    for k, row in enumerate(rows):
        profile_m[k, 0], profile_m[k, 2] = point_m[row, 0] * x + point_m[row, 1] * y, point_m[row, 2]
    rise, _, height_m = fit(profile_m, np.arange(len(rows)), len(rows), noise_m)
    return np.array([rise * x, rise * y, height_m])


@allocating
def _equally_steep(
    plane: np.ndarray, point_m: np.ndarray, rows_of: list[np.ndarray], by_size: np.ndarray, slack_m: float
) -> np.ndarray:
    """The planes (k, 3), where a plane that is nearly as steep as a larger one becomes exactly as steep, if its points
    allow it. by_size: the planes, largest first."""
    steep = np.hypot(plane[:, 0], plane[:, 1])
    result, is_set = plane.copy(), steep < _NEARLY_LEVEL / 10
    for i in by_size:
        for j in range(0 if is_set[i] else len(plane)):
            if j == i or is_set[j] or abs(steep[j] - steep[i]) >= _NEARLY_EQUAL:
                continue
            equal = _at_median(plane[j] * (steep[i] / steep[j]), point_m, rows_of[j])
            worse_m = mean_distance(equal, point_m, rows_of[j]) - mean_distance(plane[j], point_m, rows_of[j])
            if worse_m < slack_m:
                result[j], is_set[j] = equal, True
        is_set[i] = True
    return result


@allocating
def _same(
    plane: np.ndarray, point_m: np.ndarray, rows_of: list[np.ndarray], by_size: np.ndarray, slack_m: float
) -> np.ndarray:
    """int (k,): for each plane, the number of the largest plane that is nearly as near to its points, or its own number
    if there is none."""
    same, num_larger = np.arange(len(plane)), 0
    larger = np.empty(len(plane), np.int64)
    for j in by_size:
        rows, x, y = rows_of[j], 0.0, 0.0
        for row in rows:
            x, y = x + point_m[row, 0] / len(rows), y + point_m[row, 1] / len(rows)
        own_m = plane[j, 0] * x + plane[j, 1] * y + plane[j, 2]
        most_m = mean_distance(plane[j], point_m, rows) + slack_m
        for i in larger[:num_larger]:
            apart_m = abs(plane[i, 0] * x + plane[i, 1] * y + plane[i, 2] - own_m)
            if apart_m < most_m and mean_distance(plane[i], point_m, rows) < most_m:
                same[j] = i
                break
        if same[j] == j:
            larger[num_larger], num_larger = j, num_larger + 1
    return same
