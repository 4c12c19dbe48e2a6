"""Crop the points of each building from a cloud, and estimate the ground at it, from which heights are measured."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from p2wss.clouds.cropping import crop_points, ring_medians
from p2wss.clouds.reading import Cloud
from p2wss.data import polygon_arrays
from p2wss.data.las_classes import (
    BUILDING_CLASS,
    GROUND_CLASS,
    NOISE_CLASSES,
    PLANT_CLASSES,
    UNCLASSIFIED_CLASS,
    WATER_CLASS,
    has_class,
)
from p2wss.skeleton.types import Polygons, numbered

# metres from the footprint within which points of class ground are searched, then the lowest points, each time the next
# one if there are too few; all that is known of a building is so far from it
_GROUND_RINGS_M, LOWEST_RINGS_M, GROUND_REACH_M = (1.0, 4.0), (32.0, 52.0), 64.0
_MIN_GROUND_POINTS = 5
# the lowest points are those of squares with this side; the share of them that the ground is above of, the others being
# on roofs where no ground is seen; the distance in metres within which they count the same, and the variance of places,
# square metres, below which they show no slope; chosen on drawn old towns
_SQUARE_M, _BELOW_SHARE, _SAME_M, _NO_SLOPE_M2 = 8.0, 0.3, 8.0, 1.0
_NUM_ROUNDS, _NOISE_M = 10, 0.05
# of lowest points that have class ground or none, the share below which class ground is that of strays on roofs, and
# metres above such ground from which others do not speak against it: those of roofs; set by hand, as of real towns the
# share is 0.83 at least, of a drawn one with strays 0.1
_SEEN_SHARE, _NOT_GROUND_M = 0.25, 2.0
# quantile of the heights of a building without ground in the last ring: at best, the foot of a wall
_FOOT_QUANTILE = 0.02
# a building with fewer points in its footprint needs what the roofs so many metres around it show; chosen on half A of
# Delft: with more, roofs are nearer to the points, and have fewer triangles, without the neighbours
FEW_POINTS, AROUND_M = 25, 12.0


@dataclass(frozen=True)
class CloudCrops:
    """The points of a cloud on or near each of n polygons: polygon p has the pairs ``offset[p]:offset[p + 1]``.

    point: int32 (num_pairs,), index into the cloud. inside: bool (num_pairs,), false for points in the buffer around
    the footprint. ground_z_m: float64 (n,), z of the ground at the building (:func:`ground_height`). If the cloud
    has no ground there, it is the 2 % quantile of the heights of the building's points; NaN only without points.
    is_foot: bool (n,), whether it is that quantile: at best, the foot of a wall. guess_sd_m: (n,), the standard
    deviation of the points that it is from where hardly any has class ground, so that all may be on roofs; or NaN.
    """

    point: np.ndarray
    inside: np.ndarray
    offset: np.ndarray
    ground_z_m: np.ndarray
    is_foot: np.ndarray
    guess_sd_m: np.ndarray

    def of(self, polygon: int) -> np.ndarray:
        """Indices of the points of one polygon."""
        return self.point[self.offset[polygon] : self.offset[polygon + 1]]


def crop_cloud(cloud: Cloud, polygons: Polygons, buffer_m: float = 1.0) -> CloudCrops:
    """The points of ``cloud`` inside or within ``buffer_m`` of each polygon. polygons: in the CRS of the cloud."""
    point, inside, offset = crop_points(cloud.x_m, cloud.y_m, polygons, buffer_m)
    first_ring = (point, inside, offset) if buffer_m == _GROUND_RINGS_M[0] else None
    ground_z_m, guess_sd_m = ground_height(cloud, polygons, first_ring)
    is_foot = np.isnan(ground_z_m) & (np.diff(offset) > 0)
    for p in np.flatnonzero(is_foot):
        ground_z_m[p] = np.quantile(cloud.z_m[point[offset[p] : offset[p + 1]]], _FOOT_QUANTILE)
    return CloudCrops(point, inside, offset, ground_z_m, is_foot, guess_sd_m)


def roofs_around(cloud: Cloud, polygons: Polygons, cropped: CloudCrops) -> dict[int, np.ndarray]:
    """By polygons with few points, those of class building beside them: indices (k,) into the cloud."""
    polygon = np.repeat(np.arange(len(polygons)), np.diff(cropped.offset))
    count = np.bincount(polygon[cropped.inside], minlength=len(polygons))
    few = np.flatnonzero((count > 0) & (count < FEW_POINTS))
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
) -> tuple[np.ndarray, np.ndarray]:
    """z of the ground around each polygon, float64 (num_polygons,), NaN if the cloud has no ground there; the standard
    deviation of the points that it is from where hardly any has class ground, NaN elsewhere.

    It is the median of the ground points (class 2) outside the footprint and at most 1 m away from it, or at most 4 m
    away if these are fewer than five. If there are few again, it is the :func:`low_height` of the lowest points at most
    32 m away, or 52 m (where one is enough), of ground or without class. So it is where most points in the ring have no
    class and are not well above, if that holds for the lowest points, too: ground points are strays then, as on roofs.
    first_ring: the result of :func:`crop_points` for 1 m, if it is at hand.
    """
    is_ground = cloud.classification == GROUND_CLASS
    is_unclassified = cloud.classification <= UNCLASSIFIED_CLASS
    result, guess_sd_m = np.full((2, len(polygons)), np.nan)
    pending = np.flatnonzero(np.diff(polygons.vertex_offset) > 0)
    is_doubtful = np.zeros(len(polygons), bool)
    for distance_m in _GROUND_RINGS_M if is_ground.any() else ():
        if first_ring is not None and distance_m == _GROUND_RINGS_M[0] and len(pending) == len(polygons):
            crop = first_ring
        else:
            some = polygon_arrays.take(polygons, pending)
            crop = crop_points(cloud.x_m, cloud.y_m, some, distance_m, is_ground | is_unclassified)
        counts, height_m = ring_medians(cloud.z_m, is_ground, *crop)
        is_enough = counts >= _MIN_GROUND_POINTS
        result[pending[is_enough]] = height_m[is_enough]
        num_other, other_m = ring_medians(cloud.z_m, is_unclassified, *crop)
        is_doubtful[pending] = (num_other > counts) & ~(other_m > height_m + _NOT_GROUND_M)
        pending = pending[~is_enough]
    is_doubtful[pending] = True
    pending = np.flatnonzero(is_doubtful)
    lowest = lowest_points(cloud) if len(pending) else pending
    for distance_m in LOWEST_RINGS_M:
        some = polygon_arrays.take(polygons, pending)
        point, inside, offset = crop_points(cloud.x_m[lowest], cloud.y_m[lowest], some, distance_m)
        is_done = np.zeros(len(pending), bool)
        for k, p in enumerate(pending.tolist()):
            pairs = slice(offset[k], offset[k + 1])
            around = lowest[point[pairs][~inside[pairs]]]
            if len(around) < (1 if distance_m == LOWEST_RINGS_M[-1] else _MIN_GROUND_POINTS):
                continue
            is_done[k], low_m = True, low_height(cloud, around, polygons.rings(p)[0])
            z_m = low_m if np.isnan(result[p]) else result[p]
            level = around[cloud.z_m[around] < z_m + _NOT_GROUND_M]
            num_seen, num_other = is_ground[level].sum(), is_unclassified[level].sum()
            is_stray = num_seen < _SEEN_SHARE * (num_seen + num_other)
            result[p] = low_m if is_stray else z_m
            guess_sd_m[p] = np.std(cloud.z_m[around]) if is_stray else np.nan
        pending = pending[~is_done]
    return result, guess_sd_m


def lowest_points(cloud: Cloud) -> np.ndarray:
    """Indices of the lowest points of a cloud, one of each square, without plants, roofs, noise and water."""
    solid = np.flatnonzero(
        ~has_class(cloud.classification, (*PLANT_CLASSES, *NOISE_CLASSES, WATER_CLASS, BUILDING_CLASS))
    )
    square = np.floor(cloud.x_m[solid] / _SQUARE_M) + 1j * np.floor(cloud.y_m[solid] / _SQUARE_M)
    number = numbered(square)[1]
    least_z = np.full(len(solid), np.inf)
    np.minimum.at(least_z, number, cloud.z_m[solid])
    is_low = cloud.z_m[solid] == least_z[number]
    low, number = solid[is_low], number[is_low]
    order = np.lexsort([cloud.y_m[low], cloud.x_m[low], number])
    return low[order[np.diff(number[order], prepend=-1) > 0]]


def low_height(cloud: Cloud, point: np.ndarray, xy_m: np.ndarray) -> float:
    """Mean z, in whole millimetres, at places (k, 2) of the ground below points of a cloud, indices (m,): the plane
    that a share of them is below of, those that are near counting more. It is found by reweighted least squares.

    The ground of a hillside is neither the mean nor the lowest of the points that are seen of it.
    """
    off_m = np.column_stack([cloud.x_m[point], cloud.y_m[point], np.ones(len(point))])
    off_m[:, :2] -= xy_m.mean(axis=0)
    z, base_z = cloud.z_m[point], cloud.z_m[point].min()
    near = 1 / (off_m[:, 0] ** 2 + off_m[:, 1] ** 2 + _SAME_M**2)
    plane = np.array([0.0, 0.0, np.quantile(z, _BELOW_SHARE) - base_z])
    for _ in range(_NUM_ROUNDS):
        above_m = z - base_z - off_m @ plane
        side = np.where(above_m > 0, _BELOW_SHARE, 1 - _BELOW_SHARE)
        weighted = off_m.T * (near * side / np.maximum(np.abs(above_m), _NOISE_M))
        keep = np.diag([_NO_SLOPE_M2, _NO_SLOPE_M2, 0.0]) * weighted[2].sum()
        plane = np.linalg.solve(weighted @ off_m + keep, weighted @ (z - base_z))
    return float(np.round(plane[2] + base_z, 3))
