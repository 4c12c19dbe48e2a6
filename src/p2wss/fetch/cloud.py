"""One LAZ file per tile out of the files that hold its points."""

from __future__ import annotations

import shutil
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pyproj

from p2wss import io
from p2wss.clouds import same_crs
from p2wss.errors import InputError
from p2wss.tiling import Bounds

_CHUNK_POINTS = 2_000_000
BROKEN = (laspy.errors.LaspyException, lazrs.LazrsError, ValueError, EOFError, RuntimeError, OSError)


def read_header(path: Path) -> laspy.LasHeader:
    """The header of a LAS, LAZ or COPC file. Raises :class:`InputError` if there is none."""
    try:
        with laspy.open(path) as reader:
            return reader.header
    except BROKEN as error:
        raise InputError(f"{path}: not a readable LAS, LAZ or COPC file, or truncated: {error}") from error


def check_cloud(path: Path, crs: str) -> None:
    """Raise :class:`InputError` if the file is truncated or in another CRS than ``crs``."""
    header = read_header(path)
    found = header.parse_crs()
    wanted = pyproj.CRS.from_user_input(crs)
    if found is not None and not same_crs(found, wanted):
        raise InputError(
            f"{path}: is in {found.name}, but the region in {wanted.name}; reproject it or set region.crs"
        )
    if header.point_count == 0:
        return
    try:
        with laspy.open(path) as reader:
            # the last point is behind all others, and in LAZ behind a table at the very end of the file
            reader.seek(header.point_count - 1)
            whole = len(reader.read_points(1)) == 1
    except BROKEN as error:
        raise InputError(f"{path}: is truncated: its last point cannot be read ({error})") from error
    if not whole:
        raise InputError(
            f"{path}: is truncated: its header counts {header.point_count} points, the last is missing"
        )


def write_cloud(out: str | Path, paths: list[Path], bounds: Bounds, crs: str) -> int:
    """Write the points of ``paths`` as one LAZ file; returns their number.

    A single LAZ or COPC file is copied as it is. Of several files, or of LAS, the points in ``bounds`` are
    written, west and south edge included, with the point format and scale of the first file.
    """
    for path in paths:
        check_cloud(path, crs)
    if len(paths) == 1 and paths[0].suffix.lower() == ".laz":
        with io.atomic(out) as temporary:
            shutil.copyfile(paths[0], temporary)
        return int(read_header(paths[0]).point_count)
    first = read_header(paths[0])
    header = laspy.LasHeader(version=first.version, point_format=first.point_format)
    header.scales, header.offsets = first.scales, first.offsets
    header.add_crs(pyproj.CRS.from_user_input(crs), keep_compatibility=first.version.minor < 4)
    x_min, y_min, x_max, y_max = bounds
    written = 0
    with io.atomic(out) as temporary, laspy.open(temporary, "w", header=header, do_compress=True) as writer:
        for path in paths:
            with laspy.open(path) as reader:
                for points in reader.chunk_iterator(_CHUNK_POINTS):
                    x, y = np.asarray(points.x), np.asarray(points.y)
                    inside = points[(x >= x_min) & (x < x_max) & (y >= y_min) & (y < y_max)]
                    piece = laspy.ScaleAwarePointRecord.zeros(len(inside), header=header)
                    piece.copy_fields_from(inside)
                    # copied as integers of the file's own scale and offset
                    piece.x, piece.y, piece.z = (
                        np.asarray(inside.x),
                        np.asarray(inside.y),
                        np.asarray(inside.z),
                    )
                    writer.write_points(piece)
                    written += len(piece)
    return written
