"""What a local server answers in place of IGN's: features in pages, terrain from a formula, an index of LiDAR tiles."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import geopandas as gpd
import laspy
import numpy as np
import pytest
from places import ROOT
from pytest_httpserver import HTTPServer
from rasterio.io import MemoryFile
from rasterio.transform import from_origin
from werkzeug import Request, Response

from p2wss.config import Folder
from p2wss.fetching.folder import FolderSource

MINI = ROOT / "tests" / "mini"
BOUNDS = (652000.0, 6861000.0, 653000.0, 6862000.0)


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


def centres(request: Request) -> tuple[np.ndarray, np.ndarray, float]:
    """x and y of the cells that a GetMap request asks for, and their size."""
    west, south, east, north = (float(part) for part in request.args["BBOX"].split(","))
    columns, rows = int(request.args["WIDTH"]), int(request.args["HEIGHT"])
    cell = (east - west) / columns
    assert cell == pytest.approx((north - south) / rows)
    x, y = np.meshgrid(west + cell * (np.arange(columns) + 0.5), north - cell * (np.arange(rows) + 0.5))
    return x, y, cell


def serve_terrain(request: Request) -> Response:
    x, y, cell = centres(request)
    values = heights(x, y)
    values[(x > 652990) & (y > 6861990)] = -99999
    return Response(
        geotiff(values, x[0, 0] - cell / 2, y[0, 0] + cell / 2, cell), content_type="image/geotiff"
    )


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


def serve_miniature(server: HTTPServer, has_lidar: Callable[[], bool] = lambda: True) -> dict[str, Any]:
    """Serve the files of the miniature as IGN serves its own. Returns the section ``fetch`` that asks for them."""
    lidar = next((MINI / "lidar").glob("*.laz"))
    frame = gpd.read_file(MINI / "bdtopo" / "BDTOPO_mini.gpkg", layer="batiment")
    frame.insert(0, "cleabs", frame.pop("cleabs"))
    source = FolderSource(Folder(dtm=str(MINI / "rgealti")), "EPSG:2154")

    def features(request: Request) -> Response:
        if "batiment" not in request.args["TYPENAMES"]:
            tile = tile_feature(653, 6861, url_npl=server.url_for(f"/{lidar.name}"))
            return serve_features([tile])(request)
        west, south, east, north = map(float, request.args["BBOX"].split(",")[:4])
        found = frame.cx[west:east, south:north].sort_values("cleabs")
        return serve_features(json.loads(found.to_json())["features"])(request)

    terrain_m = source.dtm((652000, 6860000, 654000, 6862000))

    def terrain(request: Request) -> Response:
        x, y, cell = centres(request)
        heights_m = terrain_m.interpolated(x.ravel(), y.ravel()).reshape(x.shape)
        heights_m[np.isnan(heights_m)] = -99999
        return Response(
            geotiff(heights_m, x[0, 0] - cell / 2, y[0, 0] + cell / 2, cell), content_type="image/geotiff"
        )

    def cloud(request: Request) -> Response:
        return Response(lidar.read_bytes()) if has_lidar() else Response("gone", status=403)

    server.expect_request("/wfs/ows").respond_with_handler(features)
    server.expect_request("/wms-r").respond_with_handler(terrain)
    server.expect_request(f"/{lidar.name}").respond_with_handler(cloud)
    urls = {"wfs_url": server.url_for("/wfs/ows"), "wms_url": server.url_for("/wms-r")}
    return {"geoplateforme": {**urls, "requests_per_s": 1e6, "max_attempts": 1}}
