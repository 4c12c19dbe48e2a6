"""Source ``geoplateforme``: IGN's services (WFS for footprints, WMS for terrain, an index of LiDAR HD tiles).

The services and their limits are documented at https://cartes.gouv.fr. All names of layers and attributes are
settings, because IGN changes them.
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
from p2wss.fetch.cloud import append_checksum, check_cloud
from p2wss.fetch.http import Client, NotFoundError, RangesUnsupportedError, quote
from p2wss.fetch.remote_copc import write_window
from p2wss.fetch.store import Request, Store

log = logging.getLogger(__name__)
_ATTEMPTS_AT_EMPTY_PAGE = 3
_OFFLINE = "; fetch.offline is set"
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
Result = TypeVar("Result")


class _NotListedError(InputError):
    """The index of LiDAR tiles cannot be read, or lists no tile in the bounds."""


@dataclass(frozen=True)
class _MapRequest:
    """One WMS GetMap request, and the block of cells of the whole raster that its response fills."""

    row: int
    column: int
    rows: int
    columns: int
    params: Request


class GeoplateformeSource:
    """IGN's services, see :class:`p2wss.fetch.source.Source`.

    Responses are stored in ``downloads``. offline: use only stored responses; a missing one is an error.
    """

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
        """See :class:`p2wss.fetch.source.Source`. Raises :class:`InputError` if the service fails."""
        config = self.config
        windows = self.footprint_windows(bounds)
        self._check_offline(
            [
                f"footprints in {_format_bounds(window)}"
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
            raise InputError(f"{self.name}: no building in {_format_bounds(bounds)}")
        return gpd.GeoDataFrame.from_features(features, crs=self.crs)

    def footprint_windows(self, bounds: Bounds) -> list[Bounds]:
        """The windows of the WFS requests for footprints. A building on an edge is in several responses."""
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
        """Terrain heights over ``bounds``.

        Cells are centred on multiples of the resolution as in IGN's files, so that the service does not
        resample them.
        """
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
        """Tiles that overlap ``bounds``, from the first index whose addresses all work.

        If only a small part of a COPC tile is needed, only that part is read. Raises :class:`InputError` if no index
        is usable.
        """
        reasons = []
        for type_name in self.config.lidar_types:
            is_stored = self.has_features(type_name, bounds, None)
            if self.offline and not is_stored:
                reasons.append(f"the index {type_name} is not in {self.store.folder}")
                continue
            try:
                return self._tiles(type_name, bounds)
            except NotFoundError as error:
                if not is_stored:
                    reasons.append(f"{type_name} lists an address that does not exist: {error}")
                    continue
            except _NotListedError as error:
                reasons.append(str(error))
                continue
            # the index stored by an earlier run is out of date
            self.store.forget(self._features_path(type_name, bounds, None)[0])
            try:
                return self._tiles(type_name, bounds)
            except (NotFoundError, _NotListedError) as error:
                reasons.append(str(error))
        raise InputError(
            f"no LiDAR HD in {_format_bounds(bounds)}: {'; '.join(reasons)}{_OFFLINE if self.offline else ''}"
        )

    def has_lidar(self, bounds: Bounds) -> bool:
        """Whether :meth:`lidar` needs no request."""
        for type_name in self.config.lidar_types:
            if self.has_features(type_name, bounds, None):
                try:
                    urls = self._lidar_urls(type_name, bounds)
                except _NotListedError:
                    continue
                tiles = (self.tile_request(url, outline, bounds) for url, outline in urls)
                return all(self.store.holds(path, request) for path, request in tiles)
        return False

    def _tiles(self, type_name: str, bounds: Bounds) -> list[Path]:
        urls = self._lidar_urls(type_name, bounds)
        tiles = [self.tile_request(url, outline, bounds) for url, outline in urls]
        self._check_offline(
            [request["url"] for path, request in tiles if not self.store.holds(path, request)]
        )
        return [self._tile(path, request, bounds) for path, request in tiles]

    def tile_request(self, url: str, outline: Any, bounds: Bounds) -> tuple[Path, Request]:
        """The path at which a tile, or a window of it, is stored, and the request for it."""
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
                num_points = self._with_corrected_name(
                    url, lambda address: write_window(self.client, address, bounds, path, self.crs)
                )
                log.info(f"{path.name}: {num_points} points")
            except RangesUnsupportedError as error:
                log.warning(f"{error}; downloading the whole tile")
                return self._tile(
                    self.store.folder / "lidar" / Path(urlsplit(url).path).name, {"url": url}, bounds
                )
        else:
            log.info(f"downloading {url}")
            path.unlink(missing_ok=True)
            self._with_corrected_name(url, lambda address: self.client.download(address, path, magic=b"LASF"))
            try:
                check_cloud(path, self.crs)
            except InputError:
                path.unlink()
                raise
            append_checksum(path)
        self.store.record(path, request)
        return path

    def _check_offline(self, missing: list[str]) -> None:
        if self.offline and missing:
            raise InputError(f"{self.store.folder}: {'; '.join(missing)} missing{_OFFLINE}")

    def has_features(self, type_name: str, bounds: Bounds, sort_by: str | None) -> bool:
        """Whether the features of a WFS type in ``bounds`` are stored."""
        return self.store.holds(*self._features_path(type_name, bounds, sort_by))

    def _features_path(self, type_name: str, bounds: Bounds, sort_by: str | None) -> tuple[Path, Request]:
        request = self._feature_params(type_name, bounds, sort_by)
        return self.store.path("features", request, ".geojson"), request

    def _features(self, type_name: str, bounds: Bounds, id_field: str | None) -> list[dict[str, Any]]:
        """All features of a WFS type in ``bounds``, from the store or the service; stored once complete."""
        path, request = self._features_path(type_name, bounds, id_field)
        stored = self.store.read(path, request)
        if stored is not None:
            return json.loads(stored)["features"]
        features = self._all_pages(type_name, bounds, id_field)
        collection = {"type": "FeatureCollection", "features": features}
        self.store.write(path, request, json.dumps(collection, ensure_ascii=False).encode())
        return features

    def _all_pages(self, type_name: str, bounds: Bounds, id_field: str | None) -> list[dict[str, Any]]:
        """All features, requested page by page until their number is the one that the service states.

        The service may cut a page without saying so, hence the next page starts after the features that were
        received, not after those that were requested.
        """
        features: dict[str, dict[str, Any]] = {}
        start, matched, empty_pages = 0, None, 0
        while matched is None or start < matched:
            page = self._page(type_name, bounds, start, id_field)
            matched = int(page["numberMatched"])
            for feature in page["features"]:
                key = feature.get("properties", {}).get(id_field) if id_field else feature.get("id")
                features[str(key if key is not None else len(features))] = feature
            start += len(page["features"])
            if not page["features"] and start < matched:
                empty_pages += 1
                if empty_pages == _ATTEMPTS_AT_EMPTY_PAGE:
                    raise InputError(
                        f"{self.config.wfs_url} {type_name}: the service sent {start} of {matched} features, "
                        "then empty pages; try again later"
                    )
            if matched > self.config.page_size:
                log.info(f"{type_name}: {start} of {matched} features")
        if len(features) < (matched or 0):
            raise InputError(
                f"{self.config.wfs_url} {type_name}: pages overlap, and only {len(features)} of {matched} "
                "features differ; try again, or raise fetch.geoplateforme.page_size"
            )
        return list(features.values())

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
        """The WMS GetMap requests that cover ``bounds``, each of at most ``dtm_max_pixels`` per side."""
        config, block = self.config, self.config.dtm_max_pixels
        left, top, num_rows, num_columns = _grid(bounds, config.dtm_resolution_m)
        requests = []
        for row in range(0, num_rows, block):
            for column in range(0, num_columns, block):
                rows, columns = min(block, num_rows - row), min(block, num_columns - column)
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
        """Whether the response to a GetMap request is stored."""
        return self.store.holds(self._map_path(request), request.params)

    def _map_path(self, request: _MapRequest) -> Path:
        suffix = ".tif" if self.config.dtm_format == "image/geotiff" else ".bil"
        return self.store.path("terrain", request.params, suffix)

    def _heights(self, request: _MapRequest) -> np.ndarray:
        """The heights of one GetMap request; the response is stored once it decodes to heights."""
        path = self._map_path(request)
        stored = self.store.read(path, request.params)
        body = stored if stored is not None else self.client.get(self.config.wms_url, request.params)
        heights = self._decode_heights(body, (request.rows, request.columns))
        if stored is None:
            self.store.write(path, request.params, body)
        return heights

    def _decode_heights(self, body: bytes, shape: tuple[int, int]) -> np.ndarray:
        config, (rows, columns) = self.config, shape
        name = f"{config.wms_url} {config.dtm_layer}"
        expected = f"{config.dtm_format} of {columns} x {rows} heights"
        if config.dtm_format == "image/geotiff":
            if not body.startswith(_TIFF_MAGIC):
                raise InputError(f"{name}: expected {expected}, got {quote(body)}")
            heights = _from_geotiff(body, name)
        else:
            # little-endian float32, north row first; only the length distinguishes it from an error message
            if len(body) != 4 * rows * columns:
                raise InputError(f"{name}: expected {expected}, got {len(body)} bytes: {quote(body)}")
            heights = np.frombuffer(body, "<f4").reshape(shape)
        if heights.shape != shape:
            raise InputError(
                f"{name}: requested {columns} x {rows} heights, got {heights.shape[1]} x {heights.shape[0]}"
            )
        return heights

    def _lidar_urls(self, type_name: str, bounds: Bounds) -> list[tuple[str, Any]]:
        """URL and outline of each tile of an index that overlaps ``bounds`` by more than half a metre."""
        try:
            features = self._features(type_name, bounds, None)
        except InputError as error:
            raise _NotListedError(str(error)) from error
        window = shapely.box(*bounds).buffer(-0.5, join_style="mitre")
        outlines: dict[str, Any] = {}
        for feature in features:
            outline = shapely.geometry.shape(feature["geometry"]) if feature.get("geometry") else None
            properties = feature.get("properties", {})
            url = next(
                (properties[name] for name in self.config.lidar_url_fields if properties.get(name)), None
            )
            if url and (outline is None or outline.intersects(window)):
                outlines[self._with_service_scheme(str(url))] = outline
        if not outlines:
            raise _NotListedError(f"{type_name} has no tile there")
        return sorted(outlines.items(), key=lambda item: item[0])

    def _with_service_scheme(self, url: str) -> str:
        """``url`` with the scheme of the WFS if it has the same host: the index lists http:// addresses."""
        parts, service = urlsplit(url), urlsplit(self.config.wfs_url)
        return urlunsplit(parts._replace(scheme=service.scheme)) if parts.netloc == service.netloc else url

    def _with_corrected_name(self, url: str, download: Callable[[str], Result]) -> Result:
        """The result of ``download(url)``.

        Some file names in the index have a dash in place of an underscore: if the file is not found, the
        corrected name is tried.
        """
        try:
            return download(url)
        except NotFoundError:
            corrected = re.sub(r"_(\d{4})-(\d{4})_", r"_\1_\2_", url)
            if corrected == url:
                raise
            return download(corrected)


def _grid(bounds: Bounds, cell: float) -> tuple[float, float, int, int]:
    """The grid of cells that covers ``bounds``, with cells centred on multiples of ``cell`` metres.

    Returns the left and the top edge (in cells), the number of rows and the number of columns.
    """
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
                        f"{name}: expected heights as float32, got {raster.dtypes[0]}; "
                        "is the layer an image instead of heights?"
                    )
                return raster.read(1)
    except (RasterioError, rasterio.errors.RasterioIOError) as error:
        raise InputError(f"{name}: not a readable GeoTIFF, or truncated: {error}") from error


def _format_bounds(bounds: Bounds) -> str:
    return f"{bounds[0]:.0f}..{bounds[2]:.0f}, {bounds[1]:.0f}..{bounds[3]:.0f}"
