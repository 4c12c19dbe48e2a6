"""Roof points to which the producer gave another class than building: where a block has many of them, such points must
not count as outside."""

from __future__ import annotations

import numpy as np
import shapely

from p2wss.clouds.cropping import crop_points
from p2wss.data import polygon_arrays
from p2wss.reconstruction.registration.blocks import Blocks

# so far inside its outlines, a block has no walls, and moved by as much no trees
_INSIDE_M = 1.0
# a roof reaches so far below and above its points in a cell of 1 m
_TOLERANCE_M = 0.3
# least number, and share of all roof points inside, of a block whose roofs were missed. In eight places whose classes
# are good, blocks have at most 0.6 %, and 4.5 % if their footprints are moved by 1.5 m under trees.
_MIN_POINTS, _MIN_SHARE = 5, 0.1


def like_roofs(
    x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray, is_roof: np.ndarray, is_other: np.ndarray
) -> np.ndarray:
    """Which of the other points are at the heights of the roof points in their cell of 1 m, bool (n,)."""
    column, row = np.floor(x_m).astype(np.int64), np.floor(y_m).astype(np.int64)
    cells, cell = np.unique((row << 31) + column, return_inverse=True)
    low_m, high_m = np.full(len(cells), np.inf), np.full(len(cells), -np.inf)
    np.minimum.at(low_m, cell[is_roof], z_m[is_roof] - _TOLERANCE_M)
    np.maximum.at(high_m, cell[is_roof], z_m[is_roof] + _TOLERANCE_M)
    return np.asarray(is_other & (z_m >= low_m[cell]) & (z_m <= high_m[cell]))


def with_missed_roofs(
    blocks: Blocks, x_m: np.ndarray, y_m: np.ndarray, is_roof: np.ndarray, is_like: np.ndarray
) -> np.ndarray:
    """The blocks with many points like roofs (:func:`like_roofs`) well inside their outlines, bool (blocks,)."""
    inner = shapely.buffer(polygon_arrays.to_geometries(blocks.outline), -_INSIDE_M)
    parts, of_part = shapely.get_parts(inner, return_index=True)
    point, _, offset = crop_points(x_m, y_m, polygon_arrays.to_polygons(parts), 0.0)
    block = blocks.of_outline[np.repeat(of_part, np.diff(offset))]
    num_like, num_roof = (
        np.bincount(block[mask[point]], minlength=len(blocks)) for mask in (is_like, is_roof)
    )
    return np.asarray(num_like >= np.fmax(_MIN_POINTS, _MIN_SHARE * (num_like + num_roof)))
