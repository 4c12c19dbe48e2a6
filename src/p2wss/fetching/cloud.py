"""Write one LAZ file per tile from the files that hold its points, and check delivered clouds."""

import os
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import laspy
import numpy as np
import pyproj
import shapely

from p2wss.data.crs import check_crs
from p2wss.data.tiling import Bounds, are_near, bounds_of_points, grown
from p2wss.storage import files, integrity
from p2wss.storage.las_crs import crs_of
from p2wss.storage.las_files import bounds_of, marks, open_cloud, steps
from p2wss.storage.messages import log

_CHUNK_POINTS = 2_000_000
_LAST_OLD_FORMAT = 5  # of LAS 1.3
_EDGE_M = 0.5  # delivered tiles may have points on their edges or slightly beyond them


def read_header(path: Path) -> laspy.LasHeader:
    """The header of a LAS, LAZ or COPC file. Raises :class:`InputError` if the file is not readable."""
    with open_cloud(path) as reader:
        return reader.header


def extent_of(path: Path) -> Bounds | None:
    """The bounds that a header states; None if it states none, or bounds that do not contain the first point."""
    # without threads, which would decode more than a point
    with open_cloud(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
        stated, first = bounds_of(reader.header), reader.read_points(1)
    place = bounds_of_points(first.x, first.y)
    return stated if stated and place and are_near(stated, place, 2 * _EDGE_M) else None


def check_cloud(path: Path, crs: str) -> None:
    """Raise :class:`InputError` if the file is truncated or states a CRS that differs from ``crs``."""
    check_crs(crs_of(read_header(path)), crs, path)


def write_cloud(
    out: str | Path,
    paths: Sequence[Path],
    bounds: Bounds,
    crs: str,
    holes: Sequence[Bounds] = (),
    link: bool = False,
) -> int:
    """Write the points of ``paths`` that are in ``bounds`` and in none of ``holes`` as one LAZ file. A point that
    several files have is written once.

    The west and south edges of ``bounds`` and of each hole belong to it, the other edges do not. The output has the
    point format and scale of the first file in a format of LAS 1.4, else of the first file, and the latest creation
    date of all files. A single LAZ or COPC file that needs no cropping is copied unchanged (link: as a hard link where
    the disk allows it, for files that nobody will change). Returns the number of points.

    Raises :class:`InputError` if a file is truncated or states a CRS that differs from ``crs``.
    """
    headers = [read_header(path) for path in paths]
    for path, each in zip(paths, headers, strict=True):
        check_crs(crs_of(each), crs, path)
    if len(paths) == 1 and paths[0].suffix.lower() == ".laz" and _is_inside(paths[0], bounds, holes):
        with files.atomic(out) as temporary:
            if link and integrity.has_checksum(paths[0]):  # one without gets one, which the source must not
                link_or_copy(paths[0], temporary)
            else:
                shutil.copyfile(paths[0], temporary)
                append_checksum(temporary)
        return int(headers[0].point_count)
    # older formats have no classes above 31
    first = max(headers, key=lambda each: each.point_format.id > _LAST_OLD_FORMAT)
    header = laspy.LasHeader(version=first.version, point_format=first.point_format)
    header.scales, header.offsets = first.scales, first.offsets
    header.global_encoding.gps_time_type = first.global_encoding.gps_time_type
    # readers take the creation date as the day of points whose time does not state it
    days = [each.creation_date for each in headers if each.creation_date is not None]
    header.creation_date = max(days, default=header.creation_date)
    header.add_crs(pyproj.CRS.from_user_input(crs), keep_compatibility=first.version.minor < 4)
    num_points, extents = 0, [extent_of(path) for path in paths]
    # marks of the points of earlier files where files overlap
    known = np.zeros(0, np.uint64)
    with (
        files.atomic(out, seal=True) as temporary,
        laspy.open(temporary, "w", header=header, do_compress=True) as writer,
    ):
        for number, path in enumerate(paths):
            others, own, num_again = [*extents[:number], *extents[number + 1 :]], [known], 0
            with open_cloud(path) as reader:
                for points in reader.chunk_iterator(_CHUNK_POINTS):
                    x, y = np.asarray(points.x), np.asarray(points.y)
                    keep = _in(x, y, bounds)
                    for hole in holes:
                        keep &= ~_in(x, y, hole)
                    is_shared = np.zeros(len(x), bool)
                    for each in others:
                        is_shared |= True if each is None else _in(x, y, grown(each, _EDGE_M))
                    row = np.flatnonzero(keep & is_shared)
                    mark = marks(steps(x[row], y[row], np.asarray(points.z)[row]))
                    is_again = np.isin(mark, known)
                    own.append(mark[~is_again])
                    keep[row[is_again]] = False
                    num_again += int(is_again.sum())
                    inside = points[keep]
                    piece = laspy.ScaleAwarePointRecord.zeros(len(inside), header=header)
                    piece.copy_fields_from(inside)
                    # coordinates must be set as metres: each file has its own scale and offset
                    piece.x, piece.y, piece.z = (
                        np.asarray(inside.x),
                        np.asarray(inside.y),
                        np.asarray(inside.z),
                    )
                    writer.write_points(piece)
                    num_points += len(piece)
            known = np.concatenate(own)
            if num_again:
                log.info("note: %d points of %s are in the files before it, too: used once", num_again, path)
    return num_points


def count_classes(path: Path) -> Counter[int]:
    """Number of points per LAS class. Raises :class:`InputError` if the file is not readable."""
    counts: Counter[int] = Counter()
    with open_cloud(path) as reader:
        for points in reader.chunk_iterator(_CHUNK_POINTS):
            values, numbers = np.unique(np.asarray(points.classification), return_counts=True)
            counts.update(dict(zip(values.tolist(), numbers.tolist(), strict=True)))
    return counts


def _in(x: np.ndarray, y: np.ndarray, bounds: Bounds) -> np.ndarray:
    x_min, y_min, x_max, y_max = bounds
    return (x >= x_min) & (x < x_max) & (y >= y_min) & (y < y_max)


def _is_inside(path: Path, bounds: Bounds, holes: Sequence[Bounds]) -> bool:
    """Whether a cloud is inside ``bounds`` and outside all holes, to within half a metre."""
    stated, limits = extent_of(path), shapely.box(*grown(bounds, _EDGE_M))
    return (
        stated is not None
        and limits.covers(shapely.box(*stated))
        and not any(are_near(stated, hole, -_EDGE_M) for hole in holes)
    )


def link_or_copy(source: Path, target: Path) -> None:
    """Make ``target`` a hard link to ``source``, or a copy on another disk and on one without hard links."""
    target.unlink(missing_ok=True)
    try:
        os.link(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)


def append_checksum(path: Path) -> None:
    """Add a slot for a checksum, which ``atomic`` fills, at the end of a LAZ file, unless its last bytes have a
    meaning.

    A file that was written to a pipe ends with the offset of its chunk table, and has -1 where other files have the
    offset.
    """
    header = read_header(path)
    with path.open("rb") as file:
        file.seek(header.offset_to_point_data)
        has_table_at_end = file.read(8) == b"\xff" * 8
    if not has_table_at_end:
        integrity.append(path)
