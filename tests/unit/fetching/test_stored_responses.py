"""What is kept of the responses of the Géoplateforme, what is requested again, and what must not be kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_httpserver import HTTPServer
from werkzeug import Request, Response

from p2wss.fetching.bdtopo import normalise
from p2wss.storage import integrity
from p2wss.storage.messages import InputError

from .service import BOUNDS, building, laz, serve_features, serve_terrain, tile_feature


def test_a_rerun_sends_no_request(source: Any, httpserver: HTTPServer) -> None:
    httpserver.expect_request("/wfs/ows").respond_with_handler(
        serve_features([building(i) for i in range(9)])
    )
    httpserver.expect_request("/wms-r").respond_with_handler(serve_terrain)
    first = source(page_size=4).footprints(BOUNDS), source(dtm_max_pixels=400).dtm(BOUNDS)
    assert len(httpserver.log) == 3 + 9
    again = source(page_size=4), source(dtm_max_pixels=400)
    assert again[0].footprints(BOUNDS).equals(first[0])
    np.testing.assert_array_equal(again[1].dtm(BOUNDS).height_m, first[1].height_m)
    assert len(httpserver.log) == 3 + 9


@pytest.mark.parametrize("damage", ["cut", "changed"])
def test_a_damaged_response_is_requested_again(
    source: Any, httpserver: HTTPServer, tmp_path: Path, damage: str
) -> None:
    httpserver.expect_request("/wms-r").respond_with_handler(serve_terrain)
    window = (652000.0, 6861000.0, 652020.0, 6861020.0)
    expected = source().dtm(window).height_m
    (path,) = (tmp_path / "downloads" / "terrain").glob("*.tif")
    body = path.read_bytes()
    if damage == "cut":
        path.write_bytes(body[:-10])
    else:
        path.write_bytes(bytes(10) + body[10:])
    np.testing.assert_array_equal(source().dtm(window).height_m, expected)
    assert len(httpserver.log) == 2 and path.read_bytes() == body


def test_footprints_in_windows(source: Any, httpserver: HTTPServer) -> None:
    """A server that responds per window: a building on an edge is in two responses and is returned once."""
    features = [building(i) for i in range(80)]

    def handler(request: Request) -> Response:
        x_min, _, x_max, _ = (float(value) for value in request.args["BBOX"].split(",")[:4])
        inside = [
            f for f in features if x_min <= f["geometry"]["coordinates"][0][0][2][0] and
            f["geometry"]["coordinates"][0][0][0][0] <= x_max
        ]  # fmt: skip
        return serve_features(inside)(request)

    httpserver.expect_request("/wfs/ows").respond_with_handler(handler)
    bounds = (652000.0, 6861000.0, 652800.0, 6861400.0)
    footprints = source(footprints_window_m=400).footprints(bounds)
    assert len(httpserver.log) == 2 and len(footprints) > 80
    assert len(normalise(footprints, "EPSG:2154", "wfs")) == 80


def test_a_wrong_content_type_is_an_error(source: Any, httpserver: HTTPServer) -> None:
    """Only the content counts: valid features pass with a wrong content type, a web page with the right one fails."""
    body = json.dumps({"features": [building(1)], "numberMatched": 1})
    httpserver.expect_ordered_request("/wfs/ows").respond_with_data(body, content_type="text/html")
    httpserver.expect_ordered_request("/wfs/ows").respond_with_data("<html>", content_type="application/json")
    assert len(source().footprints(BOUNDS)) == 1
    with pytest.raises(InputError, match='expected GeoJSON features, got "<html>"'):
        source().footprints((0.0, 0.0, 1.0, 1.0))
    assert len(httpserver.log) == 2


def test_truncated_features_with_a_correct_length(
    source: Any, httpserver: HTTPServer, tmp_path: Path
) -> None:
    body = json.dumps({"features": [building(1)], "numberMatched": 1})[:-40]
    httpserver.expect_request("/wfs/ows").respond_with_data(body, content_type="application/json")
    with pytest.raises(InputError, match="expected GeoJSON features, got"):
        source().footprints(BOUNDS)
    assert len(httpserver.log) == 1 and not (tmp_path / "downloads").exists()


def test_a_truncated_tile_with_a_correct_length_is_not_stored(
    source: Any, httpserver: HTTPServer, tmp_path: Path
) -> None:
    whole = laz(tmp_path, 5000)
    httpserver.expect_request("/wfs/ows").respond_with_handler(
        serve_features([tile_feature(652, 6862, url_npl=httpserver.url_for("/t.laz"))])
    )
    answers = iter([whole[: len(whole) // 2], whole])
    httpserver.expect_request("/t.laz").respond_with_handler(lambda request: Response(next(answers)))
    with pytest.raises(InputError, match=r"t\.laz: .*truncated"):
        source().lidar(BOUNDS)
    assert list((tmp_path / "downloads" / "lidar").iterdir()) == []
    contents = [path.read_bytes()[: -len(integrity.TRAILER)] for path in source().lidar(BOUNDS)]
    assert contents == [whole]
    assert len(httpserver.log) == 3


@pytest.mark.parametrize("status", [404, 410])
def test_an_expired_address_of_a_stored_index(
    source: Any, httpserver: HTTPServer, tmp_path: Path, status: int
) -> None:
    """The stored index has an address that no longer exists: the next run requests the index again."""
    old, new = httpserver.url_for("/old.laz"), httpserver.url_for("/new.laz")
    urls = iter([old, new])

    def index(request: Request) -> Response:
        return serve_features([tile_feature(652, 6862, url_npl=next(urls))])(request)

    httpserver.expect_request("/wfs/ows").respond_with_handler(index)
    httpserver.expect_request("/old.laz").respond_with_data("gone", status=status)
    httpserver.expect_request("/new.laz").respond_with_data(laz(tmp_path))
    service = source(lidar_types=["IGNF_LIDAR-HD_METADONNEE:metadata"])
    with pytest.raises(InputError, match=rf"METADONNEE:metadata: .*old\.laz: HTTP {status}"):
        service.lidar(BOUNDS)
    assert len(httpserver.log) == 2
    assert [path.name for path in service.lidar(BOUNDS)] == ["new.laz"]
    assert [request.path for request, _ in httpserver.log[2:]] == ["/wfs/ows", "/new.laz"]


def test_an_expired_address_falls_back_to_the_next_index(
    source: Any, httpserver: HTTPServer, tmp_path: Path
) -> None:
    def handler(request: Request) -> Response:
        name = "old" if request.args["TYPENAMES"].startswith("IGNF_LIDAR-HD_METADONNEE") else "good"
        return serve_features([tile_feature(652, 6862, url=httpserver.url_for(f"/{name}.laz"))])(request)

    httpserver.expect_request("/wfs/ows").respond_with_handler(handler)
    httpserver.expect_request("/old.laz").respond_with_data("gone", status=404)
    httpserver.expect_request("/good.laz").respond_with_data(laz(tmp_path))
    assert [path.name for path in source().lidar(BOUNDS)] == ["good.laz"]
    assert len(httpserver.log) == 4
