"""IGN's Geoplateforme: footprints by WFS, terrain by WMS-Raster, LiDAR HD tiles by their index.

Services and limits: https://cartes.gouv.fr (documentation of the Geoplateforme). All names are in the config,
because they change.
"""

from __future__ import annotations

import json
import logging
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import geopandas as gpd
import numpy as np
import rasterio
import shapely
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile

from p2wss.config import Geoplateforme
from p2wss.errors import InputError
from p2wss.fetch.http import Client, quote
from p2wss.terrain import Terrain
from p2wss.tiling import Bounds

log = logging.getLogger(__name__)
_ATTEMPTS_AT_EMPTY_PAGE = 3
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


class GeoplateformeSource:
    """See :class:`p2wss.fetch.Source`."""

    def __init__(self, config: Geoplateforme, crs: str, client: Client | None = None) -> None:
        self.config = config
        self.crs = crs
        self.name = f"{config.wfs_url} {config.footprints_type}"
        self.client = client or Client(config)

    def footprints(self, bounds: Bounds) -> gpd.GeoDataFrame:
        config = self.config
        features = self._features(config.footprints_type, bounds, config.footprints_id)
        if not features:
            raise InputError(f"{self.name}: no building in {_text(bounds)}")
        return gpd.GeoDataFrame.from_features(features, crs=self.crs)

    def dtm(self, bounds: Bounds) -> Terrain:
        """Cells are centred on multiples of the resolution, as in IGN's files: nothing is resampled."""
        cell, most = self.config.dtm_resolution_m, self.config.dtm_max_pixels
        left, top = np.floor(bounds[0] / cell) - 0.5, np.ceil(bounds[3] / cell) + 0.5
        columns = int(np.ceil(bounds[2] / cell) + 0.5 - left)
        rows = int(top - np.floor(bounds[1] / cell) + 0.5)
        heights = np.empty((rows, columns), np.float32)
        for row in range(0, rows, most):
            for column in range(0, columns, most):
                piece = heights[row : row + most, column : column + most]
                piece[:] = self._heights(left + column, top - row, piece.shape)
        heights[heights <= self.config.dtm_nodata_below_m] = np.nan
        return Terrain(heights, left * cell, top * cell, cell)

    def lidar(self, bounds: Bounds, workspace: Path) -> list[Path]:
        found = []
        for url in self._lidar_urls(bounds):
            path = workspace / Path(urlsplit(url).path).name
            if not path.exists():
                log.info(f"downloading {url}")
                self._download_tile(url, path)
            found.append(path)
        return found

    def _features(self, type_name: str, bounds: Bounds, id_field: str | None) -> list[dict[str, Any]]:
        """All features of a WFS type, page by page until as many came as the service counts, each once.

        The service cuts pages without saying so, hence the next page starts behind what really came.
        """
        found: dict[str, dict[str, Any]] = {}
        start, matched, empty_pages = 0, None, 0
        while matched is None or start < matched:
            page = self._page(type_name, bounds, start, id_field)
            matched = int(page["numberMatched"])
            for feature in page["features"]:
                key = feature.get("properties", {}).get(id_field) if id_field else feature.get("id")
                found[str(key if key is not None else len(found))] = feature
            start += len(page["features"])
            if not page["features"] and start < matched:
                empty_pages += 1
                if empty_pages == _ATTEMPTS_AT_EMPTY_PAGE:
                    raise InputError(
                        f"{self.config.wfs_url} {type_name}: {start} of {matched} features, then empty pages"
                    )
            if matched > self.config.page_size:
                log.info(f"{type_name}: {start} of {matched}")
        if len(found) < (matched or 0):
            raise InputError(
                f"{self.config.wfs_url} {type_name}: {matched} features, but pages repeat themselves and "
                f"only {len(found)} differ; try again, or raise fetch.geoplateforme.page_size"
            )
        return list(found.values())

    def _page(self, type_name: str, bounds: Bounds, start: int, sort_by: str | None) -> dict[str, Any]:
        params = {
            "SERVICE": "WFS",
            "VERSION": "2.0.0",
            "REQUEST": "GetFeature",
            "TYPENAMES": type_name,
            "SRSNAME": self.crs,
            "BBOX": ",".join(
                [*(f"{value:g}" if value % 1 else f"{value:.0f}" for value in bounds), self.crs]
            ),
            "OUTPUTFORMAT": "application/json",
            "COUNT": str(self.config.page_size),
            "STARTINDEX": str(start),
        }
        if sort_by:
            params["SORTBY"] = sort_by
        body = self.client.get(self.config.wfs_url, params)
        try:
            page = json.loads(body)
            if isinstance(page.get("features"), list) and str(page.get("numberMatched")).isdigit():
                return page
        except (ValueError, AttributeError):
            pass
        raise InputError(f"{self.config.wfs_url} {type_name}: expected GeoJSON features, got {quote(body)}")

    def _heights(self, left: float, top: float, shape: tuple[int, int]) -> np.ndarray:
        """One GetMap request; left, top: of the corner, in cells."""
        config, (rows, columns) = self.config, shape
        box = np.array([left, top - rows, left + columns, top]) * config.dtm_resolution_m
        params = {
            "SERVICE": "WMS",
            "VERSION": "1.3.0",
            "REQUEST": "GetMap",
            "LAYERS": config.dtm_layer,
            "STYLES": "",
            "FORMAT": config.dtm_format,
            "CRS": self.crs,
            "BBOX": ",".join(f"{value:.3f}" for value in box),
            "WIDTH": str(columns),
            "HEIGHT": str(rows),
        }
        body = self.client.get(config.wms_url, params)
        name = f"{config.wms_url} {config.dtm_layer}"
        expected = f"{config.dtm_format} of {columns} x {rows} heights"
        if config.dtm_format == "image/geotiff":
            if not body.startswith(_TIFF_MAGIC):
                raise InputError(f"{name}: expected {expected}, got {quote(body)}")
            heights = _from_geotiff(body, name)
        else:
            # little-endian float32, north row first; only its length tells it from text
            if len(body) != 4 * rows * columns:
                raise InputError(f"{name}: expected {expected}, got {len(body)} bytes: {quote(body)}")
            heights = np.frombuffer(body, "<f4").reshape(shape)
        if heights.shape != shape:
            raise InputError(f"{name}: asked for {columns} x {rows} heights, got an array of {heights.shape}")
        return heights

    def _lidar_urls(self, bounds: Bounds) -> list[str]:
        """Addresses of tiles that share more than an edge with ``bounds``, by the first index with some."""
        reasons = []
        for type_name in self.config.lidar_types:
            try:
                features = self._features(type_name, bounds, None)
            except InputError as error:
                reasons.append(str(error))
                continue
            urls = list(self._urls(features, bounds))
            if urls:
                return sorted(set(urls))
            reasons.append(f"{type_name} has no tile there")
        raise InputError(f"no LiDAR HD in {_text(bounds)}: {'; '.join(reasons)}")

    def _urls(self, features: list[dict[str, Any]], bounds: Bounds) -> Iterator[str]:
        window = shapely.box(*bounds).buffer(-0.5, join_style="mitre")
        for feature in features:
            outline = shapely.geometry.shape(feature["geometry"]) if feature.get("geometry") else None
            properties = feature.get("properties", {})
            url = next(
                (properties[name] for name in self.config.lidar_url_fields if properties.get(name)), None
            )
            if url and (outline is None or outline.intersects(window)):
                yield self._safe(str(url))

    def _safe(self, url: str) -> str:
        """The index has http:// addresses of the same host as the service; they are asked for by https://."""
        parts, service = urlsplit(url), urlsplit(self.config.wfs_url)
        return urlunsplit(parts._replace(scheme=service.scheme)) if parts.netloc == service.netloc else url

    def _download_tile(self, url: str, path: Path) -> None:
        try:
            self.client.download(url, path, magic=b"LASF")
        except InputError as error:
            # some names in the index have a dash where the file has an underscore
            other = re.sub(r"_(\d{4})-(\d{4})_", r"_\1_\2_", url)
            if other == url or "HTTP 404" not in str(error):
                raise
            self.client.download(other, path, magic=b"LASF")


def _from_geotiff(body: bytes, name: str) -> np.ndarray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with MemoryFile(body) as file, file.open() as raster:
                if raster.dtypes[0] != "float32":
                    raise InputError(
                        f"{name}: expected heights as float32, got {raster.dtypes[0]}: a picture?"
                    )
                return raster.read(1)
    except (RasterioError, rasterio.errors.RasterioIOError) as error:
        raise InputError(f"{name}: not a readable GeoTIFF, or truncated: {error}") from error


def _text(bounds: Bounds) -> str:
    return f"{bounds[0]:.0f}..{bounds[2]:.0f}, {bounds[1]:.0f}..{bounds[3]:.0f}"
