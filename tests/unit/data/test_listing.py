"""Which files of a folder concern a tile: read from their headers, without opening them."""

import laspy
import numpy as np
import pytest

from p2wss.data import listing
from p2wss.storage.messages import InputError


def write_cloud(path, x_m, y_m):
    cloud = laspy.create(point_format=6, file_version="1.4")
    cloud.header.offsets, cloud.header.scales = [652000, 6861000, 0], [0.01] * 3
    cloud.x, cloud.y, cloud.z = np.array(x_m), np.array(y_m), np.zeros(len(x_m))
    cloud.write(path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_the_extent_of_a_cloud_is_that_of_its_points(tmp_path, suffix):
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, [652001.5, 652900.25], [6861010.0, 6861999.5])
    assert listing.extent_m(path) == pytest.approx((652001.5, 6861010.0, 652900.25, 6861999.5))
    assert listing.may_overlap(listing.extent_m(path), (652900.0, 6861000.0, 653900.0, 6862000.0))
    assert not listing.may_overlap(listing.extent_m(path), (653000.0, 6861000.0, 654000.0, 6862000.0))


@pytest.mark.parametrize(
    "anchor, west", [("xllcorner 1000\nyllcorner", 1000.0), ("xllcenter 1000\nyllcenter", 997.5)]
)
def test_the_extent_of_a_grid_is_that_of_its_cells(tmp_path, anchor, west):
    path = tmp_path / "grid.asc"
    path.write_text(f"ncols 4\nnrows 2\n{anchor} 2000\ncellsize 5\nNODATA_value -99999\n1 2 3 4\n5 6 7 8\n")
    south = 1000.0 + west
    assert listing.extent_m(path) == (west, south, west + 20, south + 10)


@pytest.mark.parametrize("content", [b"", b"LASF", b"ncols x\n", b"\xff" * 600, b"ncols 4\nnrows"])
def test_a_file_that_states_no_extent_may_lie_anywhere(tmp_path, content):
    path = tmp_path / "grid.asc"
    path.write_bytes(content)
    assert listing.extent_m(path) is None and listing.may_overlap(listing.extent_m(path), (0, 0, 1, 1))


def test_files_that_belong_together_are_named_together(tmp_path):
    for name in ("a.shp", "a.dbf", "a.shx", "b.dbf"):
        (tmp_path / name).touch()
    assert [path.name for path in listing.with_companions(tmp_path / "a.shp")] == ["a.shp", "a.dbf", "a.shx"]


def test_an_empty_folder_is_named_with_its_key(tmp_path):
    with pytest.raises(InputError, match=r"fetch\.folder\.dtm: .*no folder or pattern with files .asc"):
        listing.list_files(str(tmp_path), (".asc",), "fetch.folder.dtm")
