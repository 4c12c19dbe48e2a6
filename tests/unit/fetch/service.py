"""What a local server answers in place of IGN's: features in pages, terrain from a formula, an index of LiDAR tiles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from rasterio.io import MemoryFile
from rasterio.transform import from_origin
from werkzeug import Request, Response

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


def serve_terrain(request: Request) -> Response:
    west, south, east, north = (float(part) for part in request.args["BBOX"].split(","))
    columns, rows = int(request.args["WIDTH"]), int(request.args["HEIGHT"])
    cell = (east - west) / columns
    assert cell == pytest.approx((north - south) / rows)
    x, y = np.meshgrid(west + cell * (np.arange(columns) + 0.5), north - cell * (np.arange(rows) + 0.5))
    values = heights(x, y)
    values[(x > 652990) & (y > 6861990)] = -99999
    return Response(geotiff(values, west, north, cell), content_type="image/geotiff")


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
