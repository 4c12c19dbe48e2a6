"""Windows of a remote COPC file, compared with the same windows of the local file."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from places import SHARED
from pytest_httpserver import HTTPServer
from werkzeug import Request, Response

from p2wss.config import Geoplateforme
from p2wss.errors import InputError
from p2wss.fetch.geoplateforme import GeoplateformeSource
from p2wss.fetch.http import Client, RangesUnsupportedError
from p2wss.fetch.remote_copc import RemoteFile, write_window
from p2wss.storage import integrity

COPC = SHARED / "data" / "lidarhd_crops" / "77050_627755_LA93_IGN69.copc.laz"
WINDOW = (770505.0, 6277510.0, 770515.0, 6277520.0)
needs_copc = pytest.mark.skipif(not COPC.exists(), reason="no shared/data/lidarhd_crops")


def client() -> Client:
    return Client(Geoplateforme(requests_per_s=1e6), sleep=lambda seconds: None)


def serve(body: bytes, faults: dict[int, Callable[[Response], Response]] | None = None) -> Any:
    """Serves Range requests; ``faults`` maps the number of a request to what happens to its response."""
    count = 0

    def handler(request: Request) -> Response:
        nonlocal count
        count += 1
        first, last = request.headers["Range"].removeprefix("bytes=").split("-")
        start, end = int(first), min(int(last) + 1, len(body))
        headers = {"Content-Range": f"bytes {start}-{end - 1}/{len(body)}"}
        answer = Response(body[start:end], status=206, headers=headers)
        return (faults or {}).get(count, lambda response: response)(answer)

    return handler


def test_reads_of_any_range_in_any_order(httpserver: HTTPServer) -> None:
    rng = np.random.default_rng(0)
    body = rng.bytes(700_001)
    httpserver.expect_request("/f").respond_with_handler(serve(body))
    file = io.BufferedReader(RemoteFile(client(), httpserver.url_for("/f")), 1 << 17)
    assert file.seek(0, 2) == len(body)
    for start, size in [(0, 10), (131_070, 5), (600_000, 200_000), (250_000, 300_000), (700_001, 4)]:
        file.seek(start)
        assert file.read(size) == body[start : start + size]


@needs_copc
def test_a_remote_window_equals_the_window_of_the_file(httpserver: HTTPServer, tmp_path: Path) -> None:
    httpserver.expect_request("/t.copc.laz").respond_with_handler(serve(COPC.read_bytes()))
    out = tmp_path / "window.laz"
    num_points = write_window(client(), httpserver.url_for("/t.copc.laz"), WINDOW, out, "EPSG:2154")
    cloud = laspy.read(COPC.with_name("77050_627755_LA93_IGN69.laz"))
    x, y = np.asarray(cloud.x), np.asarray(cloud.y)
    inside = (x >= WINDOW[0]) & (x <= WINDOW[2]) & (y >= WINDOW[1]) & (y <= WINDOW[3])
    expected = np.sort(cloud.points[inside].array[["X", "Y", "Z", "gps_time"]])
    result = laspy.read(out)
    assert num_points == inside.sum() > 1000
    np.testing.assert_array_equal(np.sort(result.points.array[["X", "Y", "Z", "gps_time"]]), expected)
    assert result.header.parse_crs().to_epsg() == 2154
    assert len(httpserver.log) < 10


@needs_copc
def test_refusals_and_truncated_responses_are_retried(httpserver: HTTPServer, tmp_path: Path) -> None:
    faults = {
        1: lambda response: Response(status=429, headers={"Retry-After": "5"}),
        3: lambda response: Response(status=500),
    }

    def mend(response: Response) -> Response:
        answer = Response(response.get_data()[:-7], status=206)
        answer.headers["Content-Range"] = response.headers["Content-Range"]
        return answer

    faults[4] = mend
    httpserver.expect_request("/t.copc.laz").respond_with_handler(serve(COPC.read_bytes(), faults))
    url = httpserver.url_for("/t.copc.laz")
    assert write_window(client(), url, WINDOW, tmp_path / "w.laz", "EPSG:2154") > 1000


def test_a_service_without_ranges(httpserver: HTTPServer, tmp_path: Path) -> None:
    httpserver.expect_request("/t").respond_with_data(b"LASF and all the rest")
    with pytest.raises(RangesUnsupportedError, match="does not support Range requests"):
        write_window(client(), httpserver.url_for("/t"), WINDOW, tmp_path / "w.laz", "EPSG:2154")
    assert len(httpserver.log) == 1 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("body", [b"<html>Moved</html>" * 50, b"LASF" + bytes(400)])
def test_not_copc(httpserver: HTTPServer, tmp_path: Path, body: bytes) -> None:
    httpserver.expect_request("/t").respond_with_handler(serve(body))
    with pytest.raises(InputError, match="/t: not a readable COPC file"):
        write_window(client(), httpserver.url_for("/t"), WINDOW, tmp_path / "w.laz", "EPSG:2154")
    assert list(tmp_path.iterdir()) == []


# --- as a source ---


@pytest.fixture
def source(httpserver: HTTPServer, tmp_path: Path) -> GeoplateformeSource:
    """An index with one tile: a real COPC file, 50 m wide."""
    ring = [[770500, 6277500], [770550, 6277500], [770550, 6277550], [770500, 6277550], [770500, 6277500]]
    feature = {
        "type": "Feature",
        "id": "1",
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "properties": {"url_npl": httpserver.url_for("/t.copc.laz")},
    }
    index = {"features": [feature], "numberMatched": 1}
    httpserver.expect_request("/wfs/ows").respond_with_data(json.dumps(index))
    config = Geoplateforme(wfs_url=httpserver.url_for("/wfs/ows"), requests_per_s=1e6)
    return GeoplateformeSource(
        config, "EPSG:2154", tmp_path / "downloads", client=Client(config, sleep=lambda seconds: None)
    )


@needs_copc
def test_a_small_share_of_a_tile_is_read_as_a_window(source, httpserver) -> None:
    httpserver.expect_request("/t.copc.laz").respond_with_handler(serve(COPC.read_bytes()))
    (path,) = source.lidar(WINDOW)
    cloud = laspy.read(path)
    assert 1000 < len(cloud) < 20_000 and cloud.x.max() <= WINDOW[2]
    requests = len(httpserver.log)
    assert source.lidar(WINDOW) == [path] and len(httpserver.log) == requests


@needs_copc
def test_a_tile_that_is_mostly_needed_is_downloaded(source, httpserver) -> None:
    httpserver.expect_request("/t.copc.laz").respond_with_data(COPC.read_bytes())
    (path,) = source.lidar((770500.0, 6277500.0, 770550.0, 6277550.0))
    assert path.name == "t.copc.laz" and path.read_bytes()[: -len(integrity.TRAILER)] == COPC.read_bytes()
    assert len(httpserver.log) == 2


@needs_copc
def test_a_service_without_ranges_sends_the_whole_tile(source, httpserver) -> None:
    httpserver.expect_request("/t.copc.laz").respond_with_data(COPC.read_bytes())
    (path,) = source.lidar(WINDOW)
    assert path.name == "t.copc.laz" and path.read_bytes()[: -len(integrity.TRAILER)] == COPC.read_bytes()
    assert len(httpserver.log) == 3
