"""Footprints that the cloud contradicts: without a building, partly demolished, with roofs or without points beyond.

The evidence is counted in cells of 1 m. A cell is ground if it has ground points and no points of class building. It is
roof if it has at least as many points of class building as of ground. Only compact areas count: areas that squares of
three by three cells cover. A footprint some decimetres beside its walls has no such areas. Sparse clouds have many
cells without points: their area is shared equally among the cells with points around them. At 1 point/m2, a tenth is
missed still.
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

    beyond_m: roofs are counted up to this far beyond a footprint. contact_m: the nearest of them must be this near.
    min_cells: least number of cells with evidence in a square of nine, and of cells with points in a footprint.
    min_area_m2: least area that is flagged: ground inside, roofs outside, or area inside that is far from points, with
    no point in the cells of ``beyond_m / 2`` on and around it. min_far_share: least share of the footprint that is far
    from points. min_ground_share, max_roof_share: there is no building if, of the cells with points, at least and at
    most these shares are ground and roof. min_unseen_share: least share of the footprint in cells without a point; it
    counts only if the cells with points have at least ``min_in_cell`` points on average, as sparse clouds have many
    cells without points.

    min_wall_m, level_m, min_length_m: the rules of raised ground. A cell of ground, of side ``beyond_m / 2``, has a
    wall if a cell beside it is lower by at least ``min_wall_m``. Walls are searched where the lowest points around a
    footprint are. Raised ground has walls of at least ``min_length_m`` within ``level_m`` of the height of the ground
    at the footprint. A podium in Toronto has 200 m at least, twelve other places have less than 60 m.
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

    ground_inside_m2: (n,), compact ground area inside each footprint. roof_outside_m2: (n,), compact roof area outside
    all footprints, up to 6 m away and nearest to this footprint. flags: the names of the flags of each footprint
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
    """bool (n,): whether the ground around each footprint is raised: it ends in walls, as a podium does."""
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
    """float64 (n,): the area of each polygon in cells of ``beyond_m / 2`` that have no point, nor have the cells around
    them."""
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
        if num_far > len(some):  # near cells are fewer, for a footprint as large as a country far fewer
            result[k] = shape.area - _area_in(shape, some, size_m)
        elif num_far:
            place = np.add.outer(np.arange(low_x, high_x + 1), 1j * np.arange(low_y, high_y + 1)).ravel()
            far = place[np.searchsorted(near, place) == np.searchsorted(near, place, "right")]
            result[k] = _area_in(shape, far, size_m)
    return result


def _area_in(shape: shapely.Polygon, cell: np.ndarray, size_m: float) -> float:
    """The area of a polygon in square cells. cell: complex (k,), column + row * 1j of each cell."""
    x_m, y_m = size_m * cell.real, size_m * cell.imag
    box = shapely.box(x_m, y_m, x_m + size_m, y_m + size_m)
    return float(shapely.area(shapely.intersection(shape, box)).sum())


def _of_nearest(
    polygons: Polygons, cells: _Cells, footprint: np.ndarray, cell: np.ndarray, beyond: np.ndarray
) -> np.ndarray:
    """float64 (n,): the area of the cells ``beyond`` that are nearer to this footprint than to others; 0 if the nearest
    is farther than ``contact_m``. beyond: bool (cells,). footprint, cell: pairs of a footprint and a cell near it."""
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
    """The cells of 1 m that have points, at whole metres. of_point: the cell of each point. x_m, y_m: the centres of
    the cells. num_points: the points in each cell. is_ground, is_roof: masks. area_m2: the area of each cell with its
    share of the cells around it that have no points. neighbour: int (9, cells), the cells around each cell and itself;
    the number of cells in place of a cell without points."""

    def __init__(self, x_m: np.ndarray, y_m: np.ndarray, classification: np.ndarray) -> None:
        column, row = np.floor(x_m).astype(np.int64), np.floor(y_m).astype(np.int64)
        first, last = (int(column.min()), int(column.max())) if len(column) else (0, 0)
        # one more column on either side, so that no cell has a neighbour at the other end of a row
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
        """How many of the nine cells in and around each cell are in the mask."""
        return np.append(mask, False)[self.neighbour].sum(axis=0)

    def spread(self, mask: np.ndarray) -> np.ndarray:
        """Whether one of the nine cells in and around each cell is in the mask."""
        return self.around(mask) > 0
