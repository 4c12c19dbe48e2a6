"""Building and ground points for clouds without these classes, from heights above the ground and planarity.

Ground: the lowest points of cells of 1 m, opened with growing windows; what an opening lowers by more than a slope
allows is not ground (K. Pingel et al. 2013, "An improved simple morphological filter for the terrain classification of
airborne LIDAR data"). Buildings: points at least 2 m above the ground whose neighbours lie on planes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy

from p2wss.clouds.reading import Cloud
from p2wss.data.las_classes import (
    BUILDING_CLASS,
    GROUND_CLASS,
    PLANT_CLASSES,
    UNCLASSIFIED_CLASS,
    VEGETATION_CLASS,
    WATER_CLASS,
    has_class,
)
from p2wss.data.points import MIN_HEIGHT_M
from p2wss.data.tiling import Bounds, grown
from p2wss.skeleton.nearest import nearest
from p2wss.skeleton.types import numbered


@dataclass(frozen=True)
class Rules:
    """What is ground, and what lies on a plane; set by hand.

    max_radius_m: half the width of the widest building that is not taken for ground. low_percentile, max_below_m:
    without single low outliers, a cell counts as no lower than this below the second lowest of the nine around it, and
    a point that all others there are so far above is none of its, in so many rounds, num_alone.
    max_roughness_m: rms distance of neighbours, no further than max_distance_m, from their plane. steepest_deg: plane.
    """

    cell_m: float = 1.0
    max_radius_m: int = 30
    ground_slope: float = 0.15
    low_percentile: int = 20
    max_below_m: float = 1.0
    num_alone: int = 3
    ground_tolerance_m: float = 0.4
    num_neighbours: int = 12
    max_distance_m: float = 2.0
    max_roughness_m: float = 0.12
    steepest_deg: float = 75.0


RULES = Rules()
_CHUNK = 10_000
# the raster of a cloud with more cells is made tile by tile, each of so many cells along a side: houses that lie over
# 8 x 10 km, or a corridor of 50 km, are hardly any of what is around them
_MAX_CELLS, _TILE_CELLS = 8_000_000, 1000
# metres around a tile in which points tell what is ground in it
_TILE_MARGIN_M = 200.0
# what the producer missed: of a cell, at least this share of the points that are high lies on planes; cells across the
# narrowest, as trains and lorries are 3 m wide; square metres of the smallest
_FLAT_SHARE, _MIN_WIDTH_CELLS, _MISSED_M2 = 0.5, 5, 40.0
_WITHOUT_GROUND = (
    "ground is estimated from the lowest points; a classification by the producer, or by PDAL's filters.smrf, may be"
    " more accurate"
)
_WITHOUT_BUILDINGS = (
    "points 2 m above the ground that lie on planes, of vegetation (3 to 5) too, are used as building points"
)
_IN_FOOTPRINTS = (
    " (in footprints with fewer than five of them, all points 2 m above the ground), and footprints are moved by"
    " 0.7 m at least, or not at all (--registration never, or always: as with class 6)"
)
_WITHOUT_FOOTPRINTS = (
    ", and trees may become buildings; give footprints, or a cloud whose buildings the producer classified, if there"
    " are any"
)


def with_classes(cloud: Cloud) -> tuple[Cloud, list[str]]:
    """The cloud with ground and building points where it has none at all of a class, and a warning for each class.

    Only points that are unclassified, vegetation, of overlapping flights or of a class without a meaning in LAS get
    another class; those of vegetation are no ground.
    """
    classes = cloud.classification
    if not len(cloud):
        return cloud, []
    has_ground, has_buildings = (classes == GROUND_CLASS).any(), (classes == BUILDING_CLASS).any()
    if not has_ground:
        is_lowest = np.zeros(len(cloud), bool)
        for near, inside in _with_surroundings(cloud):
            lowest = _lowest(cloud.x_m[near], cloud.y_m[near], cloud.z_m[near])
            is_lowest[near[inside]] = lowest[inside]
        may_be_ground = is_open(classes) & ~has_class(classes, PLANT_CLASSES)
        classes = np.where(may_be_ground & is_lowest, GROUND_CLASS, classes).astype(np.uint8)
    if not has_buildings:
        height_m = cloud.z_m - ground_z_m(replace(cloud, classification=classes))
        candidates = np.flatnonzero(is_open(classes) & (height_m >= MIN_HEIGHT_M))
        is_planar = planar(np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])[candidates])
        classes = classes.copy()
        classes[candidates] = np.where(is_planar, BUILDING_CLASS, VEGETATION_CLASS)
    return replace(cloud, classification=classes), warnings(int(not has_ground), int(not has_buildings), 0)


def with_missed_buildings(cloud: Cloud) -> tuple[Cloud, float]:
    """(a cloud with class building, which the unclassified points of buildings that the producer missed have, too; the
    area of these in square metres). These are on planes 2 m above the ground, in areas at least 5 m wide of 40 m2 and
    more without points of the ground and of class building: neither trees nor trains and lorries are."""
    classes = cloud.classification
    is_high = (classes <= UNCLASSIFIED_CLASS) & (cloud.z_m - ground_z_m(cloud) >= MIN_HEIGHT_M)
    is_flat, is_missed = np.zeros((2, len(cloud)), bool)
    is_flat[is_high] = planar(np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])[is_high])
    is_taken = has_class(classes, (GROUND_CLASS, BUILDING_CLASS))
    area_m2 = 0.0
    for near, inside in _with_surroundings(cloud):
        row, column, shape = _cells(cloud.x_m[near], cloud.y_m[near])
        cell, size = row * shape[1] + column, shape[0] * shape[1]
        num_high, num_flat, num_taken = (
            np.bincount(cell, of_class[near], size).reshape(shape)
            for of_class in (is_high, is_flat, is_taken)
        )
        is_roof = (num_flat > 0) & (num_flat >= _FLAT_SHARE * num_high) & (num_taken == 0)
        is_roof |= scipy.ndimage.binary_closing(is_roof, np.ones((3, 3))) & (num_taken == 0)
        core = scipy.ndimage.binary_opening(is_roof, np.ones((_MIN_WIDTH_CELLS, _MIN_WIDTH_CELLS)))
        area = scipy.ndimage.label(scipy.ndimage.binary_propagation(core, mask=is_roof))[0]
        is_large = np.bincount(area.ravel()) * RULES.cell_m**2 >= _MISSED_M2
        is_large[0] = False
        own = inside & is_large[area.ravel()[cell]]
        is_missed[near[own]] = True
        area_m2 += len(np.unique(cell[own])) * RULES.cell_m**2
    return replace(cloud, classification=np.where(is_missed & is_flat, BUILDING_CLASS, classes)), area_m2


def warnings(num_without_ground: int, num_without_buildings: int, num_footprints: int) -> list[str]:
    """A warning for each class that the points around some footprints lack, or those of a cloud without footprints."""
    result: list[str] = []
    of_buildings = _WITHOUT_BUILDINGS + (_IN_FOOTPRINTS if num_footprints else _WITHOUT_FOOTPRINTS)
    for count, number, text in (
        (num_without_ground, "2 (ground)", _WITHOUT_GROUND),
        (num_without_buildings, "6 (building)", of_buildings),
    ):
        if count:
            some = (
                "the footprints" if count == num_footprints else f"{count} of the {num_footprints} footprints"
            )
            around = f" around {some}" if num_footprints else ""
            result.append(f"no point{around} has class {number}: {text}")
    return result


def is_open(classes: np.ndarray) -> np.ndarray:
    """Whether a point of each class may be ground or building. Where flights overlap, producers gave the points of one
    of them class 12 (LAS 1.1 to 1.3), whatever they are on."""
    meanings = (GROUND_CLASS, BUILDING_CLASS, WATER_CLASS, 10, 11, *range(13, 19))
    return (classes <= UNCLASSIFIED_CLASS) | ~np.isin(classes, meanings)


def tiles(x_m: np.ndarray, y_m: np.ndarray, cell_m: float) -> list[Bounds]:
    """Windows of whole cells that are apart and have all points (n,) of a cloud, each with some of them: one without
    limits, unless its raster would be too large."""
    if np.ptp(x_m) * np.ptp(y_m) <= _MAX_CELLS * cell_m**2:
        return [(-np.inf, -np.inf, np.inf, np.inf)]
    side_m = _TILE_CELLS * cell_m
    corner_m = np.unique(np.floor(np.column_stack([x_m, y_m]) / side_m), axis=0) * side_m
    return [(x, y, x + side_m, y + side_m) for x, y in corner_m.tolist()]


def _with_surroundings(cloud: Cloud) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Of each tile (rows of the points in it and around it, which of these are inside)."""
    for tile in tiles(cloud.x_m, cloud.y_m, RULES.cell_m):
        near = np.flatnonzero(in_window(cloud.x_m, cloud.y_m, grown(tile, _TILE_MARGIN_M)))
        yield near, in_window(cloud.x_m[near], cloud.y_m[near], tile)


def in_window(x_m: np.ndarray, y_m: np.ndarray, window: Bounds) -> np.ndarray:
    """Whether each point is in a window, bool (n,); its north and east sides are not."""
    return np.asarray((x_m >= window[0]) & (x_m < window[2]) & (y_m >= window[1]) & (y_m < window[3]))


def _cells(x_m: np.ndarray, y_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """(row of each point, its column, shape of the raster); cells begin at whole metres, whatever the window."""
    row, column = (
        np.floor(y_m / RULES.cell_m).astype(np.int64),
        np.floor(x_m / RULES.cell_m).astype(np.int64),
    )
    row, column = row - row.min(), column - column.min()
    return row, column, (int(row.max()) + 1, int(column.max()) + 1)


def filled(raster: np.ndarray) -> np.ndarray:
    """The raster with the nearest value in cells without one (NaN)."""
    index = scipy.ndimage.distance_transform_edt(
        np.isnan(raster), return_distances=False, return_indices=True
    )
    return raster[tuple(index)]


def _lowest(x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    """Whether each point is ground, bool (n,)."""
    row, column, shape = _cells(x_m, y_m)
    is_alone, around = np.zeros(len(z_m), bool), np.ones((3, 3), bool)
    around[1, 1] = False
    for _ in range(RULES.num_alone):
        lowest, second = (np.full(shape, np.inf) for _ in range(2))
        np.minimum.at(lowest, (row, column), np.where(is_alone, np.inf, z_m))
        is_lowest = z_m == lowest[row, column]
        np.minimum.at(second, (row, column), np.where(is_alone | is_lowest, np.inf, z_m))
        second = np.minimum(second, scipy.ndimage.minimum_filter(lowest, footprint=around))
        is_alone |= is_lowest & (second > lowest + RULES.max_below_m)[row, column]
    lowest = np.full(shape, np.inf)
    np.minimum.at(lowest, (row, column), np.where(is_alone, np.inf, z_m))
    lowest[np.isinf(lowest)] = np.nan
    surface = filled(lowest)
    low = scipy.ndimage.percentile_filter(surface, RULES.low_percentile, 3)
    surface = np.maximum(surface, low - RULES.max_below_m)
    is_object = np.zeros(shape, bool)
    opened = surface
    for radius in range(1, int(RULES.max_radius_m / RULES.cell_m) + 1):
        size = 2 * radius + 1
        after = scipy.ndimage.grey_opening(opened, (size, size)) if radius < 4 or radius % 3 == 0 else opened
        is_object |= opened - after > RULES.ground_slope * radius * RULES.cell_m
        opened = after
    ground = filled(np.where(is_object | np.isnan(lowest), np.nan, surface))
    height_m = z_m - ground[row, column]
    return (height_m <= RULES.ground_tolerance_m) & (~is_alone | (height_m >= -RULES.ground_tolerance_m))


def ground_z_m(cloud: Cloud) -> np.ndarray:
    """The height of the ground at each point, float64 (n,): the mean ground point of its cell or of the nearest."""
    row, column, (num_rows, _) = _cells(cloud.x_m, cloud.y_m)
    is_ground = cloud.classification == GROUND_CLASS
    if not is_ground.any():
        return np.full(len(cloud), cloud.z_m.min())
    cell = column * num_rows + row
    wanted, of_point = numbered(cell)
    count = np.bincount(of_point[is_ground])
    known = np.flatnonzero(count)
    mean_m = np.bincount(of_point[is_ground], cloud.z_m[is_ground])[known] / count[known]
    # the transform of :func:`filled` gives the same, but loading it is a twentieth of a small run
    place, at = (np.column_stack(np.divmod(cells, num_rows)) for cells in (wanted[known], wanted))
    return mean_m[nearest(place, at)[1][of_point, 0]]


def planar(xyz_m: np.ndarray) -> np.ndarray:
    """Whether each point is on a plane with most of its neighbours, bool (n,)."""
    if len(xyz_m) <= RULES.num_neighbours:
        return np.zeros(len(xyz_m), bool)
    local = xyz_m - np.floor(xyz_m.min(axis=0))
    distance_m, neighbour = nearest(local, local, RULES.num_neighbours)
    is_flat = distance_m[:, -1] <= RULES.max_distance_m
    for first in range(0, len(local), _CHUNK):
        rows = slice(first, first + _CHUNK)
        around = local[neighbour[rows]]
        around = around - around.mean(axis=1, keepdims=True)
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / RULES.num_neighbours)
        is_flat[rows] &= np.sqrt(np.maximum(values[:, 0], 0)) <= RULES.max_roughness_m
        is_flat[rows] &= np.abs(vectors[:, 2, 0]) >= np.cos(np.radians(RULES.steepest_deg))
    # edges and chimneys of a roof are among its points, single branches of a tree are not
    return is_flat[neighbour].mean(axis=1) >= 0.5
