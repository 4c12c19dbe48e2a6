"""The source ``geoplateforme``, against a local server that pages, truncates and fails like the real one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from places import SHARED
from pytest_httpserver import HTTPServer
from werkzeug import Request, Response

from p2wss.config import Geoplateforme
from p2wss.fetching.bdtopo import normalise
from p2wss.fetching.geoplateforme import GeoplateformeSource
from p2wss.storage import integrity
from p2wss.storage.messages import InputError

from .service import BOUNDS, building, geotiff, heights, laz, serve_features, serve_terrain, tile_feature

REAL_FEATURE = SHARED / "data" / "geoplateforme" / "batiment_one_feature.json"


def test_pages_are_requested_until_complete(source: Any, httpserver: HTTPServer) -> None:
    httpserver.expect_request("/wfs/ows").respond_with_handler(
        serve_features([building(i) for i in range(25)])
    )
    footprints = source(page_size=10).footprints(BOUNDS)
    assert sorted(footprints["cleabs"]) == [f"BATIMENT{i:04d}" for i in range(25)]
    assert footprints.crs == "EPSG:2154"
    queries = [request.args for request, _ in httpserver.log]
    assert [args["STARTINDEX"] for args in queries] == ["0", "10", "20"]
    assert queries[0]["BBOX"] == "652000,6861000,653000,6862000,EPSG:2154"
    assert queries[0]["SORTBY"] == "cleabs"
    assert queries[0]["TYPENAMES"] == "BDTOPO_V3:batiment"
    assert len(normalise(footprints, "EPSG:2154", "wfs")) == 25


def test_places_that_differ_by_a_metre_have_requests_of_their_own(
    source: Any, httpserver: HTTPServer
) -> None:
    httpserver.expect_request("/wfs/ows").respond_with_handler(serve_features([building(0)]))
    fetched = source()
    for south in (6861000.125, 6861001.25):
        fetched.footprints((652000.5, south, 653000.0, 6862000.0))
    boxes = [request.args["BBOX"] for request, _ in httpserver.log]
    assert boxes == [f"652000.5,{south},653000,6862000,EPSG:2154" for south in ("6861000.125", "6861001.25")]


def test_pages_that_the_server_cuts_short(source: Any, httpserver: HTTPServer) -> None:
    handler = serve_features([building(i) for i in range(25)], cap=7)
    httpserver.expect_request("/wfs/ows").respond_with_handler(handler)
    assert len(source(page_size=10).footprints(BOUNDS)) == 25
    assert len(httpserver.log) == 4


def test_number_of_features_that_grows_between_pages(source: Any, httpserver: HTTPServer) -> None:
    features = [building(i) for i in range(12)]
    handler = serve_features(features, matched=lambda start: 10 if start == 0 else 12)
    httpserver.expect_request("/wfs/ows").respond_with_handler(handler)
    assert len(source(page_size=8).footprints(BOUNDS)) == 12
    assert len(httpserver.log) == 2


def test_a_page_that_repeats_features_is_an_error(source: Any, httpserver: HTTPServer) -> None:
    features = [building(i) for i in [0, 1, 2, 3, 2, 3]]
    httpserver.expect_request("/wfs/ows").respond_with_handler(serve_features(features))
    with pytest.raises(InputError, match="pages overlap, and only 4 of 6 features differ"):
        source(page_size=4).footprints(BOUNDS)
    assert len(httpserver.log) == 2


def test_empty_pages_before_the_end_are_an_error(source: Any, httpserver: HTTPServer) -> None:
    handler = serve_features([building(i) for i in range(4)], matched=lambda start: 9)
    httpserver.expect_request("/wfs/ows").respond_with_handler(handler)
    with pytest.raises(InputError, match="4 of 9 features, then empty pages"):
        source(page_size=4).footprints(BOUNDS)
    assert len(httpserver.log) == 4


def test_an_exception_with_status_200_is_quoted(source: Any, httpserver: HTTPServer) -> None:
    text = "<ows:ExceptionReport><ows:ExceptionText>Feature type unknown</ows:ExceptionText>"
    httpserver.expect_request("/wfs/ows").respond_with_data(text, content_type="application/xml")
    with pytest.raises(InputError, match=r"expected GeoJSON features, got .*Feature type unknown"):
        source().footprints(BOUNDS)
    assert len(httpserver.log) == 1


def test_no_building_in_the_bounds(source: Any, httpserver: HTTPServer) -> None:
    httpserver.expect_request("/wfs/ows").respond_with_handler(serve_features([]))
    with pytest.raises(InputError, match=r"no building in 652000\.\.653000, 6861000\.\.6862000"):
        source().footprints(BOUNDS)


@pytest.mark.skipif(not REAL_FEATURE.exists(), reason="no shared/data/geoplateforme")
def test_a_feature_of_the_real_service(source: Any, httpserver: HTTPServer) -> None:
    features = json.loads(REAL_FEATURE.read_text())["features"]
    httpserver.expect_request("/wfs/ows").respond_with_handler(serve_features(features))
    footprints = source(crs="EPSG:4326").footprints((4.8, 45.7, 4.9, 45.8))
    row = normalise(footprints, "EPSG:4326", "wfs").iloc[0]
    assert (row.building_id, row.hauteur_m, row.num_floors) == ("BATIMENT0000000240879442", 25.6, 6)
    assert (row.altitude_minimale_sol_m, row.altitude_minimale_toit_m) == (213.1, 238.6)
    assert (row.materiaux_des_murs, row.materiaux_de_la_toiture) == ("20", "10")
    assert row.nature == "Indifférenciée"
    assert not row.geometry.has_z


@pytest.mark.parametrize(("cell", "max_pixels"), [(1.0, 4000), (0.5, 4000), (5.0, 64)])
def test_terrain_is_centred_on_multiples(
    source: Any, httpserver: HTTPServer, cell: float, max_pixels: int
) -> None:
    httpserver.expect_request("/wms-r").respond_with_handler(serve_terrain)
    service = source(dtm_resolution_m=cell, dtm_max_pixels=max_pixels)
    terrain = service.dtm((652000.0, 6861600.0, 653000.0, 6862000.0))
    rows, columns = terrain.height_m.shape
    assert (columns, rows) == (1000 / cell + 1, 400 / cell + 1)
    x = terrain.x_min_m + cell * (np.arange(columns) + 0.5)
    y = terrain.y_max_m - cell * (np.arange(rows) + 0.5)
    assert x[0] == 652000 and x[-1] == 653000 and y[0] == 6862000 and y[-1] == 6861600
    expected = heights(*np.meshgrid(x, y))
    missing = (x > 652990)[None] & (y > 6861990)[:, None]
    np.testing.assert_array_equal(np.isnan(terrain.height_m), missing)
    np.testing.assert_allclose(terrain.height_m[~missing], expected[~missing], atol=1e-4)
    assert len(httpserver.log) == -(-columns // max_pixels) * -(-rows // max_pixels)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"<ServiceException>Layer not defined</ServiceException>", "Layer not defined"),
        (geotiff(np.zeros((21, 21)), 0, 0, 1, "uint8"), "got uint8; is the layer an image"),
        (geotiff(np.zeros((20, 21)), 0, 0, 1), "requested 21 x 21 heights, got 21 x 20"),
        (geotiff(np.random.default_rng(0).random((21, 21)), 0, 0, 1)[:900], "truncated"),
        (b"", "got nothing"),
    ],
)
def test_invalid_terrain_responses(source: Any, httpserver: HTTPServer, body: bytes, message: str) -> None:
    httpserver.expect_request("/wms-r").respond_with_data(body, content_type="image/geotiff")
    with pytest.raises(InputError, match=message):
        source().dtm((652000.0, 6861000.0, 652020.0, 6861020.0))
    assert len(httpserver.log) == 1


def test_lidar_tile_from_the_index(source: Any, httpserver: HTTPServer, tmp_path: Path) -> None:
    """A neighbour that only shares an edge is not read; a dash in the name is corrected after a 404."""
    base = httpserver.url_for("/download/LHD_FXX_")
    features = [
        tile_feature(652, 6862, url_npl=f"{base}0652-6862_PTS_LAMB93_IGN69.copc.laz", url_mnt="other"),
        tile_feature(653, 6862, url_npl=f"{base}0653_6862_PTS_LAMB93_IGN69.copc.laz"),
    ]
    httpserver.expect_request("/wfs/ows").respond_with_handler(serve_features(features))
    body = laz(tmp_path)
    httpserver.expect_request("/download/LHD_FXX_0652_6862_PTS_LAMB93_IGN69.copc.laz").respond_with_data(body)
    httpserver.expect_request("/download/LHD_FXX_0652-6862_PTS_LAMB93_IGN69.copc.laz").respond_with_data(
        status=404
    )
    service = source()
    paths = service.lidar(BOUNDS)
    assert [path.read_bytes()[: -len(integrity.TRAILER)] for path in paths] == [body]
    assert all(integrity.is_intact(path) for path in paths)
    requests = len(httpserver.log)
    assert requests == 3
    assert source().lidar(BOUNDS) == paths
    assert len(httpserver.log) == requests, "a tile that is there is not downloaded again, nor its index"


def test_tiles_of_the_same_name_in_two_folders_are_two(
    source: Any, httpserver: HTTPServer, tmp_path: Path
) -> None:
    features = [
        tile_feature(652, 6862, url=httpserver.url_for(f"/{folder}/t.laz")) | {"id": folder}
        for folder in "ab"
    ]
    listed = features[1:]
    httpserver.expect_request("/wfs/ows").respond_with_handler(
        lambda request: serve_features(listed)(request)
    )
    for num_points, folder in enumerate("ab", 5):
        httpserver.expect_request(f"/{folder}/t.laz").respond_with_data(laz(tmp_path, num_points))
    # the index lists the second alone at first
    assert [path.name for path in source().lidar(BOUNDS)] == ["t.laz"]
    shutil.rmtree(tmp_path / "downloads" / "features")
    listed[:] = features
    paths = source().lidar(BOUNDS)
    assert [len(laspy.read(path)) for path in paths] == [5, 6]
    requests = len(httpserver.log)
    assert source().lidar(BOUNDS) == paths and len(httpserver.log) == requests


def test_the_older_index_is_used_if_the_current_one_is_gone(
    source: Any, httpserver: HTTPServer, tmp_path: Path
) -> None:
    def handler(request: Request) -> Response:
        if request.args["TYPENAMES"].startswith("IGNF_LIDAR-HD_METADONNEE"):
            return Response("<ExceptionText>unknown type</ExceptionText>", status=400)
        return serve_features([tile_feature(652, 6862, url=httpserver.url_for("/t.laz"))])(request)

    httpserver.expect_request("/wfs/ows").respond_with_handler(handler)
    httpserver.expect_request("/t.laz").respond_with_data(laz(tmp_path))
    assert [path.name for path in source().lidar(BOUNDS)] == ["t.laz"]


def test_a_place_without_lidar(source: Any, httpserver: HTTPServer, tmp_path: Path) -> None:
    httpserver.expect_request("/wfs/ows").respond_with_handler(serve_features([]))
    with pytest.raises(InputError, match=r"no LiDAR HD in 652000.*METADONNEE:metadata: has no tile there"):
        source().lidar(BOUNDS)
    assert list(tmp_path.rglob("*.laz")) == []


def test_addresses_on_the_host_of_the_service_use_its_scheme(tmp_path: Path) -> None:
    service = GeoplateformeSource(Geoplateforme(), "EPSG:2154", tmp_path)
    assert service._with_service_scheme("http://data.geopf.fr/a.laz") == "https://data.geopf.fr/a.laz"
    assert service._with_service_scheme("http://elsewhere.example/a.laz") == "http://elsewhere.example/a.laz"
