"""Open LAS, LAZ and COPC files after checking their headers, so that none uses unbounded time or memory."""

import math
import shutil
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import IO, Any, BinaryIO

import laspy
import lazrs
import numpy as np

from p2wss.storage import integrity
from p2wss.storage.messages import reading

# what messages call such a file
KIND = "a readable LAS, LAZ or COPC file, or truncated"
_SIGNATURE = b"LASF"
# gzip, zip
_PACKED = (b"\x1f\x8b", b"PK")
_MIN_HEADER, _HEADER_1_4 = 227, 375
_VLR_HEADER, _EVLR_HEADER = 54, 60
# user id and record id of LASzip's record, as registered with ASPRS
_LASZIP = (b"laszip encoded", 22204)
# compressors of LASzip: all points in one stream; points in chunks
_UNCHUNKED, _CHUNKED = 1, 2
# largest number of points that are decoded together
_MAX_CHUNK_POINTS = 50_000_000
# coordinates in the same step are equal. There are this many steps per metre, finer than the coordinates of files,
# which are multiples of at least 0.1 mm; with the phase, no such multiple lies at the border of two steps
STEPS_PER_M, _PHASE = 8000.0, 0.382
# large odd numbers that mix three coordinates into one number
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


@contextmanager
def open_cloud(path: str | Path, kind: str = KIND, **options: Any) -> Iterator[laspy.LasReader]:
    """``laspy.open`` for reading. Any error of the block is raised as an :class:`InputError` that ``path`` is not
    ``kind``; for a damaged file of p2wss it says how to make it again."""
    integrity.verify(path)
    with reading(path, kind):
        unchunked = check_header(path)
        if unchunked is not None:
            # not in parallel, which would need memory for a whole chunk
            options["laz_backend"] = laspy.LazBackend.Lazrs
        readable = nullcontext(path) if unchunked is None else _in_one_chunk(path, *unchunked)
        with readable as source, laspy.open(source, **options) as reader:
            yield reader


def bounds_of(header: laspy.LasHeader) -> tuple[float, float, float, float] | None:
    """(x_min, y_min, x_max, y_max) as a header states them; None if they are not finite, or not a window."""
    is_stated = (
        np.isfinite([header.mins[:2], header.maxs[:2]]).all() and (header.maxs > header.mins)[:2].all()
    )
    return (*header.mins[:2].tolist(), *header.maxs[:2].tolist()) if is_stated else None


def check_header(path: str | Path) -> tuple[int, int, int] | None:
    """The arguments of :func:`_in_one_chunk` for a file of compressed points without chunks; None for others.

    Raises ValueError for a header whose counts and offsets do not fit into the file (LAS specification 1.4-R15).
    """
    size = Path(path).stat().st_size
    with open(path, "rb") as file:
        head = file.read(_HEADER_1_4)
        if head[:4] != _SIGNATURE:
            remedy = (
                "unpack it"
                if head[:2] in _PACKED
                else "convert what is in another format (E57, PLY, text) to LAZ, with PDAL or CloudCompare for instance"
            )
            raise ValueError(f"it does not begin as one; {remedy}")
        if len(head) < _MIN_HEADER:
            raise ValueError("its header ends too early")
        header_size, points_at, num_vlrs, point_format, record_size, num_points = struct.unpack_from(
            "<HIIBHI", head, 94
        )
        if not header_size + _VLR_HEADER * num_vlrs <= points_at <= size:
            raise ValueError(
                f"its header states {num_vlrs} variable length records, which do not fit into the file"
            )
        steps = struct.unpack_from("<6d", head, 131)  # and offsets
        if not all(map(math.isfinite, steps)) or 0 in steps[:3]:
            raise ValueError(f"its header states coordinates in steps of {steps[:3]} from {steps[3:]}")
        if head[25] >= 4 and len(head) == _HEADER_1_4:
            evlrs_at, num_evlrs, num_points = struct.unpack_from("<QIQ", head, 235)
            for _ in range(num_evlrs):  # behind the points: a file that is truncated lacks some
                file.seek(evlrs_at + 20)
                (length,) = struct.unpack("<Q", _exactly(file, 8))
                evlrs_at += _EVLR_HEADER + length
                if evlrs_at > size:
                    raise ValueError(
                        f"its {num_evlrs} extended records do not fit into the file: it is truncated"
                    )
        if not point_format & 0x80:
            if points_at + num_points * record_size > size:
                raise ValueError(f"its header states {num_points} points, which do not fit into the file")
        elif num_points:
            record_at = _check_chunks(file, header_size, num_vlrs, points_at, size)
            return None if record_at is None else (points_at, record_at, num_points)
    return None


def _check_chunks(file: BinaryIO, header_size: int, num_vlrs: int, points_at: int, size: int) -> int | None:
    """Check the chunks of compressed points (LAZ specification 1.4) like :func:`check_header`. Returns None, or for
    points without chunks the offset of the content of LASzip's record."""
    file.seek(header_size)
    for _ in range(num_vlrs):
        record = file.read(_VLR_HEADER)
        if len(record) < _VLR_HEADER:
            raise ValueError("its variable length records end too early")
        user, number, length = struct.unpack_from("<16sHH", record, 2)
        content = file.read(length)
        if (user.rstrip(b"\0"), number) == _LASZIP and len(content) >= 16:
            compressor, chunk_points = struct.unpack_from("<H10xI", content)
            if compressor == _UNCHUNKED:
                (num_items,) = struct.unpack_from("<H", content.ljust(34, b"\0"), 32)
                versions = [
                    version for _, _, version in struct.iter_unpack("<HHH", content[34:][: 6 * num_items])
                ]
                if len(versions) < num_items or max(versions, default=3) > 2:
                    raise ValueError("it has no chunks, but points in a form that needs them")
                return file.tell() - length
            if chunk_points != 0xFFFFFFFF and not 0 < chunk_points <= _MAX_CHUNK_POINTS:
                raise ValueError(f"it states chunks of {chunk_points} points")
            if compressor not in (2, 3):
                raise ValueError(f"it has compressor {compressor}")
    file.seek(points_at)
    (table_at,) = struct.unpack("<q", _exactly(file, 8))
    if table_at == -1:  # written to a stream: at the end
        file.seek(size - 8)
        (table_at,) = struct.unpack("<q", _exactly(file, 8))
    if not points_at < table_at <= size - 8:
        raise ValueError("its chunk table is not within the file")
    file.seek(table_at + 4)
    (num_chunks,) = struct.unpack("<I", _exactly(file, 4))
    if num_chunks > size - points_at:
        raise ValueError(f"it states {num_chunks} chunks, which do not fit into the file")
    return None


def _exactly(file: BinaryIO, count: int) -> bytes:
    content = file.read(count)
    if len(content) < count:
        raise ValueError("it is truncated")
    return content


@contextmanager
def _in_one_chunk(path: str | Path, points_at: int, record_at: int, num_points: int) -> Iterator[IO[bytes]]:
    """A temporary copy of a file whose points are one stream without chunks (LASzip 1.2r0 and before), changed into a
    file of one chunk. The stream is the same in both (LAZ specification 1.4). A file with chunks has the offset of the
    chunk table before the stream, and the table behind it.

    points_at: offset of the stream. record_at: offset of the content of LASzip's record. num_points: of the file.
    """
    end = Path(path).stat().st_size
    with open(path, "rb") as file, tempfile.TemporaryFile() as copy:
        head = bytearray(file.read(points_at))
        struct.pack_into("<H", head, record_at, _CHUNKED)
        struct.pack_into("<I", head, record_at + 12, num_points)
        (length,) = struct.unpack_from("<H", head, record_at - 34)
        copy.write(bytes(head) + struct.pack("<q", end + 8))
        shutil.copyfileobj(file, copy)
        vlr = lazrs.LazVlr(bytes(head[record_at : record_at + length]))
        lazrs.write_chunk_table(copy, [(num_points, end - points_at)], vlr)
        copy.seek(0)
        yield copy


def steps(x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    """Coordinates as numbers of whole steps, int64 (3, n); places with the same numbers count as equal."""
    return np.floor(np.array([x_m, y_m, z_m]) * STEPS_PER_M + _PHASE).astype(np.int64)


def marks(step: np.ndarray) -> np.ndarray:
    """A number for each place in :func:`steps`, uint64 (n,)."""
    return np.asarray((step.astype(np.uint64) * _MIX[:, None]).sum(axis=0))
