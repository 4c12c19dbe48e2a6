"""What headers of clouds state, against what the files hold."""

from __future__ import annotations

import struct
from datetime import date
from pathlib import Path

import laspy
import numpy as np
import pytest

from p2wss.clouds.reading import read_clouds, read_headers
from p2wss.data.listing import extent_m, may_overlap
from p2wss.storage.messages import InputError


@pytest.mark.parametrize(("share", "is_told"), [(0.5, True), (1.0, False)])
def test_a_header_that_states_fewer_points_than_the_file_holds_is_told(
    tmp_path: Path, share: float, is_told: bool
) -> None:
    cloud = laspy.create(point_format=1, file_version="1.2")
    cloud.x, cloud.y, cloud.z = np.arange(3000.0).reshape(3, 1000)
    path = tmp_path / "cloud.las"
    cloud.write(path)
    content = bytearray(path.read_bytes())
    # LAS 1.2, table 1: the number of point records
    struct.pack_into("<I", content, 107, int(1000 * share))
    path.write_bytes(content + bytes(40))
    (header,) = read_headers([path])
    told = [each for each in header.doubts if "1,001" in each and "500" in each]
    assert len(told) == is_told and header.num_points == 1000 * share


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("stated", "is_told"),
    [
        ((9, 0, 19, 10), False),
        ((9.4, -0.4, 19, 10), False),  # rounded
        ((0, 0, 0, 0), True),
        ((9, 9, 0, 0), True),
        ((np.nan,) * 4, True),
        ((-5000, -4991, 10, 19), True),  # of points that were moved
    ],
)
def test_bounds_in_which_no_point_is_are_told_and_not_used(
    tmp_path: Path, stated: tuple[float, ...], is_told: bool, suffix: str
) -> None:
    cloud = laspy.create(point_format=1, file_version="1.2")
    cloud.x, cloud.y, cloud.z = np.arange(30.0).reshape(3, 10)
    path = tmp_path / f"cloud{suffix}"
    cloud.write(path)
    content = bytearray(path.read_bytes())
    # LAS 1.2, table 1: largest and least x, largest and least y
    struct.pack_into("<4d", content, 179, *stated)
    path.write_bytes(content)
    (header,) = read_headers([path])
    assert ("bounds in which its first point is not" in "".join(header.doubts)) == is_told
    assert (header.bounds is None) == is_told and header.overlaps((0, 10, 1, 11))
    # a start of the workflow reads no points
    assert may_overlap(extent_m(path), (0, 10, 1, 11)) or stated[0] == -5000


@pytest.mark.parametrize("number", [0.0, np.nan, np.inf])
@pytest.mark.parametrize("place", [131, 155])
def test_steps_and_offsets_that_cannot_be_are_an_error(tmp_path: Path, place: int, number: float) -> None:
    cloud = laspy.create(point_format=1, file_version="1.2")
    cloud.x, cloud.y, cloud.z = np.arange(30.0).reshape(3, 10)
    path = tmp_path / "cloud.las"
    cloud.write(path)
    content = bytearray(path.read_bytes())
    # LAS 1.2, table 1: scale factors and offsets of x, y and z
    struct.pack_into("<d", content, place + 8, number)
    path.write_bytes(content)
    if (place, number) == (155, 0.0):
        assert read_headers([path])[0].num_points == 10
        return
    with pytest.raises(InputError, match="coordinates in steps of"):
        read_headers([path])


@pytest.mark.parametrize(
    ("content", "remedy"),
    [
        (b"\x1f\x8b\x08", "unpack it"),
        (b"PK\x03\x04", "unpack it"),
        (b"ply\nformat", "convert"),
        (b"1.5 2.5 3.5\n", "convert"),
        (b"LASF\x00", "its header ends too early"),
    ],
)
def test_what_is_no_las_says_what_to_do(content: bytes, remedy: str, tmp_path: Path) -> None:
    (tmp_path / "cloud").write_bytes(content)
    with pytest.raises(InputError, match=rf"cloud: .*{remedy}"):
        read_headers([tmp_path / "cloud"])


def test_a_year_centuries_ahead_is_no_day(tmp_path: Path) -> None:
    cloud = laspy.create(point_format=0, file_version="1.2")
    cloud.header.creation_date = date(2921, 5, 1)
    cloud.x, cloud.y, cloud.z = np.zeros((3, 2))
    cloud.write(path := tmp_path / "cloud.las")
    assert read_clouds([path]).day.tolist() == [0, 0]
