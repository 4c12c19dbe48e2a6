"""Whose points are these? Classes of the points of a building, as its roof needs them.

Along the border to another building, points of class building may be of that one: its roof reaches over the border, or
the map has the border elsewhere, and pulses hit its wall. What is on either side decides: a point that continues the
surface beyond the border, and not the own roof further within, is the neighbour's. The same rule holds from the other
side, so that no order of buildings matters. Roofs that the producer took for ground are told by what is beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial import cKDTree

from p2wss.data.building import Building
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS, NEIGHBOUR_CLASS, PLANT_CLASSES
from p2wss.data.points import MIN_HEIGHT_M


@dataclass(frozen=True)
class Rules:
    """Whose the points at a border are; set by hand from drawn old towns.

    strip_m, wall_m: points this near to the border may be another building's; those of walls are nearer. step_m, on_m:
    surfaces on both sides of a border are different from this on; a point is on one of them within the second.
    num_points, num_near, reach_m: points that show the surface on one side, and how many of them are how near, so that
    there is no gap. noise_m: smaller residuals have full weight. num_rounds: of the fit. steepest: tangent of the
    steepest roof.
    """

    strip_m: float = 1.0
    wall_m: float = 0.6
    step_m: float = 1.0
    on_m: float = 0.25
    num_points: int = 12
    num_near: int = 2
    reach_m: float = 2.0
    noise_m: float = 0.05
    num_rounds: int = 4
    steepest: float = 2.2


RULES = Rules()


def with_own_classes(building: Building) -> Building:
    """The building with the classes of :func:`own_classes`."""
    classes = own_classes(building.rings, building.point_m, building.classification)
    return replace(building, classification=classes)


def own_classes(rings: Sequence[np.ndarray], point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """The classes (m,) of points (m, 3), with :data:`NEIGHBOUR_CLASS` where they are another building's, and with class
    building where a roof has class ground. point_m: in and around the footprint ``rings``, z above the ground."""
    result = classification
    if not len(rings) or not len(point_m):
        return result
    polygon = shapely.Polygon(rings[0], rings[1:])
    inside = shapely.contains_xy(polygon, point_m[:, 0], point_m[:, 1])
    roof = inside & (classification == GROUND_CLASS) & (point_m[:, 2] >= MIN_HEIGHT_M)
    if roof.any():
        beside = ~inside & (classification == GROUND_CLASS)
        if beside.any():
            nearest = cKDTree(point_m[beside, :2]).query(point_m[roof, :2])[1]
            roof[roof] = point_m[roof, 2] > point_m[beside, 2][nearest] + MIN_HEIGHT_M
        result = np.where(roof, np.uint8(BUILDING_CLASS), result)
    beyond = np.flatnonzero(~inside & (result == BUILDING_CLASS))
    is_own = inside & (result == BUILDING_CLASS)
    if len(beyond) < RULES.num_points or not is_own.any():
        return result
    depth_m = np.zeros(len(point_m))
    depth_m[inside] = shapely.distance(polygon.boundary, shapely.points(point_m[inside, :2]))
    strip = np.flatnonzero(is_own & (depth_m <= RULES.strip_m))
    within = np.flatnonzero(is_own & (depth_m > RULES.strip_m))
    if len(within) < RULES.num_points:
        within = np.flatnonzero((depth_m > RULES.strip_m) & ~np.isin(classification, PLANT_CLASSES))
    if len(strip) == 0 or len(within) < RULES.num_points:
        return result
    other_z = _surface(point_m[beyond], point_m[strip])
    strip, other_z = strip[np.isfinite(other_z)], other_z[np.isfinite(other_z)]
    own_z, z = _surface(point_m[within], point_m[strip]), point_m[strip, 2]
    off_own, off_other = np.abs(z - own_z), np.abs(z - other_z)
    continues = (off_other < RULES.on_m) & (off_own > 2 * RULES.on_m)
    is_wall = (z > own_z + 2 * RULES.on_m) & (z < other_z) & (depth_m[strip] < RULES.wall_m)
    theirs = (np.abs(other_z - own_z) > RULES.step_m) & (continues | is_wall)
    if theirs.any():
        result = result.copy()
        result[strip[theirs]] = NEIGHBOUR_CLASS
    return result


def _surface(point_m: np.ndarray, place_m: np.ndarray) -> np.ndarray:
    """The height at places (n, 2 or more) of the plane of the points (m, 3) nearest to each, (n,); NaN where they do
    not show one."""
    result = np.full(len(place_m), np.nan)
    reach_m, near = cKDTree(point_m[:, :2]).query(place_m[:, :2], RULES.num_points)
    is_near = reach_m[:, RULES.num_near] < RULES.reach_m
    near, place_m = near[is_near], place_m[is_near]
    around = point_m[near] - np.column_stack([place_m[:, :2], np.zeros(len(place_m))])[:, None]
    design = np.concatenate([around[:, :, :2], np.ones((*near.shape, 1))], axis=2)
    z = around[:, :, 2]
    level = np.median(z, axis=1)
    value = np.column_stack([np.zeros((len(z), 2)), level])
    # a slope needs some points, but few points in a line show none across it
    prior = np.diag([0.5, 0.5, 1e-6])
    for _ in range(RULES.num_rounds):
        off_m = np.abs(z - (design @ value[:, :, None])[:, :, 0])
        weighted = (design / np.maximum(off_m, RULES.noise_m)[:, :, None]).transpose(0, 2, 1)
        right = weighted @ (z - level[:, None])[:, :, None]
        value = np.linalg.solve(weighted @ design + prior, right)[:, :, 0]
        value[:, 2] += level
    is_steep = np.hypot(value[:, 0], value[:, 1]) >= RULES.steepest
    result[is_near] = np.where(is_steep, np.nan, value[:, 2])
    return result
