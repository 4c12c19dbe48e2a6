"""Crop the points of each building from a cloud, and estimate the ground at it, from which heights are measured."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely

from p2wss.clouds.cropping import crop_points, ring_medians
from p2wss.clouds.reading import Cloud
from p2wss.data import polygon_arrays
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS
from p2wss.skeleton.types import Polygons

# distances from the footprint within which ground points are searched, the next one if there are too few
GROUND_RINGS_M = (1.0, 4.0, 16.0, 64.0)
_MIN_GROUND_POINTS = 5
_LOW_PERCENTILE = 5.0
# points of the ground further away show its slope, for which so many suffice
_NEAR_M, _NUM_BETWEEN = 4.0, 1000
# of the share of a corner of a triangle
_ROUNDING = 1e-9
# quantile of the heights of a building without ground in the last ring: at best, the foot of a wall
_FOOT_QUANTILE = 0.02
# points per square metre: a building with fewer needs what the roofs so far around it show
FEW_PER_M2, AROUND_M = 0.6, 12.0


@dataclass(frozen=True)
class CloudCrops:
    """The points of a cloud on or near each of n polygons: polygon p has the pairs ``offset[p]:offset[p + 1]``.

    point: int32 (num_pairs,), index into the cloud. inside: bool (num_pairs,), false for points in the buffer around
    the footprint. ground_z_m: float64 (n,), z of the ground at the building (:func:`ground_height`). If the cloud
    has no ground there, it is the 2 % quantile of the heights of the building's points; NaN only without points.
    """

    point: np.ndarray
    inside: np.ndarray
    offset: np.ndarray
    ground_z_m: np.ndarray

    def of(self, polygon: int) -> np.ndarray:
        """Indices of the points of one polygon."""
        return self.point[self.offset[polygon] : self.offset[polygon + 1]]


def crop_cloud(cloud: Cloud, polygons: Polygons, buffer_m: float = 1.0) -> CloudCrops:
    """The points of ``cloud`` inside or within ``buffer_m`` of each polygon. polygons: in the CRS of the cloud."""
    point, inside, offset = crop_points(cloud.x_m, cloud.y_m, polygons, buffer_m)
    first_ring = (point, inside, offset) if buffer_m == GROUND_RINGS_M[0] else None
    ground_z_m = ground_height(cloud, polygons, first_ring)
    for p in np.flatnonzero(np.isnan(ground_z_m) & (np.diff(offset) > 0)):
        ground_z_m[p] = np.quantile(cloud.z_m[point[offset[p] : offset[p + 1]]], _FOOT_QUANTILE)
    return CloudCrops(point, inside, offset, ground_z_m)


def roofs_around(cloud: Cloud, polygons: Polygons, cropped: CloudCrops) -> dict[int, np.ndarray]:
    """By polygons with few points, those of class building beside them: indices (k,) into the cloud."""
    polygon = np.repeat(np.arange(len(polygons)), np.diff(cropped.offset))
    count = np.bincount(polygon[cropped.inside], minlength=len(polygons))
    area_m2 = shapely.area(polygon_arrays.to_geometries(polygons))
    few = np.flatnonzero((count > 0) & (count < FEW_PER_M2 * area_m2))
    point, inside, offset = crop_points(
        cloud.x_m,
        cloud.y_m,
        polygon_arrays.take(polygons, few),
        AROUND_M,
        cloud.classification == BUILDING_CLASS,
    )
    pairs = [slice(start, end) for start, end in pairwise(offset.tolist())]
    return {p: point[pair][~inside[pair]] for p, pair in zip(few.tolist(), pairs, strict=True)}


def ground_height(
    cloud: Cloud, polygons: Polygons, first_ring: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """z of the ground around each polygon, float64 (num_polygons,); NaN if the cloud has no ground there.

    It is the median of the ground points (class 2) outside the footprint and at most 1 m away from it, or at most 4 m
    away if these are fewer than five. If there are few again, it lies :func:`between` those at most 16 m away, or 64 m
    (where one is enough): on a slope, they may all be above or below. Without class 2 that near, it is the 5 %
    percentile of all the points in the first of these rings that has as many. first_ring: the result of
    :func:`crop_points` for 1 m, if it is at hand.
    """
    is_ground = cloud.classification == GROUND_CLASS
    result = np.full(len(polygons), np.nan)
    pending = np.flatnonzero(np.diff(polygons.vertex_offset) > 0)
    if is_ground.any():
        pending = _fill_from_rings(result, pending, cloud, polygons, is_ground, first_ring)
    # decided for each building, because the points that are read depend on the other buildings of a run
    _fill_from_rings(result, pending, cloud, polygons, None, first_ring)
    return result


def between(cloud: Cloud, point: np.ndarray, xy_m: np.ndarray) -> float:
    """Mean z at places (k, 2) on the triangles between points of a cloud, indices (m,); that of the point nearest to
    the first place if all are outside the triangles."""
    point = point[:: len(point) // _NUM_BETWEEN + 1]
    off_m = np.column_stack([cloud.x_m[point] - xy_m[0, 0], cloud.y_m[point] - xy_m[0, 1], cloud.z_m[point]])
    # scipy takes longer to import than all places to be found
    triangles = shapely.delaunay_triangles(shapely.multipoints(off_m))
    corner_m = shapely.get_coordinates(triangles, include_z=True).reshape(-1, 4, 3)[:, :3]
    to_share = np.linalg.inv(corner_m[:, 1:, :2] - corner_m[:, :1, :2])
    share = np.einsum("ntj,tji->nti", (xy_m - xy_m[0])[:, None] - corner_m[:, 0, :2], to_share)
    share = np.dstack([1.0 - share.sum(axis=2), share])
    is_within = np.asarray((share >= -_ROUNDING).all(axis=2))
    if is_within.any():
        place = np.flatnonzero(is_within.any(axis=1))
        triangle = is_within[place].argmax(axis=1)
        return float((share[place, triangle] * corner_m[triangle, :, 2]).sum(axis=1).mean())
    return float(off_m[np.hypot(*off_m[:, :2].T).argmin(), 2])


def _fill_from_rings(
    result: np.ndarray,
    pending: np.ndarray,
    cloud: Cloud,
    polygons: Polygons,
    is_ground: np.ndarray | None,
    first_ring: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
) -> np.ndarray:
    """Fill the ground of the polygons ``pending`` into ``result``, and return those that have no points either.

    is_ground: bool (num_points,), the points whose median it is; None for the low percentile of all points.
    """
    for distance_m in GROUND_RINGS_M:
        if not len(pending):
            break
        if first_ring is not None and distance_m == GROUND_RINGS_M[0] and len(pending) == len(polygons):
            point, inside, offset = first_ring
        else:
            point, inside, offset = crop_points(
                cloud.x_m, cloud.y_m, polygon_arrays.take(polygons, pending), distance_m, is_ground
            )
        among = np.ones(len(cloud), bool) if is_ground is None else is_ground
        counts, height_m = ring_medians(cloud.z_m, among, point, inside, offset)
        is_enough = counts >= (1 if distance_m == GROUND_RINGS_M[-1] else _MIN_GROUND_POINTS)
        if is_ground is None or distance_m > _NEAR_M:
            for p in np.flatnonzero(is_enough):
                pairs = slice(offset[p], offset[p + 1])
                around = point[pairs][~inside[pairs]]
                if is_ground is None:
                    height_m[p] = np.percentile(cloud.z_m[around], _LOW_PERCENTILE)
                else:
                    height_m[p] = between(cloud, around, polygons.rings(pending[p])[0])
        result[pending[is_enough]] = height_m[is_enough]
        pending = pending[~is_enough]
    return pending
