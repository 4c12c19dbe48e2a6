"""Read a window of a remote COPC file without downloading the rest.

laspy's own HTTP reader sends many requests at once and gives up at the first refusal. Here laspy reads from an
object that fetches one block after another through :class:`Client`, within the limits of the config.
"""

from __future__ import annotations

import io
from pathlib import Path

import laspy
import numpy as np
import pyproj

from p2wss.data.tiling import Bounds
from p2wss.errors import reading
from p2wss.fetch.http import Client
from p2wss.storage import files

_BLOCK_BYTES = 1 << 17  # the octree nodes of a LiDAR HD tile have 10 to 500 kB


class RemoteFile(io.RawIOBase):
    """A file at a URL, whose parts are requested as they are read; to be read through ``io.BufferedReader``."""

    def __init__(self, client: Client, url: str) -> None:
        self.client = client
        self.url = url
        self.position = 0
        _, self.size = client.range(url, 0, 1)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self.position = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self.position, io.SEEK_END: self.size}[whence]
        return self.position

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        end = min(self.position + len(buffer), self.size)
        if end <= self.position:
            return 0
        body, _ = self.client.range(self.url, self.position, end)
        buffer[: len(body)] = body
        self.position = end
        return len(body)


def write_window(client: Client, url: str, bounds: Bounds, out: Path, crs: str) -> int:
    """Write the points of a remote COPC file in ``bounds`` (edges included) as LAZ. Returns their number.

    Raises :class:`InputError` if the file is broken or not COPC, and
    :class:`~p2wss.fetch.http.RangesUnsupportedError` if the service sends only whole files.
    """
    x_min, y_min, x_max, y_max = bounds
    window = laspy.copc.Bounds(mins=np.array([x_min, y_min]), maxs=np.array([x_max, y_max]))
    file = io.BufferedReader(RemoteFile(client, url), _BLOCK_BYTES)
    with reading(url, "a readable COPC file"), laspy.CopcReader(file) as reader:
        points = reader.query(bounds=window)
        header = laspy.LasHeader(version=reader.header.version, point_format=reader.header.point_format)
        header.scales, header.offsets = reader.header.scales, reader.header.offsets
    header.add_crs(pyproj.CRS.from_user_input(crs))
    with (
        files.atomic(out, seal=True) as temporary,
        laspy.open(temporary, "w", header=header, do_compress=True) as writer,
    ):
        writer.write_points(points)
    return len(points)
