"""Footprints that the cloud contradicts: without a building, partly demolished, with roofs or without points beyond.

The evidence is counted in cells of 1 m. A cell is ground if it has ground points and none of class building, and roof
if it has at least as many points of class building as of ground. Only compact areas count: those that squares of three
by three cells cover, which footprints some decimetres beside their walls do not have. The area of cells without points,
of which sparse clouds have many, is that of those around them, in equal parts. At 1 point/m2 a tenth is missed still.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.clouds.cropping import crop_points
from p2wss.clouds.crops import LOWEST_RINGS_M, ground_height
from p2wss.clouds.reading import Cloud
from p2wss.data import polygon_arrays, reasons
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS
from p2wss.skeleton.types import Polygons, distinct, numbered


@dataclass(frozen=True)
class Rules:
    """What contradicts a footprint.

    beyond_m, contact_m: how far beyond a footprint roofs are counted, and how near the nearest must be. min_cells:
    least cells with evidence of a square of nine, and of a footprint. min_area_m2: of ground inside or roofs outside
    that is flagged, or inside with no point in the cells of half of ``beyond_m`` around; of these, as large a share of
    the footprint as ``min_far_share``. min_ground_share, max_roof_share: of the cells with points, where there is no
    building. min_unseen_share: of its area without a point in the cells, where the others have ``min_in_cell`` on
    average, as there are so many in sparse clouds.

    min_wall_m, level_m, min_length_m: a cell of ground, of half of ``beyond_m``, has a wall if one beside it is so much
    lower. If so many metres of walls, where the lowest points around a footprint are searched, are as high as the
    ground there, up to so far apart, that is no ground. On a podium in Toronto there are 200 m at least, in twelve
    other places less than 60 m.
    """

    beyond_m: float = 6.0
    contact_m: float = 1.5
    min_cells: int = 5
    min_area_m2: float = 10.0
    min_ground_share: float = 0.7
    max_roof_share: float = 0.1
    min_far_share: float = 0.1
    min_unseen_share: float = 0.5
    min_in_cell: float = 3.0
    min_wall_m: float = 3.0
    level_m: float = 1.5
    min_length_m: float = 100.0


RULES = Rules()


@dataclass(frozen=True)
class Evidence:
    """The evidence in the cloud that contradicts n footprints.

    ground_inside_m2: compact ground area inside each, (n,). roof_outside_m2: compact roof area outside all footprints
    and nearest to each, up to 6 m away, (n,). flags: per footprint the names of the flags that follow
    (:data:`p2wss.data.reasons.FLAGS`).
    """

    ground_inside_m2: np.ndarray
    roof_outside_m2: np.ndarray
    flags: list[tuple[str, ...]]


def contradictions(polygons: Polygons, cloud: Cloud) -> Evidence:
    """The evidence against footprints."""
    count = len(polygons)
    cells = _Cells(cloud.x_m, cloud.y_m, cloud.classification)
    cell, inside, offset = crop_points(cells.x_m, cells.y_m, polygons, RULES.beyond_m)
    footprint = np.repeat(np.arange(count), np.diff(offset))
    of_cell = np.full(len(cells.x_m), -1)
    of_cell[cell[inside][::-1]] = footprint[inside][::-1]
    in_any = of_cell >= 0

    num_ground, num_roof = cells.around(cells.is_ground), cells.around(cells.is_roof)
    demolished = cells.spread(
        (cells.around(~in_any) == 0) & (num_roof == 0) & (num_ground >= RULES.min_cells)
    )
    is_inside = demolished & in_any
    ground_inside_m2 = np.bincount(of_cell[is_inside], cells.area_m2[is_inside], minlength=count)
    beyond = cells.spread((cells.around(in_any) == 0) & (num_ground == 0) & (num_roof >= RULES.min_cells))
    roof_outside_m2 = _of_nearest(polygons, cells, footprint, cell, beyond)

    has_points = np.bincount(of_cell[in_any], minlength=count)
    ground_share = np.bincount(of_cell[in_any & cells.is_ground], minlength=count) / np.maximum(has_points, 1)
    roof_share = np.bincount(of_cell[in_any & cells.is_roof], minlength=count) / np.maximum(has_points, 1)
    is_empty = (
        (has_points >= RULES.min_cells)
        & (ground_share >= RULES.min_ground_share)
        & (roof_share <= RULES.max_roof_share)
    )
    shapes = polygon_arrays.to_geometries(polygons)
    area_m2 = shapely.area(shapes)
    is_cut = _far_m2(shapes, cells) >= np.maximum(RULES.min_area_m2, RULES.min_far_share * area_m2)
    num_points = np.bincount(of_cell[in_any], cells.num_points[in_any], minlength=count)
    is_unseen = area_m2 - has_points >= np.maximum(RULES.min_area_m2, RULES.min_unseen_share * area_m2)
    is_cut |= is_unseen & (num_points >= RULES.min_in_cell * has_points)
    rules = (
        (reasons.NO_BUILDING, is_empty),
        (reasons.PARTLY_DEMOLISHED, ~is_empty & (ground_inside_m2 >= RULES.min_area_m2)),
        (reasons.EXTENDED, ~is_empty & (roof_outside_m2 >= RULES.min_area_m2)),
        (reasons.BEYOND_POINTS, is_cut & (has_points > 0)),
    )
    flags = [tuple(name for name, rows in rules if rows[k]) for k in range(count)]
    return Evidence(ground_inside_m2, roof_outside_m2, flags)


def on_raised_ground(polygons: Polygons, cloud: Cloud) -> np.ndarray:
    """Whether the ground around each footprint ends in walls, as a podium does, bool (n,)."""
    is_ground = cloud.classification == GROUND_CLASS
    size_m = RULES.beyond_m / 2
    x_m, y_m, z_m = (column[is_ground] for column in (cloud.x_m, cloud.y_m, cloud.z_m))
    cells = _Cells(x_m / size_m, y_m / size_m, cloud.classification[is_ground])
    least_z = np.full(len(cells.x_m), np.inf)
    np.minimum.at(least_z, cells.of_point, z_m)
    edge = np.flatnonzero(
        least_z - np.append(least_z, np.inf)[cells.neighbour].min(axis=0) >= RULES.min_wall_m
    )
    near, _, offset = crop_points(
        size_m * cells.x_m[edge], size_m * cells.y_m[edge], polygons, LOWEST_RINGS_M[1]
    )
    footprint = np.repeat(np.arange(len(polygons)), np.diff(offset))
    apart_m = least_z[edge[near]] - ground_height(cloud, polygons)[0][footprint]
    num_level = np.bincount(footprint[np.abs(apart_m) <= RULES.level_m], minlength=len(polygons))
    return np.asarray(size_m * num_level >= RULES.min_length_m)


def _far_m2(shapes: np.ndarray, cells: _Cells) -> np.ndarray:
    """The area (n,) of polygons (n,) that is far from all points."""
    size_m = RULES.beyond_m / 2
    step = np.add.outer(np.arange(-1, 2), 1j * np.arange(-1, 2)).ravel()
    # as complex numbers, which sort by the first and then the second coordinate
    near = distinct(np.floor(cells.x_m / size_m) + 1j * np.floor(cells.y_m / size_m))
    near, result = distinct(np.add.outer(near, step)), np.zeros(len(shapes))
    for k, shape in enumerate(shapes):
        if shape.is_empty:
            continue
        low_x, low_y, high_x, high_y = np.floor(np.array(shape.bounds) / size_m)
        some = near[slice(*np.searchsorted(near.real, [low_x, high_x + 1]))]
        some = some[(some.imag >= low_y) & (some.imag <= high_y)]
        num_far = (high_x - low_x + 1) * (high_y - low_y + 1) - len(some)
        if num_far > len(some):  # what is near is less work: of a footprint of a country, far less
            result[k] = shape.area - _area_in(shape, some, size_m)
        elif num_far:
            place = np.add.outer(np.arange(low_x, high_x + 1), 1j * np.arange(low_y, high_y + 1)).ravel()
            far = place[np.searchsorted(near, place) == np.searchsorted(near, place, "right")]
            result[k] = _area_in(shape, far, size_m)
    return result


def _area_in(shape: shapely.Polygon, cell: np.ndarray, size_m: float) -> float:
    """The area of a polygon in cells, numbered by complex numbers."""
    x_m, y_m = size_m * cell.real, size_m * cell.imag
    box = shapely.box(x_m, y_m, x_m + size_m, y_m + size_m)
    return float(shapely.area(shapely.intersection(shape, box)).sum())


def _of_nearest(
    polygons: Polygons, cells: _Cells, footprint: np.ndarray, cell: np.ndarray, beyond: np.ndarray
) -> np.ndarray:
    """Area of the cells ``beyond`` nearest to each footprint, 0 where none of them touches it."""
    pairs = np.flatnonzero(beyond[cell])
    footprint, cell = footprint[pairs], cell[pairs]
    shapes = polygon_arrays.to_geometries(polygons)[footprint]
    distance_m = shapely.distance(shapes, shapely.points(cells.x_m[cell], cells.y_m[cell]))
    order = np.lexsort([footprint, distance_m, cell])
    nearest = order[np.unique(cell[order], return_index=True)[1]]
    area_m2 = np.bincount(footprint[nearest], cells.area_m2[cell[nearest]], minlength=len(polygons))
    closest_m = np.full(len(polygons), np.inf)
    np.minimum.at(closest_m, footprint[nearest], distance_m[nearest])
    return np.where(closest_m <= RULES.contact_m, area_m2, 0.0)


class _Cells:
    """The cells of 1 m that have points, at whole metres. of_point: of each, their numbers. x_m, y_m: their centres.
    num_points: in each. is_ground, is_roof: masks. area_m2: of each with its share of those around it that have none.
    neighbour: (9, cells), those around each; the number of all cells for one without points."""

    def __init__(self, x_m: np.ndarray, y_m: np.ndarray, classification: np.ndarray) -> None:
        column, row = np.floor(x_m).astype(np.int64), np.floor(y_m).astype(np.int64)
        first, last = (int(column.min()), int(column.max())) if len(column) else (0, 0)
        # a column more on either side, so that no cell has a neighbour in another row
        self._left, self._width = first - 1, last - first + 3
        key = row * self._width + column - self._left
        self._key, self.of_point = numbered(key)
        count = len(self._key)
        self.num_points = np.bincount(self.of_point, minlength=count)
        num_ground = np.bincount(self.of_point[classification == GROUND_CLASS], minlength=count)
        num_roof = np.bincount(self.of_point[classification == BUILDING_CLASS], minlength=count)
        self.is_roof = (num_roof > 0) & (num_roof >= num_ground)
        self.is_ground = (num_ground > 0) & (num_roof == 0)
        self.x_m = self._key % self._width + self._left + 0.5
        self.y_m = self._key // self._width + 0.5
        steps = [row * self._width + column for row in (-1, 0, 1) for column in (-1, 0, 1)]
        self.neighbour = np.full((9, count), count)
        for k, step in enumerate(steps):
            place = np.minimum(np.searchsorted(self._key, self._key + step), count - 1)
            exists = self._key[place] == self._key + step
            self.neighbour[k, exists] = place[exists]
        self.area_m2 = 9 / self.around(np.ones(count, bool))

    def around(self, mask: np.ndarray) -> np.ndarray:
        """How many of the nine cells around each are in the mask."""
        return np.append(mask, False)[self.neighbour].sum(axis=0)

    def spread(self, mask: np.ndarray) -> np.ndarray:
        """The cells around which one of nine is in the mask."""
        return self.around(mask) > 0
