"""Planes made regular where the points allow it: level, sloping along a direction of the footprint, equally steep."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss.fit.planes.detection import RoofPlanes, distances
from p2wss.fit.planes.settings import Thresholds

_QUARTER = np.pi / 2
# tangents: of a slope that may be level, and of a difference between slopes that may be equal
_NEARLY_LEVEL, _NEARLY_EQUAL = 0.14, 0.06
# radians: a slope that differs less from a direction of the footprint may be along it
_NEARLY_ALONG = np.radians(8)


def turn_between(angle: np.ndarray | float, other: float) -> np.ndarray:
    """The turn from ``other`` to ``angle``, radians, both modulo a quarter: within an eighth either way."""
    return np.asarray((angle - other + _QUARTER / 2) % _QUARTER - _QUARTER / 2)


def directions(rings: Sequence[np.ndarray], same_deg: float) -> list[float]:
    """Directions of the edges of a footprint, radians modulo a quarter, the longest in sum first."""
    edge = np.concatenate([np.roll(ring, -1, axis=0) - ring for ring in rings])
    length = np.hypot(edge[:, 0], edge[:, 1])
    angle = np.arctan2(edge[:, 1], edge[:, 0]) % _QUARTER
    found = []
    while len(length):
        turn = turn_between(angle, angle[length.argmax()])
        same = np.abs(turn) <= np.radians(same_deg)
        mean = angle[length.argmax()] + np.average(turn[same], weights=length[same])
        found.append((float(length[same].sum()), float(mean)))
        angle, length = angle[~same], length[~same]
    return [angle for _, angle in sorted(found, key=lambda each: -each[0])]


def regular(
    planes: RoofPlanes, point_m: np.ndarray, along: Sequence[float], settings: Thresholds
) -> np.ndarray:
    """Planes (k, 3) near to those detected. along: directions of the footprint, radians."""
    slack_m = settings.detection.simpler_m
    rows = [np.flatnonzero(planes.label == i) for i in range(len(planes.plane))]
    result = planes.plane.copy()

    def mean_m(plane: np.ndarray, i: int) -> float:
        return float(distances(plane[None], point_m[rows[i]]).mean())

    for i, plane in enumerate(planes.plane):
        own, most_m = point_m[rows[i]], mean_m(plane, i) + slack_m
        level = np.array([0.0, 0.0, np.median(own[:, 2])])
        if np.hypot(*plane[:2]) < _NEARLY_LEVEL and mean_m(level, i) < most_m:
            result[i] = level
            continue
        bearing = np.arctan2(plane[1], plane[0])
        turns = sorted((turn_between(bearing, angle) for angle in along), key=abs)
        for turn in turns[:1]:
            if abs(turn) < _NEARLY_ALONG:
                unit = np.array([np.cos(bearing - turn), np.sin(bearing - turn)])
                turned = _along(own, unit, settings.detection.noise_m)
                if mean_m(turned, i) < most_m:
                    result[i] = turned
    return _equally_steep(result, point_m, rows, slack_m)


def _along(point_m: np.ndarray, unit: np.ndarray, noise_m: float) -> np.ndarray:
    """The plane (3,) of points (m, 3) that rises along a direction, by reweighted least squares."""
    place, weight = point_m[:, :2] @ unit, np.ones(len(point_m))
    matrix = np.column_stack([place, np.ones(len(place))])
    rise: np.ndarray = np.zeros(2)
    for _ in range(4):
        rise = np.linalg.lstsq(matrix * weight[:, None], point_m[:, 2] * weight, rcond=None)[0]
        weight = 1 / np.sqrt(np.maximum(np.abs(matrix @ rise - point_m[:, 2]), noise_m))
    return np.array([rise[0] * unit[0], rise[0] * unit[1], rise[1]])


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
            equal[2] = np.median(own[:, 2] - own[:, :2] @ equal[:2])
            worse_m = distances(equal[None], own).mean() - distances(plane[j][None], own).mean()
            if worse_m < slack_m:
                result[j], is_set[j] = equal, True
    return result
