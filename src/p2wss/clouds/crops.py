"""Crop the points of each building from a cloud, and estimate the ground at it, from which heights are measured."""

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

# distances from the footprint in metres: of ground points, the next one if there are too few points within the first;
# of the lowest points, likewise; of everything that is known of a building
_GROUND_RINGS_M, LOWEST_RINGS_M, GROUND_REACH_M = (1.0, 4.0), (32.0, 52.0), 64.0
_MIN_GROUND_POINTS = 5
# side of the squares, each of which gives its lowest point; share of these points that lie below the ground plane, as
# others may be on roofs where no ground is seen; distance in metres within which points weigh about the same; variance
# of the places, square metres, below which they show no slope. Chosen on drawn old towns
_SQUARE_M, _BELOW_SHARE, _SAME_M, _NO_SLOPE_M2 = 8.0, 0.3, 8.0, 1.0
_NUM_ROUNDS, _NOISE_M = 10, 0.05
# least share of class ground among the lowest points that have class ground or none: below it, the ground points are
# strays on roofs; metres above that ground from which points do not count here, as they are on roofs. Set by hand: real
# towns have a share of at least 0.83, a drawn town with strays has 0.1
_SEEN_SHARE, _NOT_GROUND_M = 0.25, 2.0
# metres by which a plane through the ground beyond the last ring of ground points may leave the heights of these points
# before it is a guess, as where all of them are to one side. Set by hand
_BEYOND_M = 0.5
# quantile of the heights of a building without ground in the last ring: at best, the foot of a wall
_FOOT_QUANTILE = 0.02
# a building with fewer points in its footprint also uses the points on roofs within this distance in metres. Chosen on
# half A of Delft: buildings with more points get closer roofs with fewer triangles without their neighbours
FEW_POINTS, AROUND_M = 25, 12.0


@dataclass(frozen=True)
class CloudCrops:
    """The points of a cloud on or near each of n polygons: polygon p has the pairs ``offset[p]:offset[p + 1]``.

    point: int32 (num_pairs,), index into the cloud. inside: bool (num_pairs,), false for points in the buffer around
    the footprint. ground_z_m: float64 (n,), z of the ground at the building (:func:`ground_height`). If the cloud has
    no ground there, it is the 2 % quantile of the heights of the building's points; NaN only without points. is_foot:
    bool (n,), whether ``ground_z_m`` is that quantile: at best, the foot of a wall. guess_sd_m: float64 (n,), NaN
    unless the ground is a guess, because hardly any of the lowest points around the building has class ground and all
    may be on roofs, or because it is higher or lower than all of them; then the standard deviation of their heights.
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
    """For each polygon with few points in it: the points of class building outside it and at most :data:`AROUND_M`
    away, as indices (k,) into the cloud. The keys are indices of polygons; polygons without points or with enough of
    them are absent."""
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
    """(z of the ground around each polygon, NaN if the cloud has no ground there; standard deviation of the heights of
    the lowest points around it where the ground is a guess, else NaN), both float64 (num_polygons,).

    The ground is the median of the ground points (class 2) outside the footprint and at most 1 m away, or at most 4 m
    away if fewer than five are within 1 m. With fewer than five within 4 m it is :func:`low_height` of the
    :func:`lowest_points` at most 32 m away, or at most 52 m away (where one is enough) if fewer than five are that
    near.

    Ground points may be strays, as on roofs. They are suspected where a ring has more points without class than ground
    points, with a median at most 2 m above the median of the ground points. They are strays if class ground is also
    rare among the lowest points less than 2 m above that median. Then the ground is :func:`low_height`, and a guess. So
    it is where no ground is within 4 m, and the plane leaves the heights of the lowest points.
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
            lowest_z, highest_z = cloud.z_m[around].min(), cloud.z_m[around].max()
            is_beyond = np.isnan(result[p]) and not lowest_z - _BEYOND_M <= low_m <= highest_z + _BEYOND_M
            result[p] = low_m if is_stray else z_m
            guess_sd_m[p] = np.std(cloud.z_m[around]) if is_stray or is_beyond else np.nan
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
    """z of the ground at places (k, 2), in whole millimetres, estimated from points of a cloud with the indices
    ``point`` (m,): the height of a plane at the mean of the places.

    The plane is a quantile regression, found by reweighted least squares: a fixed share of the points lies below it,
    and near points weigh more. The ground of a hillside is neither the mean nor the minimum of the points seen there.
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
