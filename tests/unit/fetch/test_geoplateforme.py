"""The source ``geoplateforme``, against a local server that pages, truncates and fails like the real one."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from places import SHARED
from pytest_httpserver import HTTPServer
from rasterio.io import MemoryFile
from rasterio.transform import from_origin
from werkzeug import Request, Response

from p2wss.config import Geoplateforme
from p2wss.errors import InputError
from p2wss.fetch import normalise
from p2wss.fetch.geoplateforme import GeoplateformeSource
from p2wss.fetch.http import Client

BOUNDS = (652000.0, 6861000.0, 653000.0, 6862000.0)
REAL_FEATURE = SHARED / "data" / "geoplateforme" / "batiment_one_feature.json"


@pytest.fixture
def source(httpserver: HTTPServer, tmp_path: Path) -> Any:
    """Creates sources that use the local server and share one folder of downloads."""

    def make(offline: bool = False, crs: str = "EPSG:2154", **settings: Any) -> GeoplateformeSource:
        config = Geoplateforme(
            wfs_url=httpserver.url_for("/wfs/ows"),
            wms_url=httpserver.url_for("/wms-r"),
            requests_per_s=1e6,
            **settings,
        )
        client = Client(config, sleep=lambda seconds: None)
        return GeoplateformeSource(config, crs, tmp_path / "downloads", offline, client)

    return make


def building(number: int) -> dict[str, Any]:
    x, y = 652000 + 10 * number, 6861500
    ring = [[x, y, 50.0], [x + 8, y, 50.0], [x + 8, y + 8, 50.0], [x, y + 8, 50.0], [x, y, 50.0]]
    return {
        "type": "Feature",
        "id": f"batiment.{number}",
        "geometry": {"type": "MultiPolygon", "coordinates": [[ring]]},
        "properties": {"cleabs": f"BATIMENT{number:04d}", "hauteur": 5.5, "nature": "Silo", "usage_1": None},
    }


def serve_features(features: list[dict[str, Any]], cap: int = 5000, matched: Any = None) -> Any:
    """A WFS that silently returns at most ``cap`` features."""

    def handler(request: Request) -> Response:
        start, count = int(request.args["STARTINDEX"]), int(request.args["COUNT"])
        page = features[start : start + min(count, cap)]
        total = len(features) if matched is None else matched(start)
        body = {
            "type": "FeatureCollection",
            "features": page,
            "numberMatched": total,
            "numberReturned": len(page),
        }
        return Response(json.dumps(body), content_type="application/json")

    return handler


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
    assert row.nature == "Indifférenciée"
    assert not row.geometry.has_z


def heights(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (0.01 * (x - 652000) + 0.002 * (y - 6861000)).astype(np.float32)


def geotiff(values: np.ndarray, west: float, north: float, cell: float, dtype: str = "float32") -> bytes:
    with MemoryFile() as file:
        with file.open(
            driver="GTiff",
            width=values.shape[1],
            height=values.shape[0],
            count=1,
            dtype=dtype,
            crs="EPSG:2154",
            transform=from_origin(west, north, cell, cell),
        ) as raster:
            raster.write(values.astype(dtype), 1)
        return file.read()


def serve_terrain(request: Request) -> Response:
    west, south, east, north = (float(part) for part in request.args["BBOX"].split(","))
    columns, rows = int(request.args["WIDTH"]), int(request.args["HEIGHT"])
    cell = (east - west) / columns
    assert cell == pytest.approx((north - south) / rows)
    x, y = np.meshgrid(west + cell * (np.arange(columns) + 0.5), north - cell * (np.arange(rows) + 0.5))
    values = heights(x, y)
    values[(x > 652990) & (y > 6861990)] = -99999
    if request.args["FORMAT"] == "image/geotiff":
        return Response(geotiff(values, west, north, cell), content_type="image/geotiff")
    return Response(values.astype("<f4").tobytes(), content_type="image/x-bil;bits=32")


@pytest.mark.parametrize("image_format", ["image/geotiff", "image/x-bil;bits=32"])
@pytest.mark.parametrize(("cell", "max_pixels"), [(1.0, 4000), (0.5, 4000), (5.0, 64)])
def test_terrain_is_centred_on_multiples(
    source: Any, httpserver: HTTPServer, image_format: Any, cell: float, max_pixels: int
) -> None:
    httpserver.expect_request("/wms-r").respond_with_handler(serve_terrain)
    service = source(dtm_format=image_format, dtm_resolution_m=cell, dtm_max_pixels=max_pixels)
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


def test_bil_of_the_wrong_length_is_quoted(source: Any, httpserver: HTTPServer) -> None:
    httpserver.expect_request("/wms-r").respond_with_data(b"<ServiceException>busy</ServiceException>")
    with pytest.raises(InputError, match=r"of 21 x 21 heights, got 41 bytes: .*busy"):
        source(dtm_format="image/x-bil;bits=32").dtm((652000.0, 6861000.0, 652020.0, 6861020.0))


def tile_feature(x: int, y: int, **properties: Any) -> dict[str, Any]:
    west, north = 1000 * x, 1000 * y
    ring = [
        [west, north - 1000],
        [west + 1000, north - 1000],
        [west + 1000, north],
        [west, north],
        [west, north - 1000],
    ]
    return {
        "type": "Feature",
        "id": f"{x}_{y}",
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "properties": properties,
    }


def laz(tmp_path: Path, num_points: int = 5) -> bytes:
    """A small, complete cloud within ``BOUNDS``."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [652000, 6861000, 0]
    cloud = laspy.LasData(header)
    cloud.x = 652000 + np.arange(num_points)
    cloud.y = 6861000 + np.arange(num_points)
    cloud.z = np.zeros(num_points)
    cloud.write(tmp_path / "cloud.laz")
    return (tmp_path / "cloud.laz").read_bytes()


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
    assert [path.read_bytes() for path in paths] == [body]
    requests = len(httpserver.log)
    assert requests == 3
    assert source().lidar(BOUNDS) == paths
    assert len(httpserver.log) == requests, "a tile that is there is not downloaded again, nor its index"
    record = json.loads(Path(f"{paths[0]}.json").read_text())
    assert record["request"] == {"url": f"{base}0652-6862_PTS_LAMB93_IGN69.copc.laz"}
    assert record["num_bytes"] == len(body) and record["sha256"] == hashlib.sha256(body).hexdigest()


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
    with pytest.raises(InputError, match=r"no LiDAR HD in 652000.*METADONNEE:metadata has no tile there"):
        source().lidar(BOUNDS)
    assert list(tmp_path.rglob("*.laz")) == []


def test_addresses_on_the_host_of_the_service_use_its_scheme(tmp_path: Path) -> None:
    service = GeoplateformeSource(Geoplateforme(), "EPSG:2154", tmp_path)
    assert service._with_service_scheme("http://data.geopf.fr/a.laz") == "https://data.geopf.fr/a.laz"
    assert service._with_service_scheme("http://elsewhere.example/a.laz") == "http://elsewhere.example/a.laz"


# --- what is kept ---


def test_a_rerun_sends_no_request(source: Any, httpserver: HTTPServer) -> None:
    httpserver.expect_request("/wfs/ows").respond_with_handler(
        serve_features([building(i) for i in range(9)])
    )
    httpserver.expect_request("/wms-r").respond_with_handler(serve_terrain)
    first = source(page_size=4).footprints(BOUNDS), source(dtm_max_pixels=400).dtm(BOUNDS)
    assert len(httpserver.log) == 3 + 9
    again = source(page_size=4, offline=True), source(dtm_max_pixels=400, offline=True)
    assert again[0].footprints(BOUNDS).equals(first[0])
    np.testing.assert_array_equal(again[1].dtm(BOUNDS).height_m, first[1].height_m)
    assert len(httpserver.log) == 3 + 9


def test_records_hold_the_request(source: Any, httpserver: HTTPServer, tmp_path: Path) -> None:
    httpserver.expect_request("/wms-r").respond_with_handler(serve_terrain)
    source().dtm((652000.0, 6861000.0, 652020.0, 6861020.0))
    (path,) = (tmp_path / "downloads" / "terrain").glob("*.tif")
    record = json.loads(Path(f"{path}.json").read_text())
    assert record["request"]["BBOX"] == "651999.500,6860999.500,652020.500,6861020.500"
    assert record["request"]["LAYERS"] == "ELEVATION.ELEVATIONGRIDCOVERAGE.HIGHRES"
    assert record["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert record["retrieved"].startswith("20")


@pytest.mark.parametrize("damage", ["cut", "changed", "no record", "other request"])
def test_a_damaged_response_is_requested_again(
    source: Any, httpserver: HTTPServer, tmp_path: Path, damage: str
) -> None:
    httpserver.expect_request("/wms-r").respond_with_handler(serve_terrain)
    window = (652000.0, 6861000.0, 652020.0, 6861020.0)
    expected = source().dtm(window).height_m
    (path,) = (tmp_path / "downloads" / "terrain").glob("*.tif")
    body, record = path.read_bytes(), Path(f"{path}.json")
    if damage == "cut":
        path.write_bytes(body[:-10])
    elif damage == "changed":
        path.write_bytes(body[:-10] + bytes(10))
    elif damage == "no record":
        record.unlink()
    else:
        record.write_text(record.read_text().replace("HIGHRES", "LOWRES"))
    np.testing.assert_array_equal(source().dtm(window).height_m, expected)
    assert len(httpserver.log) == 2 and path.read_bytes() == body and record.exists()


def test_offline_lists_what_is_missing(source: Any, httpserver: HTTPServer) -> None:
    service = source(offline=True)
    with pytest.raises(
        InputError, match=r"footprints in 652000\.\.653000, .* missing; fetch\.offline is set"
    ):
        service.footprints(BOUNDS)
    with pytest.raises(InputError, match=r"terrain in 651999\.500,.* missing; fetch\.offline is set"):
        service.dtm(BOUNDS)
    with pytest.raises(InputError, match=r"METADONNEE:metadata is not in .*fetch\.offline is set"):
        service.lidar(BOUNDS)
    assert len(httpserver.log) == 0


def test_offline_names_a_missing_tile_of_the_index(
    source: Any, httpserver: HTTPServer, tmp_path: Path
) -> None:
    url = httpserver.url_for("/t.laz")
    httpserver.expect_request("/wfs/ows").respond_with_handler(
        serve_features([tile_feature(652, 6862, url_npl=url)])
    )
    httpserver.expect_request("/t.laz").respond_with_data(laz(tmp_path))
    (path,) = source().lidar(BOUNDS)
    assert source(offline=True).has_lidar(BOUNDS)
    path.unlink()
    assert not source(offline=True).has_lidar(BOUNDS)
    with pytest.raises(InputError, match=rf"{url} missing; fetch.offline is set"):
        source(offline=True).lidar(BOUNDS)
    assert len(httpserver.log) == 2


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


# --- more faults ---


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
    assert [path.read_bytes() for path in source().lidar(BOUNDS)] == [whole]
    assert len(httpserver.log) == 3


@pytest.mark.parametrize("status", [404, 410])
def test_an_expired_address_of_a_stored_index(
    source: Any, httpserver: HTTPServer, tmp_path: Path, status: int
) -> None:
    """The stored index has an address that no longer exists: the index is requested again, once."""
    old, new = httpserver.url_for("/old.laz"), httpserver.url_for("/new.laz")
    urls = iter([old, new])

    def index(request: Request) -> Response:
        return serve_features([tile_feature(652, 6862, url_npl=next(urls))])(request)

    httpserver.expect_request("/wfs/ows").respond_with_handler(index)
    httpserver.expect_request("/old.laz").respond_with_data("gone", status=status)
    httpserver.expect_request("/new.laz").respond_with_data(laz(tmp_path))
    service = source(lidar_types=["IGNF_LIDAR-HD_METADONNEE:metadata"])
    with pytest.raises(InputError, match=rf"lists an address that does not exist: .*HTTP {status}"):
        service.lidar(BOUNDS)
    assert len(httpserver.log) == 2
    assert [path.name for path in service.lidar(BOUNDS)] == ["new.laz"]
    assert [request.path for request, _ in httpserver.log[2:]] == ["/old.laz", "/wfs/ows", "/new.laz"]


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
