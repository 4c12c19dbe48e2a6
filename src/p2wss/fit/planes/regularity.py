"""Planes made regular where the points allow it: level, along a direction of the footprint, equally steep, the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss.fit.directions import turn_between
from p2wss.fit.planes.detection import RoofPlanes, fitted, heights, mean_distance, rows_of
from p2wss.fit.points import median
from p2wss.fit.settings import Detection
from p2wss.skeleton.angles import bearings

# tangents: of a slope that may be level, and of a difference between slopes that may be equal
_NEARLY_LEVEL, _NEARLY_EQUAL = 0.14, 0.06
# radians: a slope that differs less from a direction of the footprint may be along it
_NEARLY_ALONG = np.radians(8)


def regular(
    planes: RoofPlanes, point_m: np.ndarray, along: Sequence[float], settings: Detection
) -> np.ndarray:
    """Planes (k, 3) near to those detected, some of them the same. along: directions of the footprint, radians."""
    slack_m = settings.simpler_m
    rows = rows_of(planes.label, len(planes.plane))
    result = planes.plane.copy()

    def mean_m(plane: np.ndarray, i: int) -> float:
        return float(mean_distance(plane, point_m, rows[i]))

    for i, plane in enumerate(planes.plane):
        own, most_m = point_m[rows[i]], mean_m(plane, i) + slack_m
        level = np.array([0.0, 0.0, median(own[:, 2])])
        if np.hypot(*plane[:2]) < _NEARLY_LEVEL and mean_m(level, i) < most_m:
            result[i] = level
            continue
        bearing = bearings(plane[:2])
        turns = turn_between(bearing, np.array(along))
        turn = turns[np.abs(turns).argmin()]
        if abs(turn) < _NEARLY_ALONG:
            turned = _along(own, bearing - turn, settings.noise_m)
            if mean_m(turned, i) < most_m:
                result[i] = turned
    result = _equally_steep(result, point_m, rows, slack_m)
    return result[_same(result, point_m, rows, slack_m)]


def _along(point_m: np.ndarray, bearing: float, noise_m: float) -> np.ndarray:
    """The plane (3,) of points (m, 3) that rises along a bearing, radians."""
    unit = np.array([np.cos(bearing), np.sin(bearing)])
    profile_m = np.column_stack([point_m[:, :2] @ unit, np.zeros(len(point_m)), point_m[:, 2]])
    rise, _, height_m = fitted(profile_m, np.arange(len(profile_m)), noise_m)
    return np.array([*rise * unit, height_m])


def _equally_steep(
    plane: np.ndarray, point_m: np.ndarray, rows: Sequence[np.ndarray], slack_m: float
) -> np.ndarray:
    """Planes of which those that are nearly as steep as a larger one are exactly as steep."""
    steep = np.hypot(plane[:, 0], plane[:, 1])
    result, is_set = plane.copy(), steep < _NEARLY_LEVEL / 10
    for i in sorted(range(len(plane)), key=lambda i: -len(rows[i])):
        if is_set[i]:
            continue
        is_set[i] = True
        for j in np.flatnonzero(~is_set & (np.abs(steep - steep[i]) < _NEARLY_EQUAL)).tolist():
            own = point_m[rows[j]]
            equal = plane[j] * np.array([steep[i] / steep[j], steep[i] / steep[j], 0.0])
            equal[2] = median(own[:, 2] - own[:, :2] @ equal[:2])
            worse_m = mean_distance(equal, point_m, rows[j]) - mean_distance(plane[j], point_m, rows[j])
            if worse_m < slack_m:
                result[j], is_set[j] = equal, True
    return result


def _same(plane: np.ndarray, point_m: np.ndarray, rows: Sequence[np.ndarray], slack_m: float) -> np.ndarray:
    """int (k,): of each plane the number of the larger one that is as near to its points, or its own."""
    same, larger, size = np.arange(len(plane)), list[int](), np.array([*map(len, rows)])
    middle_m = np.add.reduceat(point_m[np.concatenate(rows), :2], np.cumsum(size) - size) / size[:, None]
    height_m = heights(plane, middle_m)
    apart_m = np.abs(height_m - np.diag(height_m)[:, None]).tolist()
    for j in np.argsort(-size, kind="stable").tolist():
        most_m = mean_distance(plane[j], point_m, rows[j]) + slack_m
        for i in larger:
            if apart_m[j][i] < most_m and mean_distance(plane[i], point_m, rows[j]) < most_m:
                same[j] = i
                break
        else:
            larger.append(j)
    return same
