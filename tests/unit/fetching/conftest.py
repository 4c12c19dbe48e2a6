"""Fixtures: clouds of known points, an installed PDAL, and IGN's services on a local server."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
from places import ROOT
from pytest_httpserver import HTTPServer

from p2wss.config import Geoplateforme
from p2wss.fetching.geoplateforme import GeoplateformeSource
from p2wss.fetching.http import Client


@pytest.fixture(scope="session")
def pdal_command() -> str:
    """A ``pdal`` on the PATH, or the one that tests/pdal/make_root.sh installed."""
    if shutil.which("pdal"):
        return "pdal"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    root = cache / "p2wss-test" / "bullseye-pdal"
    if not (root / "usr/bin/pdal").exists() or os.geteuid() != 0:
        pytest.skip("no PDAL on this machine; as root on Debian: tests/pdal/make_root.sh")
    return f"{ROOT / 'tests/pdal/pdal.sh'} {root}"


WriteCloud = Callable[..., Path]


@pytest.fixture
def write_points(tmp_path: Path) -> WriteCloud:
    """Writes a LAZ (or LAS) file of points (n, 3) with classes."""

    def write(name: str, points: np.ndarray, classes: np.ndarray | int = 1, **columns: np.ndarray) -> Path:
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales, header.offsets = [0.001] * 3, [652000, 6861000, 0]
        header.add_crs(pyproj.CRS(columns.pop("crs", "EPSG:2154")))
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = np.asarray(points, float).T
        cloud.classification = np.broadcast_to(classes, len(points))
        cloud.return_number = cloud.number_of_returns = np.ones(len(points), np.uint8)
        for column, values in columns.items():
            cloud[column] = values
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cloud.write(path)
        return path

    return write


@pytest.fixture
def source(httpserver: HTTPServer, tmp_path: Path) -> Any:
    """Creates sources that use the local server and share one folder of downloads."""

    def make(crs: str = "EPSG:2154", **settings: Any) -> GeoplateformeSource:
        config = Geoplateforme(
            wfs_url=httpserver.url_for("/wfs/ows"),
            wms_url=httpserver.url_for("/wms-r"),
            requests_per_s=1e6,
            **settings,
        )
        client = Client(config, sleep=lambda seconds: None)
        return GeoplateformeSource(config, crs, tmp_path / "downloads", client)

    return make
