"""IGN's Geoplateforme: footprints by WFS, terrain by WMS-Raster, LiDAR HD tiles by their index.

Services and limits: https://cartes.gouv.fr (documentation of the Geoplateforme). All names are in the config,
because they change.
"""

from __future__ import annotations

import json
import logging
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit, urlunsplit

import geopandas as gpd
import numpy as np
import rasterio
import shapely
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile

from p2wss.config import Geoplateforme
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import Bounds
from p2wss.errors import InputError
from p2wss.fetch.cloud import check_cloud
from p2wss.fetch.http import Client, Gone, NoRanges, quote
from p2wss.fetch.remote import write_window
from p2wss.fetch.store import Request, Store

log = logging.getLogger(__name__)
_ATTEMPTS_AT_EMPTY_PAGE = 3
_OFFLINE = "; fetch.offline is set"
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


Answer = TypeVar("Answer")


class _NotListed(InputError):
    """An index of LiDAR tiles that cannot be read, or has none where one is wanted."""


@dataclass(frozen=True)
class _MapRequest:
    """One GetMap request and the place of its cells in the whole."""

    row: int
    column: int
    rows: int
    columns: int
    params: Request


class GeoplateformeSource:
    """See :class:`p2wss.fetch.Source`. What comes is kept in ``downloads``; offline: nothing else is used."""

    def __init__(
        self,
        config: Geoplateforme,
        crs: str,
        downloads: Path,
        offline: bool = False,
        client: Client | None = None,
    ) -> None:
        self.config = config
        self.crs = crs
        self.name = f"{config.wfs_url} {config.footprints_type}"
        self.store = Store(downloads)
        self.offline = offline
        self.client = client or Client(config)

    def footprints(self, bounds: Bounds) -> gpd.GeoDataFrame:
        config = self.config
        windows = self.footprint_windows(bounds)
        self._check_offline(
            [
                f"footprints in {_text(window)}"
                for window in windows
                if not self.has_features(config.footprints_type, window, config.footprints_id)
            ]
        )
        features: list[dict[str, Any]] = []
        for number, window in enumerate(windows):
            features += self._features(config.footprints_type, window, config.footprints_id)
            if len(windows) > 1:
                log.info(f"footprints: window {number + 1} of {len(windows)}, {len(features)} features")
        if not features:
            raise InputError(f"{self.name}: no building in {_text(bounds)}")
        return gpd.GeoDataFrame.from_features(features, crs=self.crs)

    def footprint_windows(self, bounds: Bounds) -> list[Bounds]:
        """The squares that footprints are asked for by; a building on an edge comes with each."""
        edge = self.config.footprints_window_m
        if edge == 0:
            return [bounds]
        x_min, y_min, x_max, y_max = bounds
        return [
            (x, y, min(x + edge, x_max), min(y + edge, y_max))
            for y in np.arange(y_min, y_max, edge).tolist()
            for x in np.arange(x_min, x_max, edge).tolist()
        ]

    def dtm(self, bounds: Bounds) -> Terrain:
        """Cells are centred on multiples of the resolution, as in IGN's files: nothing is resampled."""
        cell, requests = self.config.dtm_resolution_m, self.map_requests(bounds)
        self._check_offline(
            [
                f"terrain in {request.params['BBOX']}"
                for request in requests
                if not self.store.holds(self._map_path(request), request.params)
            ]
        )
        left, top, rows, columns = _grid(bounds, cell)
        heights = np.empty((rows, columns), np.float32)
        for request in requests:
            window = heights[request.row : request.row + request.rows]
            window[:, request.column : request.column + request.columns] = self._heights(request)
        heights[heights <= self.config.dtm_nodata_below_m] = np.nan
        return Terrain(heights, left * cell, top * cell, cell)

    def lidar(self, bounds: Bounds) -> list[Path]:
        """Tiles that share more than an edge with ``bounds``, by the first index whose addresses all work.

        Of COPC tiles of which only a small part is needed, only that part is read.
        """
        reasons = []
        for type_name in self.config.lidar_types:
            known = self.has_features(type_name, bounds, None)
            if self.offline and not known:
                reasons.append(f"the index {type_name} is not in {self.store.folder}")
                continue
            try:
                return self._tiles(type_name, bounds)
            except Gone as error:
                if not known:
                    reasons.append(f"{type_name} has an address of nothing: {error}")
                    continue
            except _NotListed as error:
                reasons.append(str(error))
                continue
            # the index kept from an earlier run is out of date
            self.store.forget(self._features_path(type_name, bounds, None)[0])
            try:
                return self._tiles(type_name, bounds)
            except (Gone, _NotListed) as error:
                reasons.append(str(error))
        raise InputError(
            f"no LiDAR HD in {_text(bounds)}: {'; '.join(reasons)}{_OFFLINE if self.offline else ''}"
        )

    def has_lidar(self, bounds: Bounds) -> bool:
        """Whether :meth:`lidar` would answer without a request."""
        for type_name in self.config.lidar_types:
            if self.has_features(type_name, bounds, None):
                try:
                    urls = self._lidar_urls(type_name, bounds)
                except _NotListed:
                    continue
                wanted = (self.tile_request(url, outline, bounds) for url, outline in urls)
                return all(self.store.holds(path, request) for path, request in wanted)
        return False

    def _tiles(self, type_name: str, bounds: Bounds) -> list[Path]:
        urls = self._lidar_urls(type_name, bounds)
        wanted = [self.tile_request(url, outline, bounds) for url, outline in urls]
        self._check_offline(
            [request["url"] for path, request in wanted if not self.store.holds(path, request)]
        )
        return [self._tile(path, request, bounds) for path, request in wanted]

    def tile_request(self, url: str, outline: Any, bounds: Bounds) -> tuple[Path, Request]:
        """Where a tile, or a window of it, belongs, and what is asked for."""
        share = outline.intersection(shapely.box(*bounds)).area / outline.area if outline is not None else 1.0
        if url.endswith(".copc.laz") and share < self.config.lidar_window_share:
            request = {"url": url, "bounds_m": ",".join(f"{value:.3f}" for value in bounds)}
            return self.store.path("lidar", request, ".laz"), request
        return self.store.folder / "lidar" / Path(urlsplit(url).path).name, {"url": url}

    def _tile(self, path: Path, request: Request, bounds: Bounds) -> Path:
        if self.store.holds(path, request):
            return path
        url = request["url"]
        if "bounds_m" in request:
            try:
                log.info(f"reading a window of {url}")
                num_points = self._mended(
                    url, lambda at: write_window(self.client, at, bounds, path, self.crs)
                )
                log.info(f"{path.name}: {num_points} points")
            except NoRanges as error:
                log.warning(f"{error}; all of it is downloaded")
                return self._tile(
                    self.store.folder / "lidar" / Path(urlsplit(url).path).name, {"url": url}, bounds
                )
        else:
            log.info(f"downloading {url}")
            path.unlink(missing_ok=True)
            self._mended(url, lambda at: self.client.download(at, path, magic=b"LASF"))
            try:
                check_cloud(path, self.crs)
            except InputError:
                path.unlink()
                raise
        self.store.record(path, request)
        return path

    def _check_offline(self, missing: list[str]) -> None:
        if self.offline and missing:
            raise InputError(f"{self.store.folder}: {'; '.join(missing)} missing{_OFFLINE}")

    def has_features(self, type_name: str, bounds: Bounds, sort_by: str | None) -> bool:
        return self.store.holds(*self._features_path(type_name, bounds, sort_by))

    def _features_path(self, type_name: str, bounds: Bounds, sort_by: str | None) -> tuple[Path, Request]:
        request = self._feature_params(type_name, bounds, sort_by)
        return self.store.path("features", request, ".geojson"), request

    def _features(self, type_name: str, bounds: Bounds, id_field: str | None) -> list[dict[str, Any]]:
        """All features of a WFS type; kept once they are complete."""
        path, request = self._features_path(type_name, bounds, id_field)
        kept = self.store.read(path, request)
        if kept is not None:
            return json.loads(kept)["features"]
        features = self._all_pages(type_name, bounds, id_field)
        collection = {"type": "FeatureCollection", "features": features}
        self.store.write(path, request, json.dumps(collection, ensure_ascii=False).encode())
        return features

    def _all_pages(self, type_name: str, bounds: Bounds, id_field: str | None) -> list[dict[str, Any]]:
        """Page by page until as many came as the service counts, each once.

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

    def _feature_params(self, type_name: str, bounds: Bounds, sort_by: str | None) -> Request:
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
        }
        return params | ({"SORTBY": sort_by} if sort_by else {})

    def _page(self, type_name: str, bounds: Bounds, start: int, sort_by: str | None) -> dict[str, Any]:
        params = self._feature_params(type_name, bounds, sort_by)
        params |= {"COUNT": str(self.config.page_size), "STARTINDEX": str(start)}
        body = self.client.get(self.config.wfs_url, params)
        try:
            page = json.loads(body)
            if isinstance(page.get("features"), list) and str(page.get("numberMatched")).isdigit():
                return page
        except (ValueError, AttributeError):
            pass
        raise InputError(f"{self.config.wfs_url} {type_name}: expected GeoJSON features, got {quote(body)}")

    def map_requests(self, bounds: Bounds) -> list[_MapRequest]:
        """The GetMap requests for ``bounds``, none larger than the service allows."""
        config, most = self.config, self.config.dtm_max_pixels
        left, top, num_rows, num_columns = _grid(bounds, config.dtm_resolution_m)
        requests = []
        for row in range(0, num_rows, most):
            for column in range(0, num_columns, most):
                rows, columns = min(most, num_rows - row), min(most, num_columns - column)
                west, north = left + column, top - row
                box = np.array([west, north - rows, west + columns, north]) * config.dtm_resolution_m
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
                requests.append(_MapRequest(row, column, rows, columns, params))
        return requests

    def has_map(self, request: _MapRequest) -> bool:
        return self.store.holds(self._map_path(request), request.params)

    def _map_path(self, request: _MapRequest) -> Path:
        suffix = ".tif" if self.config.dtm_format == "image/geotiff" else ".bil"
        return self.store.path("terrain", request.params, suffix)

    def _heights(self, request: _MapRequest) -> np.ndarray:
        """The heights of one GetMap request; kept once they are known to be heights."""
        path = self._map_path(request)
        kept = self.store.read(path, request.params)
        body = kept if kept is not None else self.client.get(self.config.wms_url, request.params)
        heights = self._decoded(body, (request.rows, request.columns))
        if kept is None:
            self.store.write(path, request.params, body)
        return heights

    def _decoded(self, body: bytes, shape: tuple[int, int]) -> np.ndarray:
        config, (rows, columns) = self.config, shape
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

    def _lidar_urls(self, type_name: str, bounds: Bounds) -> list[tuple[str, Any]]:
        """Address and outline of each tile of an index that shares more than an edge with ``bounds``."""
        try:
            features = self._features(type_name, bounds, None)
        except InputError as error:
            raise _NotListed(str(error)) from error
        window = shapely.box(*bounds).buffer(-0.5, join_style="mitre")
        found: dict[str, Any] = {}
        for feature in features:
            outline = shapely.geometry.shape(feature["geometry"]) if feature.get("geometry") else None
            properties = feature.get("properties", {})
            url = next(
                (properties[name] for name in self.config.lidar_url_fields if properties.get(name)), None
            )
            if url and (outline is None or outline.intersects(window)):
                found[self._safe(str(url))] = outline
        if not found:
            raise _NotListed(f"{type_name} has no tile there")
        return sorted(found.items(), key=lambda item: item[0])

    def _safe(self, url: str) -> str:
        """The index has http:// addresses of the same host as the service; they are asked for by https://."""
        parts, service = urlsplit(url), urlsplit(self.config.wfs_url)
        return urlunsplit(parts._replace(scheme=service.scheme)) if parts.netloc == service.netloc else url

    def _mended(self, url: str, ask: Callable[[str], Answer]) -> Answer:
        """What ``ask`` gets; some names in the index have a dash where the file has an underscore."""
        try:
            return ask(url)
        except Gone:
            other = re.sub(r"_(\d{4})-(\d{4})_", r"_\1_\2_", url)
            if other == url:
                raise
            return ask(other)


def _grid(bounds: Bounds, cell: float) -> tuple[float, float, int, int]:
    """Left and top edge in cells, rows and columns of cells centred on multiples that cover ``bounds``."""
    left, top = float(np.floor(bounds[0] / cell)) - 0.5, float(np.ceil(bounds[3] / cell)) + 0.5
    columns = int(np.ceil(bounds[2] / cell) + 0.5 - left)
    return left, top, int(top - np.floor(bounds[1] / cell) + 0.5), columns


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
