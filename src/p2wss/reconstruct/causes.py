"""Why a building is not represented: one cause for each, from what the points over its footprint are."""

from __future__ import annotations

import numpy as np
import shapely

from p2wss.data import reasons
from p2wss.data.building import Building
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS, NEIGHBOUR_CLASS, PLANT_CLASSES, has_class
from p2wss.data.points import MIN_HEIGHT_M

# shares of the cells of 1 m: of the roof of a building that is changed and not gone, and least of a cause
_MOST, _SOME = 0.5, 0.2
# points on a square metre: fewer show no roof of several levels
_MIN_PER_M2 = 2.0


def cause_of(building: Building) -> str:
    """Why a building whose result is not reliable is not represented.

    Cells of 1 m in which no point is on the building are those of plants, of the neighbour, of the ground, or empty;
    what most of them are is the cause. Where the roof is seen, plants, ground or neighbours on a fifth of the cells are
    the cause, or else too many levels.
    """
    if not building.rings or not len(building.point_m):
        return reasons.FEW_POINTS
    x, y, z = building.point_m.T
    inside = shapely.contains_xy(building.polygon, x, y)
    on_roof, classes = building.is_on_building, building.classification
    is_plant = has_class(classes, PLANT_CLASSES) & (z >= MIN_HEIGHT_M)
    low = (classes != BUILDING_CLASS) & (z < MIN_HEIGHT_M) | (classes == GROUND_CLASS)
    cell = np.unique(np.floor(np.column_stack([x, y])[inside]), axis=0, return_inverse=True)[1].ravel()
    num_cells = max(int(cell.max(initial=-1)) + 1, 1)
    count = {
        name: np.bincount(cell[mask[inside]], minlength=num_cells)
        for name, mask in (
            (reasons.VEGETATION_OVER, is_plant),
            (reasons.NEIGHBOUR_OVER, classes == NEIGHBOUR_CLASS),
            (reasons.GONE, low),
            ("", on_roof & ~is_plant),
        )
    }
    area_m2 = building.polygon.area
    num_most = np.max(list(count.values()), axis=0)
    share = {
        name: float(((of == num_most) & (of > 0)).sum()) / max(area_m2, 1.0) for name, of in count.items()
    }
    seen = share.pop("")
    cause = max(share, key=lambda name: share[name])
    if share[cause] < _SOME:
        return reasons.MANY_LEVELS if inside.sum() >= _MIN_PER_M2 * area_m2 else reasons.FEW_POINTS
    if cause == reasons.GONE and seen > 1 - _MOST - _SOME:
        return reasons.CHANGED
    return cause
