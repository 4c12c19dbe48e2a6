"""Split buildings into train, val and test by location, in square blocks."""

from __future__ import annotations

import numpy as np
import shapely

from p2wss.config import Crops
from p2wss.data import polygon_arrays
from p2wss.data.seeds import generator
from p2wss.skeleton.types import Polygons


def assign_splits(polygons: Polygons, settings: Crops) -> np.ndarray:
    """The split of each polygon: "train", "val", "test" or "guard" (object array).

    polygons: in the CRS, not in local coordinates. The block of a polygon is that of its centroid. In every group of 5
    by 2 blocks, one block is drawn for val and another for test, so that the shares approach 80, 10 and 10 percent of a
    large area. A val or test building closer than ``guard_m`` to a building of another split becomes guard and is not
    used. A polygon without rings is guard too. If ``settings.split`` names a split, all other polygons are in it.
    """
    shapes = polygon_arrays.to_geometries(polygons)
    split = np.full(len(shapes), "guard", dtype=object)
    rows = np.flatnonzero(~shapely.is_empty(shapes))
    if settings.split != "blocks":
        split[rows] = settings.split
        return split
    shapes = shapes[rows]
    centroid = shapely.centroid(shapes)
    block = np.floor(shapely.get_coordinates(centroid) / settings.block_size_m).astype(np.int64)
    group, position = block // [5, 2], block % [5, 2]
    groups, group_index = np.unique(group, axis=0, return_inverse=True)
    # per group of blocks: the numbers (0 to 9) of its val block and of its test block
    val_and_test = np.array(
        [generator(settings.seed, "crops", "split", x, y).permutation(10)[:2] for x, y in groups.tolist()]
    ).reshape(-1, 2)[group_index.ravel()]
    number = position[:, 0] + 5 * position[:, 1]
    block_split = np.where(number == val_and_test[:, 0], "val", "train").astype(object)
    block_split[number == val_and_test[:, 1]] = "test"

    held_out = np.flatnonzero(block_split != "train")
    index, neighbour = shapely.STRtree(shapes).query(
        shapes[held_out], predicate="dwithin", distance=settings.guard_m
    )
    index = held_out[index]
    guarded_split = block_split.copy()
    guarded_split[index[block_split[index] != block_split[neighbour]]] = "guard"
    split[rows] = guarded_split
    return split
