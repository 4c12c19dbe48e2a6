"""The points on a building: one definition for crops of real LiDAR, fit, flat roofs, residuals and measures.

Crops of simulated scans do not need it, because there each point has the label of its face.
"""

import numpy as np
import shapely

from p2wss.data.las_classes import (
    BUILDING_CLASS,
    GROUND_CLASS,
    NOISE_CLASSES,
    PLANT_CLASSES,
    WATER_CLASS,
    has_class,
)

# with fewer points of class building, or a smaller share of the points that may be on the building, the classifier has
# missed it
MIN_CLASSIFIED_POINTS, MIN_CLASSIFIED_SHARE = 5, 0.2
# lower points on a building that the classifier has missed may be a car, a hedge or rough ground
MIN_HEIGHT_M = 2.0
NEVER_ON_A_BUILDING = (GROUND_CLASS, WATER_CLASS, *NOISE_CLASSES)


def stride(num: int, max_count: int) -> int:
    """The smallest step k with which every k-th of ``num`` values makes at most ``max_count``; it needs no random
    draw."""
    return max(-(-num // max_count), 1)


def points_on_building(
    polygon: shapely.Polygon, point_m: np.ndarray, classification: np.ndarray
) -> np.ndarray:
    """Mask of the points (m, 3) that are on the building with the footprint ``polygon``, bool (m,); z above the ground.

    These are the points of class building inside the polygon, unless the classifier has missed the building. Then they
    are the points inside it that are at least 2 m above the ground and neither ground, noise, water nor plants; with
    fewer than five such points, plants count, too. A building counts as missed with fewer than five points of class
    building, or fewer than a fifth of the number of such points. Points outside the footprint never count: in a row of
    houses they belong to the neighbours.
    """
    inside = shapely.contains_xy(polygon, point_m[:, 0], point_m[:, 1])
    offset = np.array([0, len(point_m)])
    return points_on_buildings(inside, classification, point_m[:, 2], offset)


def points_on_buildings(
    inside: np.ndarray, classification: np.ndarray, height_m: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """As :func:`points_on_building`, for many buildings at once: bool (num_points,).

    inside: bool (num_points,), whether a point is inside the footprint. height_m: float64 (num_points,), above the
    ground at the building. offset: building b has the points ``offset[b]:offset[b + 1]``.
    """
    counts = np.diff(offset)
    building = np.repeat(np.arange(len(counts)), counts)
    is_classified = inside & (classification == BUILDING_CLASS)
    is_high = inside & ~has_class(classification, NEVER_ON_A_BUILDING) & (height_m >= MIN_HEIGHT_M)
    is_solid = is_high & ~has_class(classification, PLANT_CLASSES)
    num_classified, num_high, num_solid = (
        np.bincount(building[each], minlength=len(counts)) for each in (is_classified, is_high, is_solid)
    )
    is_missed = (num_high > 0) & (
        num_classified < np.maximum(MIN_CLASSIFIED_POINTS, MIN_CLASSIFIED_SHARE * num_solid)
    )
    is_on = np.where((num_solid >= MIN_CLASSIFIED_POINTS)[building], is_solid, is_high)
    return np.where(is_missed[building], is_on, is_classified)


def on_millimetres(xyz_m: np.ndarray, origin_xy_m: np.ndarray) -> np.ndarray:
    """Points (n, 3) with x and y relative to an origin of whole metres, on a grid of millimetres.

    A point in whole centimetres is then bit-identical to the same point of a crop, which stores centimetres;
    without the grid, its coordinates would depend on the rounding of large numbers.
    """
    return np.rint(1000 * (xyz_m - [*origin_xy_m, 0.0])) / 1000
