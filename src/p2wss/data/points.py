"""Which points are on a building: the one definition, for crops, fit, flat roofs, residuals and measures.

Labels of simulated crops are another matter: there every point carries the face that it was cast on.
"""

from __future__ import annotations

import numpy as np
import shapely

from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS, NOISE_CLASSES, WATER_CLASS

# with fewer points of the class building, a classifier has missed the building
MIN_CLASSIFIED_POINTS = 10
# of a building that a classifier has missed, what is lower may be a car, a hedge or rough ground
MIN_HEIGHT_M = 2.0
_NEVER_ON_A_BUILDING = (GROUND_CLASS, WATER_CLASS, *NOISE_CLASSES)


def points_on_building(
    polygon: shapely.Polygon, point_m: np.ndarray, classification: np.ndarray, ground_z_m: float
) -> np.ndarray:
    """Which points (m, 3) are on the building over ``polygon``, bool (m,).

    Those of the class building inside the polygon; where there are fewer than ten, all inside that are neither
    ground, noise nor water and at least 2 m above ``ground_z_m`` (if there are any). Never those of the ring around
    the footprint: in a row of houses they belong to the neighbours.
    """
    if not len(point_m):
        return np.zeros(0, bool)
    inside = shapely.contains_xy(polygon, point_m[:, 0], point_m[:, 1])
    offset = np.array([0, len(point_m)])
    return points_on_buildings(inside, classification, point_m[:, 2] - ground_z_m, offset)


def points_on_buildings(
    inside: np.ndarray, classification: np.ndarray, height_m: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """As :func:`points_on_building` for many buildings at once, bool (num_points,).

    inside: bool (num_points,), in the footprint. height_m: above the ground at the building. offset: building b has
    the points ``offset[b]:offset[b + 1]``.
    """
    counts = np.diff(offset)
    building = np.repeat(np.arange(len(counts)), counts)
    classified = inside & (classification == BUILDING_CLASS)
    missed = np.bincount(building[classified], minlength=len(counts)) < MIN_CLASSIFIED_POINTS
    if not missed.any():
        return classified
    others = inside & ~np.isin(classification, _NEVER_ON_A_BUILDING) & (height_m >= MIN_HEIGHT_M)
    missed &= np.bincount(building[others], minlength=len(counts)) > 0
    return np.where(missed[building], others, classified)


def on_centimetres(xyz_m: np.ndarray, origin_xy_m: np.ndarray) -> np.ndarray:
    """Points (n, 3) with x and y relative to an origin of whole metres, on the grid of centimetres on which crops
    are stored: so that a building is the same to the bit whether it was stored or not."""
    if not len(xyz_m):
        return xyz_m.reshape(0, 3)
    origin_z_m = np.round(np.median(xyz_m[:, 2]))
    point_cm = np.rint(100 * (xyz_m - [*origin_xy_m, origin_z_m]))
    point_cm[:, 2] += 100 * origin_z_m
    return point_cm / 100
