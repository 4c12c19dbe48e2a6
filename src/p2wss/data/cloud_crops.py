"""The points of each building of a cloud, and the ground around it: the one place where heights get their zero."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2wss.data import polygon_arrays
from p2wss.data.clouds import Cloud
from p2wss.data.cropping import crop_points, ring_medians
from p2wss.data.las_classes import GROUND_CLASS
from p2wss.skeleton.types import Polygons

# distance from the footprint within which the ground is looked for, wider where it is not found
GROUND_RINGS_M = (1.0, 4.0, 16.0, 64.0)
_ENOUGH_GROUND_POINTS = 5
_LOW_PERCENTILE = 5.0
# of the heights at a building without any ground within the last ring: the foot of a wall, at best
_FOOT_QUANTILE = 0.02


@dataclass(frozen=True)
class Cropped:
    """Points of each of n polygons: polygon p has the pairs ``offset[p]:offset[p + 1]``.

    point: int32 (num_pairs,), index into the cloud. inside: bool (num_pairs,), false for the ring around the
    footprint. ground_z_m: float64 (n,), z of the ground at the building as the cloud shows it
    (:func:`ground_height`); where it shows none, the quantile 0.02 of the heights of the building's points; NaN only
    without points.
    """

    point: np.ndarray
    inside: np.ndarray
    offset: np.ndarray
    ground_z_m: np.ndarray

    def of(self, polygon: int) -> np.ndarray:
        """Indices of the points of one polygon."""
        return self.point[self.offset[polygon] : self.offset[polygon + 1]]


def crop_cloud(cloud: Cloud, polygons: Polygons, buffer_m: float = 1.0) -> Cropped:
    """The points of ``cloud`` inside or within ``buffer_m`` of each polygon, which is in the cloud's CRS."""
    point, inside, offset = crop_points(cloud.x_m, cloud.y_m, polygons, buffer_m)
    known = (point, inside, offset) if buffer_m == GROUND_RINGS_M[0] else None
    ground_z_m = ground_height(cloud, polygons, known)
    for p in np.flatnonzero(np.isnan(ground_z_m) & (np.diff(offset) > 0)):
        ground_z_m[p] = np.quantile(cloud.z_m[point[offset[p] : offset[p + 1]]], _FOOT_QUANTILE)
    return Cropped(point, inside, offset, ground_z_m)


def ground_height(
    cloud: Cloud, polygons: Polygons, nearest: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """z of the ground around each polygon as the cloud shows it, float64 (num_polygons,), NaN where it shows none.

    The median of the ground points (class 2) outside the footprint, at most 1 m away; if these are fewer than
    five, at most 4, 16 or 64 m away. In a cloud without any class 2, a low percentile of all points of the
    ring. ``nearest``: what :func:`crop_points` gives for 1 m, if that is known.
    """
    ground = cloud.classification == GROUND_CLASS
    unclassified = not ground.any()
    if unclassified:
        ground = np.ones(len(cloud), bool)
    result = np.full(len(polygons), np.nan)
    pending = np.flatnonzero(np.diff(polygons.vertex_offset) > 0)
    for distance_m in GROUND_RINGS_M:
        if not len(pending):
            break
        if nearest is not None and distance_m == GROUND_RINGS_M[0] and len(pending) == len(polygons):
            point, inside, offset = nearest
        else:
            point, inside, offset = crop_points(
                cloud.x_m, cloud.y_m, polygon_arrays.take(polygons, pending), distance_m, ground
            )
        counts, median = ring_medians(cloud.z_m, ground, point, inside, offset)
        is_last = distance_m == GROUND_RINGS_M[-1]
        enough = counts >= (1 if is_last else _ENOUGH_GROUND_POINTS)
        if unclassified:
            for p in np.flatnonzero(enough):
                pairs = slice(offset[p], offset[p + 1])
                heights = cloud.z_m[point[pairs][~inside[pairs]]]
                result[pending[p]] = np.percentile(heights, _LOW_PERCENTILE)
        else:
            result[pending[enough]] = median[enough]
        pending = pending[~enough]
    return result
