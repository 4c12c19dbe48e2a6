"""Building and ground points for clouds without these classes, from heights above the ground and planarity.

Ground: a raster of the lowest points in cells of 1 m is opened (a morphological opening) with growing windows. A cell
that an opening lowers by more than a slope allows is not ground (K. Pingel et al. 2013, "An improved simple
morphological filter for the terrain classification of airborne LIDAR data"). Buildings: points at least 2 m above the
ground whose neighbours lie on planes.
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
    PERHAPS_ROOF_CLASS,
    PLANT_CLASSES,
    UNCLASSIFIED_CLASS,
    VEGETATION_CLASS,
    WATER_CLASS,
    has_class,
)
from p2wss.data.points import MIN_HEIGHT_M
from p2wss.data.tiling import Bounds, bounds_of_points, grown
from p2wss.skeleton.nearest import nearest
from p2wss.skeleton.types import numbered


@dataclass(frozen=True)
class Planar:
    """When a point lies on a plane. num_neighbours, max_distance_m: it needs this many neighbours within this distance.
    max_roughness_m: largest rms distance of the neighbours from their plane. least_share: of the neighbours of a point
    on a plane, this share at least is on planes. steepest_deg: largest slope of these planes."""

    num_neighbours: int = 12
    max_distance_m: float = 2.0
    max_roughness_m: float = 0.12
    least_share: float = 0.5
    steepest_deg: float = 75.0


@dataclass(frozen=True)
class Rules:
    """What is ground, and what lies on a plane; set by hand.

    cell_m: side of a cell. max_radius_m: half the width of the widest building that is not taken for ground.
    ground_slope: an object is lowered by an opening by more than this slope times the radius of the opening.
    low_percentile, max_below_m: a cell counts as at most ``max_below_m`` lower than this percentile, the second lowest,
    of the nine cells around it. A point more than ``max_below_m`` below all other points of these nine cells is an
    outlier; num_alone: rounds in which outliers are removed. ground_tolerance_m: ground points are at most this far
    from the raster of the ground.

    planar: when a point lies on a plane. planar_margin_m: points farther than this, three neighbourhoods, do not tell.
    sparse_m, sparse_planar: points are sparse if the last of their neighbours is farther in plan. Such neighbours are
    of several roofs. By the looser rules, most points of a roof lie on planes, but many of a tree, too: they hold in
    footprints, where few trees are. They were chosen on Delft and Adelaide, thinned to 1, 2 and 4 points per m2.

    flat_share, min_width_cells, missed_m2: buildings that the producer missed. At least this share of the high points
    of a cell lies on planes; least width, as trains and lorries are 3 m wide; least area in square metres.
    last_known_class, unknown_share: LAS gives no class of ground, buildings or plants beyond; a warning is due if more
    points than this share have such a class.
    """

    cell_m: float = 1.0
    max_radius_m: int = 30
    ground_slope: float = 0.15
    low_percentile: int = 20
    max_below_m: float = 1.0
    num_alone: int = 3
    ground_tolerance_m: float = 0.4
    planar: Planar = Planar()
    planar_margin_m: float = 9.0
    sparse_m: float = 0.85
    sparse_planar: Planar = Planar(8, max_distance_m=3.0, max_roughness_m=0.15, least_share=0.34)
    flat_share: float = 0.5
    min_width_cells: int = 5
    missed_m2: float = 40.0
    last_known_class: int = 18
    unknown_share: float = 0.3


RULES = Rules()
_CHUNK = 10_000
# a raster of more cells than the first is made tile by tile, with the second as cells along the side of a tile. Points
# scattered over 8 x 10 km, or along a corridor of 50 km, would leave most cells of one raster empty
_MAX_CELLS, _TILE_CELLS = 8_000_000, 1000
# points up to this many metres around a tile help to tell its ground
_TILE_MARGIN_M = 200.0
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
    ", and trees and bridges may become buildings; give footprints, or a cloud whose buildings the producer classified,"
    " if there are any"
)


def with_classes(cloud: Cloud, wanted: np.ndarray | None = None) -> tuple[Cloud, list[str]]:
    """The cloud with class ground, class building or both added if it has no point of that class; a warning for each.

    Only points that are unclassified, vegetation, of overlapping flights or of a class without a meaning in LAS get
    another class. Points of vegetation may become buildings, but not ground. wanted: bool (n,), the points that need
    class building; the others are only around them. None: all points.
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
        candidates = np.flatnonzero(is_open(classes) & (height_m >= MIN_HEIGHT_M) & _near(cloud, wanted))
        high_m = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])[candidates]
        is_planar = planar(high_m)
        others = np.where(_perhaps_planar(high_m, ~is_planar), PERHAPS_ROOF_CLASS, VEGETATION_CLASS)
        classes = classes.copy()
        classes[candidates] = np.where(is_planar, BUILDING_CLASS, others)
    return replace(cloud, classification=classes), warnings(int(not has_ground), int(not has_buildings), 0)


def _near(cloud: Cloud, wanted: np.ndarray | None) -> np.ndarray:
    """bool (n,): the points that may decide whether the ``wanted`` points lie on planes."""
    if wanted is None:
        return np.ones(len(cloud), bool)
    bounds = bounds_of_points(cloud.x_m[wanted], cloud.y_m[wanted])
    if bounds is None:
        return wanted
    return in_window(cloud.x_m, cloud.y_m, grown(bounds, RULES.planar_margin_m))


def with_missed_buildings(cloud: Cloud) -> tuple[Cloud, float]:
    """(the cloud, in which unclassified points of missed buildings get class building; the area of these buildings).

    The producer has missed a building where unclassified points lie on planes at least 2 m above the ground, in an area
    of at least 40 m2 that is at least 5 m wide and has no points of class ground or building. Trees, trains and lorries
    do not meet these rules."""
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
        is_roof = (num_flat > 0) & (num_flat >= RULES.flat_share * num_high) & (num_taken == 0)
        is_roof |= scipy.ndimage.binary_closing(is_roof, np.ones((3, 3))) & (num_taken == 0)
        core = scipy.ndimage.binary_opening(is_roof, np.ones((RULES.min_width_cells, RULES.min_width_cells)))
        area = scipy.ndimage.label(scipy.ndimage.binary_propagation(core, mask=is_roof))[0]
        is_large = np.bincount(area.ravel()) * RULES.cell_m**2 >= RULES.missed_m2
        is_large[0] = False
        own = inside & is_large[area.ravel()[cell]]
        is_missed[near[own]] = True
        area_m2 += len(np.unique(cell[own])) * RULES.cell_m**2
    return replace(cloud, classification=np.where(is_missed & is_flat, BUILDING_CLASS, classes)), area_m2


def warnings(num_without_ground: int, num_without_buildings: int, num_footprints: int) -> list[str]:
    """A warning for class ground and one for class building, where points lack the class. The first two numbers are
    footprints around which no point has the class; num_footprints: all with points around. For a cloud without
    footprints, num_footprints is 0, and the others are 1 if the cloud lacks the class."""
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


def warnings_of_unknown(counts: np.ndarray) -> list[str]:
    """A warning if many points have classes to which this package gives no meaning. counts: int (256,), the number of
    points of each class."""
    unknown = np.flatnonzero(counts)
    unknown = unknown[unknown > RULES.last_known_class]
    share = counts[unknown].sum() / max(counts.sum(), 1)
    if share < RULES.unknown_share:
        return []
    return [
        f"{share:.0%} of the points have class {', '.join(map(str, unknown))}, read as neither ground, building nor"
        " plants; if they are, region.classes says so: preset custom, with the producer's classes ground and building"
    ]


def is_open(classes: np.ndarray) -> np.ndarray:
    """Whether a point of each class may be ground or building in fact. That includes class 12: where flights overlap,
    producers gave it to all points of one flight (LAS 1.1 to 1.3)."""
    meanings = (GROUND_CLASS, BUILDING_CLASS, WATER_CLASS, 10, 11, *range(13, 19))
    return (classes <= UNCLASSIFIED_CLASS) | ~np.isin(classes, meanings)


def tiles(x_m: np.ndarray, y_m: np.ndarray, cell_m: float) -> list[Bounds]:
    """Disjoint windows that together contain all points (n,) of a cloud, none of them empty. It is one infinite window,
    unless its raster would be too large; else tiles of whole cells."""
    if np.ptp(x_m) * np.ptp(y_m) <= _MAX_CELLS * cell_m**2:
        return [(-np.inf, -np.inf, np.inf, np.inf)]
    side_m = _TILE_CELLS * cell_m
    corner_m = np.unique(np.floor(np.column_stack([x_m, y_m]) / side_m), axis=0) * side_m
    return [(x, y, x + side_m, y + side_m) for x, y in corner_m.tolist()]


def _with_surroundings(cloud: Cloud) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each tile: (indices of the points in it and around it, bool: which of these are inside)."""
    for tile in tiles(cloud.x_m, cloud.y_m, RULES.cell_m):
        near = np.flatnonzero(in_window(cloud.x_m, cloud.y_m, grown(tile, _TILE_MARGIN_M)))
        yield near, in_window(cloud.x_m[near], cloud.y_m[near], tile)


def in_window(x_m: np.ndarray, y_m: np.ndarray, window: Bounds) -> np.ndarray:
    """bool (n,): whether each point is in a window; its north and east sides are outside."""
    return np.asarray((x_m >= window[0]) & (x_m < window[2]) & (y_m >= window[1]) & (y_m < window[3]))


def _cells(x_m: np.ndarray, y_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """(row of each point, column of each point, shape of the raster). Cells begin at whole multiples of ``cell_m``."""
    row, column = (
        np.floor(y_m / RULES.cell_m).astype(np.int64),
        np.floor(x_m / RULES.cell_m).astype(np.int64),
    )
    row, column = row - row.min(), column - column.min()
    return row, column, (int(row.max()) + 1, int(column.max()) + 1)


def filled(raster: np.ndarray) -> np.ndarray:
    """The raster, in which cells without a value (NaN) get the value of the nearest cell with one."""
    index = scipy.ndimage.distance_transform_edt(
        np.isnan(raster), return_distances=False, return_indices=True
    )
    return raster[tuple(index)]


def _lowest(x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    """bool (n,): whether each point is ground, by the filter of the module's docstring."""
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
    """float64 (n,): the height of the ground at each point: the mean z of the ground points in its cell, or in the
    nearest cell with some; the lowest z of the cloud without ground points."""
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


def _perhaps_planar(xyz_m: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """bool (n,): which of the ``wanted`` points, bool (n,), are sparse and lie on planes by looser rules than
    :func:`planar`."""
    result, rows = np.zeros(len(xyz_m), bool), np.flatnonzero(wanted)
    if len(rows) and len(xyz_m) > RULES.planar.num_neighbours:
        xy_m = xyz_m[:, :2] - np.floor(xyz_m[:, :2].min(axis=0))
        rows = rows[nearest(xy_m, xy_m[rows], RULES.planar.num_neighbours)[0][:, -1] > RULES.sparse_m]
        result[rows] = planar(xyz_m, RULES.sparse_planar, rows)
    return result


def planar(xyz_m: np.ndarray, rules: Planar = RULES.planar, wanted: np.ndarray | None = None) -> np.ndarray:
    """bool (m,): whether at least ``least_share`` of the neighbours of each point lie on a plane with their own
    neighbours. wanted: int (m,), the points; None: all of ``xyz_m``, (n, 3)."""
    if len(xyz_m) <= rules.num_neighbours:
        return np.zeros(len(xyz_m if wanted is None else wanted), bool)
    local = xyz_m - np.floor(xyz_m.min(axis=0))
    distance_m, neighbour = nearest(local, local if wanted is None else local[wanted], rules.num_neighbours)
    of_wanted = neighbour
    if wanted is not None:
        # only their neighbours are asked for a plane
        asked, number = numbered(neighbour.ravel())
        of_wanted = number.reshape(neighbour.shape)
        distance_m, neighbour = nearest(local, local[asked], rules.num_neighbours)
    is_flat = distance_m[:, -1] <= rules.max_distance_m
    for first in range(0, len(neighbour), _CHUNK):
        rows = slice(first, first + _CHUNK)
        around = local[neighbour[rows]]
        around = around - around.mean(axis=1, keepdims=True)
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / rules.num_neighbours)
        is_flat[rows] &= np.sqrt(np.maximum(values[:, 0], 0)) <= rules.max_roughness_m
        is_flat[rows] &= np.abs(vectors[:, 2, 0]) >= np.cos(np.radians(rules.steepest_deg))
    # a share of the neighbours: edges and chimneys count as roof, single flat branches of a tree do not
    return is_flat[of_wanted].mean(axis=1) >= rules.least_share
