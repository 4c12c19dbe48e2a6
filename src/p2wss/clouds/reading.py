"""Read point clouds from LAS, LAZ and COPC files, by window and without noise; their headers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from itertools import groupby, pairwise
from pathlib import Path

import laspy
import numpy as np
import pyproj

from p2wss.data.crs import MetricCrs, check_crs
from p2wss.data.las_classes import LAS, ClassSet
from p2wss.data.tiling import Bounds, are_near, bounds_of_points
from p2wss.storage.las_crs import crs_of, stated_crs
from p2wss.storage.las_files import KIND, STEPS_PER_M, bounds_of, marks, open_cloud, steps
from p2wss.storage.messages import InputError, log, reading

# days of points count from here
GPS_EPOCH = date(1980, 1, 6)
_SUFFIXES = (".las", ".laz")
# headers may state bounds that are rounded
_HEADER_MARGIN_M = 1.0
_CHUNK_POINTS = 500_000
# if a window of a COPC file has more points, the whole file is decoded instead, piece by piece
_MAX_WINDOW_POINTS = 5_000_000
_WEEK_S, _DAY_S = 604_800, 86_400
_GPS_OFFSET_S = 1e9  # of adjusted standard GPS time
# raw GPS time and Unix time, read as adjusted standard GPS time, are 31 and 41 years late. Creation dates of files are
# less wrong, except dates before the first version of LAS
_AHEAD_DAYS, _FIRST_LAS = 3652, (date(2003, 5, 9) - GPS_EPOCH).days


@dataclass(frozen=True)
class Cloud:
    """Points in a projected CRS.

    x_m, y_m, z_m: float64 (n,). classification: LAS class, uint8 (n,). crs: None if no file states it. day: uint16
    (n,), days from :data:`GPS_EPOCH` to the day on which the point was recorded or, if its time does not tell, to the
    creation date of its file; 0 or None if unknown. path: the file of all points; None for points of several files or
    of none.
    """

    x_m: np.ndarray
    y_m: np.ndarray
    z_m: np.ndarray
    classification: np.ndarray
    crs: pyproj.CRS | None
    day: np.ndarray | None = None
    path: Path | None = None

    def __len__(self) -> int:
        return len(self.x_m)

    def in_classes(self, classes: ClassSet) -> Cloud:
        """The points that ``classes`` keep, with classes of LAS."""
        classification, keep = classes.to_las(self.classification)
        x_m, y_m, z_m = (values[keep] for values in (self.x_m, self.y_m, self.z_m))
        day = None if self.day is None else self.day[keep]
        return Cloud(x_m, y_m, z_m, classification[keep], self.crs, day, self.path)

    def in_metres(self, metric: MetricCrs) -> Cloud:
        """The cloud in the CRS of the run."""
        if metric.is_source:
            return self
        x_m, y_m, z_m = metric.points(self.x_m, self.y_m, self.z_m)
        return replace(self, x_m=x_m, y_m=y_m, z_m=z_m, crs=metric.crs)


_NOTHING = Cloud(
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0, np.uint8),
    None,
    np.zeros(0, np.uint16),
)


@dataclass(frozen=True)
class CloudHeader:
    """What the header of a file states. bounds: None if it states none, or bounds that do not contain the first point.
    heights: vertical CRS, which may be stated without a horizontal one. doubts: what is wrong with the header, a line
    each."""

    path: Path
    num_points: int
    crs: pyproj.CRS | None
    bounds: Bounds | None
    heights: pyproj.CRS | None = None
    doubts: tuple[str, ...] = ()

    def overlaps(self, bounds: Bounds) -> bool:
        """Whether points may be within ``bounds``."""
        return self.bounds is None or are_near(self.bounds, bounds, _HEADER_MARGIN_M)


def list_clouds(paths: Sequence[Path]) -> list[Path]:
    """The files in the order given, each once. A folder is replaced by its LAS and LAZ files, sorted by name.

    Raises :class:`InputError` if a folder has no such file.
    """
    result: list[Path] = []
    for path in paths:
        files = path.iterdir() if path.is_dir() else ()
        found = sorted(file for file in files if file.suffix.lower() in _SUFFIXES)
        if path.is_dir() and not found:
            raise InputError(f"{path}: has no LAS or LAZ file")
        result += found or [path]
    return list(dict.fromkeys(result))


def read_headers(paths: Sequence[Path]) -> list[CloudHeader]:
    """The headers of all files. Raises :class:`InputError` if a file is broken, or if two have different CRSs."""
    headers: list[CloudHeader] = []
    steps: dict[int, tuple[CloudHeader, np.ndarray]] = {}
    for path in paths:
        # without threads, which would decode more than a point
        with open_cloud(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            header = reader.header
            stated = stated_crs(header)
            first = reader.read_points(1)
        bounds = bounds_of(header)
        count, doubts = int(header.point_count), stated.doubts
        box = (*header.mins[:2].tolist(), *header.maxs[:2].tolist())
        place = bounds_of_points(first.x, first.y)
        if place is not None and not are_near(box, place, _HEADER_MARGIN_M):
            bounds = None
            doubts += ("the header states bounds in which its first point is not; all its points are read",)
        num_held = _num_held(header, path.stat().st_size)
        if num_held > count:
            doubts += (f"the header states {count:,} points of {num_held:,}; the others are not read",)
        known = CloudHeader(path, count, stated.crs, bounds, stated.heights, doubts)
        twin, step = steps.setdefault(count, (known, header.scales))
        if _is_rounded(known, twin, header.scales, step):
            text = (
                f"has as many points as {twin.path}, in the same bounds, rounded otherwise; if it is a copy, its points"
                " count twice: omit one of the files"
            )
            known = replace(known, doubts=(*doubts, text))
        headers.append(known)
    common_header(headers)
    return headers


def _is_rounded(first: CloudHeader, second: CloudHeader, step: np.ndarray, other: np.ndarray) -> bool:
    """Whether two files with as many points may hold the same points, rounded to different steps: their headers state
    other scales and, but for rounding, the same bounds. Points in equal steps are left to :func:`repeated`."""
    if first.bounds is None or second.bounds is None or np.array_equal(step, other):
        return False
    apart = np.abs(np.subtract(first.bounds, second.bounds))
    return bool(apart.max() <= 1.01 * max(step.max(), other.max()))


def _num_held(header: laspy.LasHeader, size: int) -> int:
    """The number of points for which the file has room, if it is more than 1 % above the stated number; else 0. Also 0
    for compressed points. size: of the file, bytes."""
    if header.are_points_compressed:
        return 0
    end = header.start_of_first_evlr if header.number_of_evlrs else size
    # LAS 1.3 may have waveforms behind the points, and programs leave some bytes there
    num = (end - header.offset_to_point_data) // header.point_format.size
    return num if num > 1.01 * header.point_count and header.start_of_waveform_data_packet_record == 0 else 0


def common_header(headers: Sequence[CloudHeader]) -> CloudHeader | None:
    """The first header that states a CRS. Raises :class:`InputError` if another header states another CRS."""
    stated = [header for header in headers if header.crs is not None]
    for header in stated[1:]:
        check_crs(header.crs, stated[0].crs, header.path, f"{stated[0].path} is", "reproject one of them")
    return stated[0] if stated else None


def read_clouds(
    paths: Sequence[str | Path],
    bounds: Bounds | None = None,
    classes: ClassSet = LAS,
) -> Cloud:
    """The points of all files, in order, without noise (classes 7 and 18), withheld points and classes that ``classes``
    ignores; other classes become classes of LAS. A point that several files have is taken from the first of them
    (:func:`repeated`).

    bounds: (x_min, y_min, x_max, y_max) of the points to keep, edges included. COPC files are read by window; of other
    files, all points are decoded.

    Raises :class:`InputError` if a file is missing, truncated or not LAS, or if the files have different CRSs.
    """
    return joined(read_in_chunks(paths, bounds, classes))


def joined(chunks: Iterable[Cloud]) -> Cloud:
    """The points of all chunks in one cloud, in their CRS. A point that several files have is kept once, and a message
    says how many there are. The chunks of a file must follow each other."""
    parts = [_NOTHING, *chunks]
    names = ("x_m", "y_m", "z_m", "classification", "day")
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    paths = [path for path, _ in groupby(part.path for part in parts)]
    number = np.cumsum([one.path != other.path for one, other in pairwise([parts[0], *parts])])
    file = np.repeat(number, [len(part) for part in parts])
    again, num_points = repeated(columns["x_m"], columns["y_m"], columns["z_m"], file)
    if again.any():
        columns = {name: column[~again] for name, column in columns.items()}
    tell_repeated(num_points, paths)
    return Cloud(**columns, crs=parts[-1].crs, path=None)


def repeated(
    x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray, file: np.ndarray
) -> tuple[np.ndarray, Counter[tuple[int, int]]]:
    """(bool (n,): the points that an earlier file has, too; number of points that each pair of files, the earlier
    first, has in common).

    Tiles may overlap, and a folder may have a tile as LAZ and as COPC. Such points would count twice where roofs are
    fitted. Equal points within one file stay, because a survey in steps of 0.1 m has many. file: int (n,), the number
    of the file of each point, ascending from 0.
    """
    result = np.zeros(len(file), bool)
    first = np.flatnonzero(np.diff(file, prepend=-1))
    xy = (x_m, y_m)
    low = np.array([np.minimum.reduceat(v, first) for v in xy]) - 1 / STEPS_PER_M
    high = np.array([np.maximum.reduceat(v, first) for v in xy]) + 1 / STEPS_PER_M
    meet = (low[:, :, None] <= high[:, None]).all(axis=0)
    meet &= meet.T & ~np.eye(len(first), dtype=bool)
    is_shared = np.zeros(len(file), bool)
    for k, other in np.argwhere(meet).tolist():
        own = slice(first[k], first[k + 1] if k + 1 < len(first) else len(file))
        is_in = [(v[own] >= low[i, other]) & (v[own] <= high[i, other]) for i, v in enumerate(xy)]
        is_shared[own] |= is_in[0] & is_in[1]
    row = np.flatnonzero(is_shared)
    # files may differ in their offsets, and thus in the last bits of equal coordinates
    step = steps(x_m[row], y_m[row], z_m[row])
    order = np.argsort(marks(step), kind="stable")
    step, row = step[:, order], row[order]
    is_new = np.ones(len(row), bool)
    is_new[1:] = (step[:, 1:] != step[:, :-1]).any(axis=0)
    owner = file[row[is_new]][np.cumsum(is_new) - 1]
    is_again = owner != file[row]
    result[row] = is_again
    pair, count = np.unique(owner[is_again] * 2**32 + file[row[is_again]], return_counts=True)
    pairs = zip((pair // 2**32).tolist(), (pair % 2**32).tolist(), strict=True)
    return result, Counter(dict(zip(pairs, count.tolist(), strict=True)))


def tell_repeated(num_points: Counter[tuple[int, int]], paths: Sequence[Path | None]) -> None:
    """Log how many points are in several files. num_points: by the numbers of both files in ``paths``, the earlier
    first."""
    if num_points:
        ((earlier, later), most), total = num_points.most_common(1)[0], num_points.total()
        names = f"{most:,} points of {paths[later]} are in {paths[earlier]}, too"
        others = f", and {total - most:,} of others" if total > most else ""
        log.info("note: %s%s: used once", names, others)


def read_in_chunks(
    paths: Sequence[str | Path], bounds: Bounds | None = None, classes: ClassSet = LAS
) -> Iterator[Cloud]:
    """The points of :func:`read_clouds` in chunks of about half a million, or a window of a COPC file as a whole. A
    point that several files have comes several times."""
    common = common_header(read_headers([Path(path) for path in paths]))
    crs = None if common is None else common.crs
    for path in paths:
        with reading(path, KIND):
            for header, points in _chunks(path, bounds):
                yield replace(_cloud(points, header, bounds, classes, crs), path=Path(path))


def extent(headers: Sequence[CloudHeader]) -> Bounds | None:
    """Bounds of the first cloud that has any: as its header states them, else those of its points. None if no cloud has
    points."""
    for header in headers:
        if header.bounds is not None:
            return header.bounds
        parts = read_in_chunks([header.path]) if header.num_points else []
        boxes = np.array([bounds_of_points(part.x_m, part.y_m) for part in parts if len(part)])
        if len(boxes):
            return bounds_of_points(boxes[:, ::2].ravel(), boxes[:, 1::2].ravel())
    return None


def cloud_of(data: laspy.LasData) -> Cloud:
    """The points of a cloud that laspy has read, filtered as by :func:`read_clouds`."""
    return _cloud(data.points, data.header, None, LAS, crs_of(data.header))


def _chunks(
    path: str | Path, bounds: Bounds | None
) -> Iterator[tuple[laspy.LasHeader, laspy.ScaleAwarePointRecord]]:
    """The points of a file in chunks, each with the header. The window of a COPC file is one chunk, unless it is too
    large."""
    with open_cloud(path) as reader:
        header = reader.header
        is_copc = any(vlr.user_id == "copc" and vlr.record_id == 1 for vlr in header.vlrs)
        if bounds is None or not is_copc or _num_expected(header, bounds) > _MAX_WINDOW_POINTS:
            num_read = 0
            for points in reader.chunk_iterator(_CHUNK_POINTS):
                num_read += len(points)
                yield header, points
            if num_read != header.point_count:
                raise EOFError(f"{num_read} of {header.point_count} points")
            if num_read == 0:  # for the CRS
                yield header, laspy.ScaleAwarePointRecord.zeros(0, header=header)
            return
    with laspy.CopcReader.open(path) as reader:
        # queries round their bounds to whole units of coordinates
        unit = np.asarray(reader.header.scales[:2])
        mins, maxs = np.array(bounds[:2]) - unit, np.array(bounds[2:]) + unit
        yield reader.header, reader.query(bounds=laspy.copc.Bounds(mins=mins, maxs=maxs))


def _num_expected(header: laspy.LasHeader, bounds: Bounds) -> float:
    """Estimated number of points of a file in a window, by the shares of areas; all points if the header states no
    area."""
    low, high = header.mins[:2], header.maxs[:2]
    size = np.minimum(high, bounds[2:]) - np.maximum(low, bounds[:2])
    area = float(np.prod(high - low))
    return header.point_count * (float(np.prod(np.maximum(size, 0))) / area if area > 0 else 1.0)


def _cloud(
    points: laspy.ScaleAwarePointRecord,
    header: laspy.LasHeader,
    bounds: Bounds | None,
    classes: ClassSet,
    crs: pyproj.CRS | None,
) -> Cloud:
    """The points to keep: not withheld, not ignored by ``classes``, and within ``bounds``."""
    x, y = np.asarray(points.x), np.asarray(points.y)
    classification, keep = classes.to_las(np.asarray(points.classification).astype(np.uint8))
    keep &= ~np.asarray(points.withheld).astype(bool)
    if bounds is not None:
        x_min, y_min, x_max, y_max = bounds
        keep &= (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
    z, day = np.asarray(points.z)[keep], _days(points, header)[keep]
    return Cloud(x[keep], y[keep], z, classification[keep], crs, day)


def _days(points: laspy.ScaleAwarePointRecord, header: laspy.LasHeader) -> np.ndarray:
    """The days of points, as in :class:`Cloud`.

    GPS times are either seconds since the epoch, less 1e9 (LAS 1.4, "adjusted standard GPS time"), or seconds of an
    unknown week. The header states which, but not always rightly. So a time is a date if it is more than the 604,800
    seconds of a week and at most ten years later than the file; other points get the creation date of the file.
    """
    # some programs write years that are centuries ahead
    created = 0 if header.creation_date is None else (header.creation_date - GPS_EPOCH).days
    day = np.full(len(points), created if 0 < created < 2**16 else 0, np.uint16)
    if "gps_time" not in points.point_format.dimension_names:
        return day
    time_s = np.asarray(points.gps_time)
    from_time = np.floor((time_s + _GPS_OFFSET_S) / _DAY_S)
    # without a creation date, the limit excludes raw GPS times since 2011 and Unix times since 2001
    latest = created + _AHEAD_DAYS if _FIRST_LAS <= created < 2**16 else 2 * _GPS_OFFSET_S / _DAY_S
    is_date = (np.abs(time_s) > _WEEK_S) & (from_time > 0) & (from_time < latest)
    day[is_date] = from_time[is_date]
    return day
