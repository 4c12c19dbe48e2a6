"""One LAZ file per tile out of the files that hold its points."""

from __future__ import annotations

import os
import shutil
import struct
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pyproj

from p2wss.data import files
from p2wss.data.clouds import same_crs
from p2wss.data.tiling import Bounds
from p2wss.errors import InputError

_CHUNK_POINTS = 2_000_000
_EDGE_M = 0.5  # tiles as delivered may have points on, or a little beyond, their edges
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
    if any(vlr.user_id == "copc" and vlr.record_id == 1 for vlr in header.vlrs):
        _check_copc(path)
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


def _check_copc(path: Path) -> None:
    # lazrs cannot seek in the chunks of COPC, which are of different sizes; but the records behind all chunks
    # tell where the file ends: 60 bytes each, of which 8 their length (LAS 1.4, section 2.7)
    header, size = read_header(path), path.stat().st_size
    end = header.start_of_first_evlr
    with path.open("rb") as file:
        for _ in range(header.number_of_evlrs):
            file.seek(end + 20)
            length = file.read(8)
            if len(length) < 8:
                break
            end += 60 + struct.unpack("<Q", length)[0]
        else:
            if end <= size:
                return
    raise InputError(f"{path}: is truncated: {size} of at least {end} bytes")


def write_cloud(
    out: str | Path,
    paths: Sequence[Path],
    bounds: Bounds,
    crs: str,
    holes: Sequence[Bounds] = (),
    link: bool = False,
) -> int:
    """Write the points of ``paths`` as one LAZ file; returns their number.

    A single LAZ or COPC file whose points are all in ``bounds`` and in no hole is copied as it is (link: as a
    hard link where that can be made, for files that nobody will change). Otherwise the points in ``bounds``
    and in no hole are written, the west and south edges of each included, with the point format and scale of
    the first file.
    """
    for path in paths:
        check_cloud(path, crs)
    if len(paths) == 1 and paths[0].suffix.lower() == ".laz" and _is_inside(paths[0], bounds, holes):
        with files.atomic(out) as temporary:
            _copy(paths[0], temporary, link)
        return int(read_header(paths[0]).point_count)
    first = read_header(paths[0])
    header = laspy.LasHeader(version=first.version, point_format=first.point_format)
    header.scales, header.offsets = first.scales, first.offsets
    header.add_crs(pyproj.CRS.from_user_input(crs), keep_compatibility=first.version.minor < 4)
    written = 0
    with (
        files.atomic(out) as temporary,
        laspy.open(temporary, "w", header=header, do_compress=True) as writer,
    ):
        for path in paths:
            with laspy.open(path) as reader:
                for points in reader.chunk_iterator(_CHUNK_POINTS):
                    x, y = np.asarray(points.x), np.asarray(points.y)
                    keep = _in(x, y, bounds)
                    for hole in holes:
                        keep &= ~_in(x, y, hole)
                    inside = points[keep]
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


def count_classes(path: Path) -> Counter[int]:
    """Points per class of a cloud."""
    counts: Counter[int] = Counter()
    try:
        with laspy.open(path) as reader:
            for points in reader.chunk_iterator(_CHUNK_POINTS):
                values, numbers = np.unique(np.asarray(points.classification), return_counts=True)
                counts.update(dict(zip(values.tolist(), numbers.tolist(), strict=True)))
    except BROKEN as error:
        raise InputError(f"{path}: not a readable LAS, LAZ or COPC file, or truncated: {error}") from error
    return counts


def _in(x: np.ndarray, y: np.ndarray, bounds: Bounds) -> np.ndarray:
    x_min, y_min, x_max, y_max = bounds
    return (x >= x_min) & (x < x_max) & (y >= y_min) & (y < y_max)


def _is_inside(path: Path, bounds: Bounds, holes: Sequence[Bounds]) -> bool:
    """Whether a cloud lies in ``bounds`` and outside all holes, but for half a metre."""
    header = read_header(path)
    (x_min, y_min, _), (x_max, y_max, _) = header.mins, header.maxs
    apart = all(
        min(x_max, hole[2]) - max(x_min, hole[0]) < _EDGE_M
        or min(y_max, hole[3]) - max(y_min, hole[1]) < _EDGE_M
        for hole in holes
    )
    inside = x_min >= bounds[0] - _EDGE_M and y_min >= bounds[1] - _EDGE_M
    return apart and inside and x_max <= bounds[2] + _EDGE_M and y_max <= bounds[3] + _EDGE_M


def _copy(source: Path, target: Path, link: bool) -> None:
    if link:
        try:
            target.unlink()
            os.link(source, target)
            return
        except OSError:
            pass  # another disk, or one without links
    shutil.copyfile(source, target)
