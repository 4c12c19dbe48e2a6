"""Which building is for training, validation and test: by blocks of the map."""

from __future__ import annotations

import numpy as np
import shapely

from p2wss.config import Crops
from p2wss.data import polygon_arrays
from p2wss.data.seeds import generator
from p2wss.skeleton.types import Polygons


def assign_splits(polygons: Polygons, settings: Crops) -> np.ndarray:
    """train, val, test or guard for each polygon (object array), by the place of its centroid.

    Square blocks go to a split as a whole; of every 5 by 2 blocks, one drawn by the seed is val and another
    is test, so that the shares are 80, 10 and 10 percent of any larger area. A val or test building nearer
    than ``guard_m`` to a building of another split is set aside as guard. The polygons must be in the CRS,
    not local; a polygon without rings is guard. Where ``split`` names one, all the others are in that.
    """
    shapes = polygon_arrays.to_geometries(polygons)
    split = np.full(len(shapes), "guard", dtype=object)
    filled = np.flatnonzero(~shapely.is_empty(shapes))
    if settings.split != "blocks":
        split[filled] = settings.split
        return split
    shapes = shapes[filled]
    centroid = shapely.centroid(shapes)
    block = np.floor(shapely.get_coordinates(centroid) / settings.block_size_m).astype(np.int64)
    group, place = block // [5, 2], block % [5, 2]
    groups, group_of = np.unique(group, axis=0, return_inverse=True)
    drawn = np.array(
        [generator(settings.seed, "crops", "split", x, y).permutation(10)[:2] for x, y in groups.tolist()]
    ).reshape(-1, 2)
    cell = place[:, 0] + 5 * place[:, 1]
    first = np.where(cell == drawn[group_of.ravel(), 0], "val", "train").astype(object)
    first[cell == drawn[group_of.ravel(), 1]] = "test"

    held_out = np.flatnonzero(first != "train")
    one, other = shapely.STRtree(shapes).query(
        shapes[held_out], predicate="dwithin", distance=settings.guard_m
    )
    one = held_out[one]
    final = first.copy()
    final[one[first[one] != first[other]]] = "guard"
    split[filled] = final
    return split
