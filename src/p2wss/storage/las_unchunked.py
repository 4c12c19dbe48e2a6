"""LAZ files whose points are one stream without chunks (LASzip 1.2r0 and before), as files of one chunk.

The stream is the same in both (LAZ specification 1.4); files of chunks have the position of a table before it, and the
table behind it.
"""

from __future__ import annotations

import shutil
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import lazrs

# compressors of LASzip: all points in one stream, and in chunks
UNCHUNKED, CHUNKED = 1, 2


@contextmanager
def in_one_chunk(path: str | Path, points_at: int, record_at: int, num_points: int) -> Iterator[IO[bytes]]:
    """A temporary copy of a file without chunks, with what makes its stream a chunk.

    points_at: offset of the stream. record_at: of the content of LASzip's record in the file. num_points: of the file.
    """
    end = Path(path).stat().st_size
    with open(path, "rb") as file, tempfile.TemporaryFile() as copy:
        head = bytearray(file.read(points_at))
        struct.pack_into("<H", head, record_at, CHUNKED)
        struct.pack_into("<I", head, record_at + 12, num_points)
        (length,) = struct.unpack_from("<H", head, record_at - 34)
        copy.write(bytes(head) + struct.pack("<q", end + 8))
        shutil.copyfileobj(file, copy)
        vlr = lazrs.LazVlr(bytes(head[record_at : record_at + length]))
        lazrs.write_chunk_table(copy, [(num_points, end - points_at)], vlr)
        copy.seek(0)
        yield copy
