"""LAZ files whose points are one stream without chunks (LASzip 1.2r0 and before), as files of one chunk.

The stream is the same in both (LAZ specification 1.4); files of chunks have the position of a table before it, and the
table behind it.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path

import lazrs

# compressors of LASzip: all points in one stream, and in chunks
UNCHUNKED, CHUNKED = 1, 2


class OneChunk(io.RawIOBase):
    """The bytes of a file without chunks, with what makes its stream a chunk, for reading.

    points_at: offset of the stream. record_at: of the content of LASzip's record in the file. num_points: of the file.
    """

    def __init__(self, path: str | Path, points_at: int, record_at: int, num_points: int) -> None:
        self._file = open(path, "rb")  # noqa: SIM115  closed with this
        self._points_at, self._at = points_at, 0
        end = Path(path).stat().st_size
        head = bytearray(self._file.read(points_at))
        struct.pack_into("<H", head, record_at, CHUNKED)
        struct.pack_into("<I", head, record_at + 12, num_points)
        self._head = bytes(head) + struct.pack("<q", end + 8)
        (length,) = struct.unpack_from("<H", head, record_at - 34)
        table = io.BytesIO()
        vlr = lazrs.LazVlr(bytes(head[record_at : record_at + length]))
        lazrs.write_chunk_table(table, [(num_points, end - points_at)], vlr)
        self._table, self._table_at = table.getvalue(), end + 8

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._table_at + len(self._table)}[whence]
        self._at = base + offset
        return self._at

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        size = len(buffer)
        if self._at < len(self._head):
            content = self._head[self._at : self._at + size]
        elif self._at < self._table_at:
            self._file.seek(self._at - 8)
            content = self._file.read(min(size, self._table_at - self._at))
        else:
            content = self._table[self._at - self._table_at :][:size]
        buffer[: len(content)] = content
        self._at += len(content)
        return len(content)

    def close(self) -> None:
        self._file.close()
        super().close()
