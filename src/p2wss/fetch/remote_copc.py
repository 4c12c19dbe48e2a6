"""Read a window of a remote COPC file without downloading the rest.

laspy's own HTTP reader sends many requests at once and gives up at the first refusal. Here laspy reads from an
object that fetches one block after another through :class:`Client`, within the limits of the config.
"""

from __future__ import annotations

import io
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pyproj

from p2wss.data.tiling import Bounds
from p2wss.errors import InputError
from p2wss.fetch.http import Client
from p2wss.storage import files, integrity

_BLOCK_BYTES = 1 << 17  # the octree nodes of a LiDAR HD tile have 10 to 500 kB


class RemoteFile(io.RawIOBase):
    """A file at a URL, read in blocks with HTTP Range requests; each block is requested once."""

    def __init__(self, client: Client, url: str) -> None:
        self.client = client
        self.url = url
        self.position = 0
        self.blocks: dict[int, bytes] = {}
        self.edition = (0, "")  # size, and what the service calls the edition
        self.size = _BLOCK_BYTES  # known after the first request
        self._load(0, 0)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self.position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self.position, io.SEEK_END: self.size}[whence]
        self.position = base + offset
        return self.position

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        start, end = self.position, min(self.position + len(buffer), self.size)
        if end <= start:
            return 0
        first, last = start // _BLOCK_BYTES, (end - 1) // _BLOCK_BYTES
        missing = [number for number in range(first, last + 1) if number not in self.blocks]
        if missing:
            self._load(missing[0], missing[-1])
        content = b"".join(self.blocks[number] for number in range(first, last + 1))
        offset = start - first * _BLOCK_BYTES
        memoryview(buffer).cast("B")[: end - start] = content[offset : offset + end - start]
        self.position = end
        return end - start

    def _load(self, first: int, last: int) -> None:
        start, end = first * _BLOCK_BYTES, (last + 1) * _BLOCK_BYTES
        body, self.size, edition = self.client.range(self.url, start, end)
        if self.blocks and (self.size, edition) != self.edition:
            raise InputError(f"{self.url}: the file changed while it was read; run this again")
        self.edition = self.size, edition
        for index, number in enumerate(range(first, last + 1)):
            self.blocks[number] = body[index * _BLOCK_BYTES : (index + 1) * _BLOCK_BYTES]


def write_window(client: Client, url: str, bounds: Bounds, out: Path, crs: str) -> int:
    """Write the points of a remote COPC file in ``bounds`` (edges included) as LAZ. Returns their number.

    Raises :class:`InputError` if the file is broken or not COPC, and
    :class:`~p2wss.fetch.http.RangesUnsupportedError` if the service sends only whole files.
    """
    x_min, y_min, x_max, y_max = bounds
    window = laspy.copc.Bounds(mins=np.array([x_min, y_min]), maxs=np.array([x_max, y_max]))
    try:
        with laspy.CopcReader(RemoteFile(client, url)) as reader:
            points = reader.query(bounds=window)
            header = laspy.LasHeader(version=reader.header.version, point_format=reader.header.point_format)
            header.scales, header.offsets = reader.header.scales, reader.header.offsets
    except (laspy.errors.LaspyException, lazrs.LazrsError, ValueError, RuntimeError) as error:
        raise InputError(f"{url}: not a readable COPC file: {error}") from error
    header.add_crs(pyproj.CRS.from_user_input(crs))
    with files.atomic(out) as temporary:
        with laspy.open(temporary, "w", header=header, do_compress=True) as writer:
            writer.write_points(points)
        integrity.append(temporary)
    return len(points)
