"""Scans: LAZ of a simulated survey, each point with the building and the face that it lies on.

LAS 1.4, point format 6, coordinates in millimetres. Classes: 2 ground, 5 vegetation, 6 building. Extra dimensions:

* ``building_id`` int32: the row in the buildings file of the same tile, or -1;
* ``face_id`` int32: -1 on the terrain; else ``kind = face_id & 3`` is 0 clutter, 1 wall, 2 roof, 3 flat roof, and
  ``edge = (face_id >> 2) - 1`` the footprint edge from which the face grows.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pyproj

from p2wss.clouds.reading import Cloud
from p2wss.storage import files, integrity
from p2wss.storage.las_crs import crs_of
from p2wss.storage.las_files import open_cloud

MM = 0.001
_READ_AT_ONCE = 1_000_000
# the columns that are read, with their types
_COLUMNS = {
    "x": np.float64,
    "y": np.float64,
    "z": np.float64,
    "classification": np.uint8,
    "building_id": np.int32,
    "face_id": np.int32,
}


def write_scan(
    path: str | Path,
    chunks: Iterable[Mapping[str, np.ndarray]],
    origin_m: np.ndarray,
    crs: pyproj.CRS,
    threads: int = 1,
) -> None:
    """Write points as LAZ, completely or not at all.

    chunks: arrays of shape (n,) by LAS dimension, ``X``, ``Y`` and ``Z`` int32 in millimetres from ``origin_m``
    (float64 (3,), whole metres), ``building_id`` and ``face_id`` among them.
    """
    header = _header(origin_m, crs)
    backend = laspy.LazBackend.LazrsParallel if threads > 1 else laspy.LazBackend.Lazrs
    with files.atomic(path, seal=True) as temporary:
        try:
            with laspy.open(temporary, "w", header=header, laz_backend=backend, do_compress=True) as writer:
                for chunk in chunks:
                    writer.write_points(_record(chunk, header))
        except lazrs.LazrsError as error:  # a full disk, which files.atomic turns into a message
            raise OSError(str(error)) from error


def as_las(points: Mapping[str, np.ndarray], origin_m: np.ndarray, crs: pyproj.CRS | None) -> laspy.LasData:
    """The points in memory, as they would be written; see :func:`write_scan`."""
    header = _header(origin_m, crs)
    result = laspy.LasData(header, _record(points, header))
    result.update_header()
    return result


def _header(origin_m: np.ndarray, crs: pyproj.CRS | None) -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, MM), origin_m
    header.system_identifier, header.generating_software = "p2wss simulated survey", "p2wss"
    header.creation_date = None  # the same points make the same file on any day
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.WEEK_TIME
    if crs is not None:
        header.add_crs(crs)
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("building_id", "int32", "row in buildings, -1 none"),
            laspy.ExtraBytesParams("face_id", "int32", "4 (edge + 1) + kind, -1 none"),
        ]
    )
    return header


def _record(chunk: Mapping[str, np.ndarray], header: laspy.LasHeader) -> laspy.ScaleAwarePointRecord:
    record = laspy.ScaleAwarePointRecord.zeros(len(chunk["X"]), header=header)
    for dimension, values in chunk.items():
        record[dimension] = values
    return record


def read_scan(path: str | Path) -> tuple[Cloud, np.ndarray, np.ndarray]:
    """The points of a scan, and two arrays int32 (n,): building id and face id of each point.

    Raises :class:`InputError` for a file that is missing, truncated or not a scan of p2wss.
    """
    integrity.verify(path)
    needed = laspy.DecompressionSelection.base() | laspy.DecompressionSelection.CLASSIFICATION
    needed |= laspy.DecompressionSelection.Z | laspy.DecompressionSelection.ALL_EXTRA_BYTES
    kind = "a readable scan of p2wss, or truncated"
    with open_cloud(path, kind, decompression_selection=needed) as reader:
        count, crs = reader.header.point_count, crs_of(reader.header)
        columns = {name: np.empty(count, kind) for name, kind in _COLUMNS.items()}
        first = 0
        for points in reader.chunk_iterator(_READ_AT_ONCE):
            for name, column in columns.items():
                column[first : first + len(points)] = points[name]
            first += len(points)
        if first != count:
            raise EOFError(f"{first} of {count} points")
    x, y, z, classification, building, face = columns.values()
    return Cloud(x, y, z, classification, crs), building, face
