"""A cloud in square cells on disk: written chunk by chunk, read by places.

Memory holds one chunk, the requested points, and a few numbers per cell with points. It does not grow with the size of
the cloud or with the distances between its points. Points that their producer did not classify get classes by
:func:`p2wss.reconstruction.points.unclassified.with_classes`. The points read for a place are the same whatever else is
in the index, as long as it covers the surroundings (:meth:`CloudIndex.near`).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyproj

from p2wss.clouds.reading import Cloud, repeated, tell_repeated
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS, PLANT_CLASSES, has_class
from p2wss.reconstruction.points.unclassified import with_classes
from p2wss.skeleton.types import numbered
from p2wss.storage.temporary import Closeable, Scratch

CELL_M = 64.0
# cells per side of a square, whose points get classes together; cells around it that help to decide whether they do
_SQUARE, _AROUND = 2, 1
_RECORD = np.dtype(
    [
        ("number", "<i8"),
        ("x_m", "<f8"),
        ("y_m", "<f8"),
        ("z_m", "<f8"),
        ("day", "<u2"),
        ("classification", "u1"),
    ]
)
_COLUMNS = ("x_m", "y_m", "z_m", "day", "classification")
_LAST_BITS_M = 1e-6
# points that are sorted together
_CHUNK = 500_000
# what is counted per cell: all points, and the points of two classes
_COUNTED = (None, GROUND_CLASS, BUILDING_CLASS)
BYTES_PER_POINT = _RECORD.itemsize


class CloudIndex(Closeable):
    """The points of a cloud in the cells that boxes touch, and around these, in a :class:`Scratch` file."""

    def __init__(self, boxes: np.ndarray, folder: Path, adds_classes: bool = True) -> None:
        """boxes: (n, 4), x_min, y_min, x_max and y_max of the places of interest, metres. folder: of the file.
        adds_classes: whether :meth:`near` gives points classes."""
        self._adds_classes = adds_classes
        self.crs: pyproj.CRS | None = None
        self.num_points = 0
        self.has_plants = False
        # cells of whole squares and around them
        first, last = np.split(_windows(boxes) // _SQUARE * _SQUARE, 2, axis=1)
        self._window = np.unique(np.hstack([first - _AROUND, last + _SQUARE - 1 + _AROUND]), axis=0)
        # cells with points, ascending, and their numbers of points
        self._key = np.zeros(0, np.int64)
        self._count = np.zeros((len(_COUNTED), 0), np.int64)
        # runs of points of one cell and file: cell, first place in the scratch file, place after the last, file number
        self._runs = [np.zeros((0, 4), np.int64)]
        self._paths: list[Path | None] = []
        self._num_read = self._num_written = 0
        self._scratch = Scratch(folder, f"points, {BYTES_PER_POINT} bytes each")

    def close(self) -> None:
        """Remove the file."""
        self._scratch.close()

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """The bounds of all cells, in metres; zeros without cells."""
        if not len(self._window):
            return 0.0, 0.0, 0.0, 0.0
        low_x, low_y = (self._window[:, :2].min(axis=0) * CELL_M).tolist()
        high_x, high_y = ((self._window[:, 2:].max(axis=0) + 1) * CELL_M).tolist()
        return low_x, low_y, high_x, high_y

    @property
    def places_m(self) -> np.ndarray:
        """x and y of the lower left corners of the cells with points, (n, 2)."""
        return np.column_stack(_row_and_column(self._key)[::-1]) * CELL_M

    def append(self, cloud: Cloud) -> None:
        """Add a chunk; points outside the cells are dropped."""
        self.crs = self.crs or cloud.crs
        if not self._paths or cloud.path != self._paths[-1]:
            self._paths.append(cloud.path)
        self.has_plants |= bool(has_class(cloud.classification, PLANT_CLASSES).any())
        for first in range(0, len(cloud), _CHUNK):
            self._append(cloud, slice(first, min(first + _CHUNK, len(cloud))))

    def _append(self, cloud: Cloud, chunk: slice) -> None:
        number = self._num_read + np.arange(chunk.stop - chunk.start)
        self._num_read += len(number)
        x_m, y_m = cloud.x_m[chunk], cloud.y_m[chunk]
        cell = _key_of(x_m, y_m)
        cells, of_point = numbered(cell)
        is_here = np.zeros(len(cells), bool)
        is_here[_within(cells, self._window)] = True
        rows = np.flatnonzero(is_here[of_point])
        rows = rows[np.argsort(cell[rows], kind="stable")]
        if not len(rows):
            return
        records = np.zeros(len(rows), _RECORD)
        records["number"] = number[rows]
        for name in _COLUMNS:
            values = getattr(cloud, name)
            if values is not None:
                records[name] = values[chunk][rows]
        cell, classes = cell[rows], cloud.classification[chunk][rows]
        starts = np.flatnonzero(np.append(True, cell[1:] != cell[:-1]))
        known, place = numbered(np.append(self._key, cell[starts]))
        count = np.zeros((len(_COUNTED), len(known)), np.int64)
        count[:, place[: len(self._key)]] = self._count
        for k, number_of_class in enumerate(_COUNTED):
            is_counted = (classes >= 0) if number_of_class is None else classes == number_of_class
            count[k, place[len(self._key) :]] += np.add.reduceat(is_counted, starts, dtype=np.int64)
        self._key, self._count = known, count
        self.num_points += len(rows)
        self._write(records, cell[starts], starts, len(self._paths) - 1)

    def _write(self, records: np.ndarray, cell: np.ndarray, starts: np.ndarray, file: int) -> None:
        ends = np.append(starts[1:], len(records))
        places = np.column_stack([starts, ends]) + self._num_written
        self._runs.append(np.column_stack([cell, places, np.full(len(cell), file)]))
        self._num_written += len(records)
        self._scratch.append(records.view(np.uint8).data)

    def drop_repeated(self) -> None:
        """Keep points that several files contain only once, and log how many there are
        (:func:`p2wss.clouds.reading.repeated`). Call it once, after the last :meth:`append`."""
        runs = np.concatenate(self._runs)
        runs = runs[np.argsort(runs[:, 0], kind="stable")]
        self._runs, told = self._runs[:1], Counter[tuple[int, int]]()
        for own in np.split(runs, np.flatnonzero(np.diff(runs[:, 0])) + 1):
            self._runs.append(own)
            if len(own) == 0 or own[0, 3] == own[-1, 3]:
                continue
            records, key = self._records(own), own[:1, 0]
            file = np.repeat(own[:, 3], own[:, 2] - own[:, 1])
            again, num_points = repeated(records["x_m"], records["y_m"], records["z_m"], file)
            if again.any():
                told += num_points
                self._runs.pop()
                self._write(records[~again], key, np.zeros(1, np.int64), -1)
                self.num_points -= int(again.sum())
                classes = records["classification"][again]
                for k, number in enumerate(_COUNTED):
                    self._count[k, _positions(self._key, key)] -= (
                        len(classes) if number is None else (classes == number).sum()
                    )
        self._runs = [np.concatenate(self._runs)]
        tell_repeated(told, self._paths)

    def near(self, boxes: np.ndarray, adds_classes: bool = True) -> Cloud:
        """The points in all cells that boxes (n, 4) touch, cell by cell, in each cell in the order in which they were
        added. boxes: inside the boxes of the index.

        Unless ``adds_classes`` is false, the points of a square of two by two cells get classes if the four by four
        cells around its centre have no point of class ground, or no point of class building.
        """
        cells = self._key[_within(self._key, _windows(boxes))]
        cloud, number = self._read(cells)
        square = np.unique(_square(cells))
        has_all = self._has(square, GROUND_CLASS) & self._has(square, BUILDING_CLASS)
        if has_all.all() or not (adds_classes and self._adds_classes):
            return cloud
        classes, order = cloud.classification.copy(), np.argsort(number)
        ascending = number[order]
        for k in square[~has_all].tolist():
            around, number_around = self._read(_cells_around(np.array([k])).ravel())
            inside = _square(_key_of(around.x_m, around.y_m)) == k
            around, _ = with_classes(around, inside)
            place = _positions(ascending, number_around[inside])
            classes[order[place[place >= 0]]] = around.classification[inside][place >= 0]
        return replace(cloud, classification=classes)

    def count(self, boxes: np.ndarray) -> int:
        """The number of points in all cells that boxes (n, 4) touch."""
        return int(self._count[0, _within(self._key, _windows(boxes))].sum())

    def has_points(self, x_m: np.ndarray, y_m: np.ndarray, classification: int | None = None) -> np.ndarray:
        """bool (n,): whether the files have points around each place, in the four by four cells of :meth:`near`.

        classification: count only points of this class, :data:`GROUND_CLASS` or :data:`BUILDING_CLASS`; None: all.
        """
        result = np.zeros(len(x_m), bool)
        known = np.flatnonzero(np.isfinite(x_m) & np.isfinite(y_m))
        square, of_place = numbered(_square(_key_of(x_m[known], y_m[known])))
        result[known] = self._has(square, classification)[of_place]
        return result

    def _has(self, square: np.ndarray, classification: int | None) -> np.ndarray:
        """bool (n,): whether there are points of a class, or any points for None, in and around each square."""
        around = _cells_around(square)
        place = _positions(self._key, around.ravel()).reshape(around.shape)
        count = np.append(self._count[_COUNTED.index(classification)], 0)  # last: of a missing cell
        return np.asarray((count[place] > 0).any(axis=1))

    def _read(self, cells: np.ndarray) -> tuple[Cloud, np.ndarray]:
        """(the points of cells, the number of each point in the order of adding), sorted by cell and this number."""
        runs = np.concatenate(self._runs)
        runs = runs[np.isin(runs[:, 0], cells)]
        records = self._records(runs[np.argsort(runs[:, 0], kind="stable")])
        columns = {name: np.ascontiguousarray(records[name]) for name in _COLUMNS}
        return Cloud(**columns, crs=self.crs, path=None), records["number"]

    def _records(self, runs: np.ndarray) -> np.ndarray:
        size = runs[:, 2] - runs[:, 1]
        records = np.empty(int(size.sum()), _RECORD)
        place = np.cumsum(np.append(0, size)).tolist()
        for start, num, (low, high) in zip(runs[:, 1].tolist(), size.tolist(), pairwise(place), strict=True):
            content = self._scratch.read(start * BYTES_PER_POINT, num * BYTES_PER_POINT)
            records[low:high] = np.frombuffer(content, _RECORD)
        return records


def _key(row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """int64: the key of each cell or square, from its row and column."""
    return np.asarray(row).astype(np.int64) * 2**32 + np.asarray(column).astype(np.int64) + 2**31


def _key_of(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """The cell of each point; the same cell for a point of two files whose coordinates differ in their last bits."""
    return _key(*(np.floor((values + _LAST_BITS_M) / CELL_M) for values in (y_m, x_m)))


def _row_and_column(key: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return key // 2**32, key % 2**32 - 2**31


def _square(cell: np.ndarray) -> np.ndarray:
    """The square of each cell."""
    row, column = _row_and_column(cell)
    return _key(row // _SQUARE, column // _SQUARE)


def _cells_around(square: np.ndarray) -> np.ndarray:
    """int64 (n, 16): the cells of each square and around it."""
    row, column = _row_and_column(square)
    steps = np.arange(-_AROUND, _SQUARE + _AROUND)
    rows = (row * _SQUARE)[:, None, None] + steps[:, None]
    columns = (column * _SQUARE)[:, None, None] + steps
    return _key(*np.broadcast_arrays(rows, columns)).reshape(len(square), len(steps) ** 2)


def _windows(boxes: np.ndarray) -> np.ndarray:
    """int64 (n, 4): first column, first row, last column and last row of the cells that a box touches, each window
    once, not in the order of the boxes. Boxes that are not finite are left out."""
    return np.unique(np.floor(boxes[np.isfinite(boxes).all(axis=1)] / CELL_M).astype(np.int64), axis=0)


def _within(ascending: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """The ascending positions of the cells that are in at least one of the windows. ascending: the cells."""
    rows = np.unique(_row_and_column(ascending)[0])
    first = np.searchsorted(rows, windows[:, 1])
    window, row = _ranges(first, np.searchsorted(rows, windows[:, 3], "right"))
    start = np.searchsorted(ascending, _key(rows[row], windows[window, 0]))
    return np.unique(
        _ranges(start, np.searchsorted(ascending, _key(rows[row], windows[window, 2]), "right"))[1]
    )


def _ranges(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All integers from ``first`` (n,) to before ``last`` (n,): (the range of each integer, the integers)."""
    count = np.maximum(last - first, 0)
    of = np.repeat(np.arange(len(count)), count)
    return of, np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count) + first[of]


def _positions(ascending: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The position of each value in ``ascending``; -1 for a missing value."""
    if not len(ascending):
        return np.full(len(values), -1)
    place = np.minimum(np.searchsorted(ascending, values), len(ascending) - 1)
    return np.where(ascending[place] == values, place, -1)
