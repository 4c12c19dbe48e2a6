"""The tile grid: square tiles, named after their north-west corner as in IGN's deliveries.

Names are in kilometres if the tile size is a whole number of kilometres (``0652_6862``: x from 652 km, y up to
6862 km), and else in metres (``0652500_6862000``). The number of digits distinguishes them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

from p2wss.storage.messages import InputError

if TYPE_CHECKING:
    import numpy as np

TILE_PATTERN = r"\d{4}_\d{4}|\d{7}_\d{7}"
Bounds = tuple[float, float, float, float]


def tile_name(x_min: float, y_max: float, tile_size_m: float) -> str:
    """Name of the tile whose north-west corner is (``x_min``, ``y_max``), metres.

    >>> tile_name(652_000, 6_862_000, 1000)
    '0652_6862'
    >>> tile_name(652_500, 6_862_000, 500)
    '0652500_6862000'
    """
    if tile_size_m % 1000 == 0:
        return f"{round(x_min / 1000):04d}_{round(y_max / 1000):04d}"
    return f"{round(x_min):07d}_{round(y_max):07d}"


def tile_bounds(name: str, tile_size_m: float, margin_m: float = 0.0) -> Bounds:
    """(x_min, y_min, x_max, y_max) of a tile, grown by ``margin_m`` on every side, metres.

    Raises :class:`InputError` when ``name`` is not a tile name.

    >>> tile_bounds("0652_6862", 1000)
    (652000.0, 6861000.0, 653000.0, 6862000.0)
    """
    if not re.fullmatch(TILE_PATTERN, name):
        raise InputError(f"{name!r} is not a tile name such as 0652_6862")
    unit = 1000.0 if len(name) == 9 else 1.0
    x_min, y_max = (float(part) * unit for part in name.split("_"))
    return (
        x_min - margin_m,
        y_max - tile_size_m - margin_m,
        x_min + tile_size_m + margin_m,
        y_max + margin_m,
    )


def grown(bounds: Bounds, margin_m: float) -> Bounds:
    """``bounds`` with ``margin_m`` more on every side.

    >>> grown((10, 20, 30, 40), 5)
    (5, 15, 35, 45)
    """
    x_min, y_min, x_max, y_max = bounds
    return x_min - margin_m, y_min - margin_m, x_max + margin_m, y_max + margin_m


def bounds_of_points(x: np.ndarray, y: np.ndarray) -> Bounds | None:
    """Bounds of places, x and y (n,); None without any."""
    return (float(x.min()), float(y.min()), float(x.max()), float(y.max())) if len(x) else None


def bounds_text(bounds: Bounds) -> str:
    """``bounds`` in a message, in whole metres.

    >>> bounds_text((10, 20, 30, 40))
    '10..30, 20..40'
    """
    return f"{bounds[0]:.0f}..{bounds[2]:.0f}, {bounds[1]:.0f}..{bounds[3]:.0f}"


def are_near(first: Bounds, second: Bounds, distance_m: float) -> bool:
    """Whether two windows are at most ``distance_m`` apart along x and along y; if that is negative, whether they
    overlap by as much.

    >>> are_near((0, 0, 10, 10), (11, 0, 20, 10), 1), are_near((0, 0, 10, 10), (9, 0, 20, 10), -2)
    (True, False)
    """
    x_min, y_min, x_max, y_max = grown(first, distance_m)
    return x_min <= second[2] and x_max >= second[0] and y_min <= second[3] and y_max >= second[1]


def tiles_of_points(x_m: np.ndarray, y_m: np.ndarray, tile_size_m: float) -> np.ndarray:
    """Tile name of each point, an object array (n,); the west and the north edge belong to a tile.

    x_m, y_m: float64 (n,).
    """
    import numpy as np  # not at the top: the Snakefile imports this module at each start, and numpy is slow to load

    column = np.floor(np.asarray(x_m) / tile_size_m)
    row = np.ceil(np.asarray(y_m) / tile_size_m)
    names = [
        tile_name(c * tile_size_m, r * tile_size_m, tile_size_m) for c, r in zip(column, row, strict=True)
    ]
    return np.array(names, dtype=object)


def tiles_of_bounds(bounds: Bounds, tile_size_m: float) -> Iterator[str]:
    """Names of all tiles that overlap ``bounds``, row by row from the north-west."""
    x_min, y_min, x_max, y_max = bounds
    for row in range(math.ceil(y_max / tile_size_m), math.floor(y_min / tile_size_m), -1):
        for column in range(math.floor(x_min / tile_size_m), math.ceil(x_max / tile_size_m)):
            yield tile_name(column * tile_size_m, row * tile_size_m, tile_size_m)


def neighbours(name: str, tile_size_m: float) -> list[str]:
    """Names of the eight tiles around a tile.

    >>> neighbours("0652_6862", 1000)[0]
    '0651_6863'
    """
    x_min, _, _, y_max = tile_bounds(name, tile_size_m)
    return [
        tile_name(x_min + column * tile_size_m, y_max + row * tile_size_m, tile_size_m)
        for row in (1, 0, -1)
        for column in (-1, 0, 1)
        if (row, column) != (0, 0)
    ]
