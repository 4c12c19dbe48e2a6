"""LAZ without chunks, as LASzip 1.2r0 wrote it: made of a file of one chunk by the LAZ specification."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest

from p2wss.clouds.reading import read_clouds
from p2wss.fetching.cloud import write_cloud
from p2wss.storage.messages import InputError


def without_chunks(path: Path, content: bytes) -> Path:
    """The file of one chunk, without the position of its table and the table, and with compressor 1."""
    (points_at,) = struct.unpack_from("<I", content, 96)
    (table_at,) = struct.unpack_from("<q", content, points_at)
    record_at = content.index(b"laszip encoded") + 52
    head = bytearray(content[:points_at])
    head[record_at : record_at + 2] = struct.pack("<H", 1)
    path.write_bytes(bytes(head) + content[points_at + 8 : table_at])
    return path


@pytest.fixture
def chunked(tmp_path: Path) -> Path:
    draw, header = np.random.default_rng(3), laspy.LasHeader(version="1.2", point_format=3)
    header.scales = np.full(3, 0.001)
    las = laspy.LasData(header)
    las.x, las.y, las.z = draw.uniform(0, 100, (3, 20_000))
    las.classification = draw.integers(1, 7, 20_000).astype(np.uint8)
    las.write(tmp_path / "chunked.laz")
    return tmp_path / "chunked.laz"


def test_points_without_chunks_are_those_of_one_chunk(chunked: Path, tmp_path: Path) -> None:
    path = without_chunks(tmp_path / "old.laz", chunked.read_bytes())
    old, new = read_clouds([path]), read_clouds([chunked])
    assert len(old) == 20_000
    for name in ("x_m", "y_m", "z_m", "classification"):
        assert np.array_equal(getattr(old, name), getattr(new, name))


def test_a_truncated_file_without_chunks_is_refused(chunked: Path, tmp_path: Path) -> None:
    content = without_chunks(tmp_path / "old.laz", chunked.read_bytes()).read_bytes()
    (tmp_path / "old.laz").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"old\.laz"):
        read_clouds([tmp_path / "old.laz"])


def test_points_without_chunks_are_cut_to_a_tile(chunked: Path, tmp_path: Path) -> None:
    path = without_chunks(tmp_path / "old.laz", chunked.read_bytes())
    counts = [
        write_cloud(tmp_path / f"{each.stem}_cut.laz", [each], (0, 0, 50, 50), "EPSG:2154")
        for each in (path, chunked)
    ]
    assert counts[0] == counts[1] > 4000
    old, new = (read_clouds([tmp_path / f"{name}_cut.laz"]) for name in ("old", "chunked"))
    assert np.array_equal(old.x_m, new.x_m) and np.array_equal(old.z_m, new.z_m)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"old\.laz"):
        write_cloud(tmp_path / "none.laz", [path], (0, 0, 50, 50), "EPSG:2154")
    assert not (tmp_path / "none.laz").exists()
