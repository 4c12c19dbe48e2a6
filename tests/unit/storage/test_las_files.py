"""The CRS that a cloud states, where its header has more than one key for it."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.vlrs.geotiff import GeoKeyEntryStruct
from laspy.vlrs.known import GeoKeyDirectoryVlr

from p2wss.clouds.reading import read_headers
from p2wss.storage.las_crs import crs_of

UNKNOWN = 1132


def header(*keys: tuple[int, int]) -> laspy.LasHeader:
    """A header with GeoTIFF keys, (key, value)."""
    record = GeoKeyDirectoryVlr()
    record.geo_keys_header.number_of_keys = len(keys)
    record.geo_keys = [GeoKeyEntryStruct(key, 0, 1, value) for key, value in keys]
    result = laspy.LasHeader(version="1.2", point_format=3)
    result.vlrs.append(record)
    return result


def test_an_unknown_geographic_crs_beside_a_projected_one_does_not_count(tmp_path: Path) -> None:
    cloud = laspy.LasData(header((1024, 1), (2048, UNKNOWN), (3072, 7791)))
    cloud.x, cloud.y, cloud.z = np.zeros((3, 4))
    cloud.write(tmp_path / "a.las")
    (found,) = read_headers([tmp_path / "a.las"])
    assert found.crs is not None and found.crs.to_epsg() == 7791


@pytest.mark.parametrize("key", [2048, 3072])
def test_an_unknown_crs_is_none_with_a_warning(key: int, caplog: pytest.LogCaptureFixture) -> None:
    assert crs_of(header((1024, 1), (key, UNKNOWN))) is None
    assert str(UNKNOWN) in caplog.text


def test_a_geographic_crs_alone_counts() -> None:
    crs = crs_of(header((1024, 2), (2048, 4326)))
    assert crs is not None and crs.to_epsg() == 4326
