"""Source ``geoplateforme``: IGN's services (WFS for footprints, WMS for terrain, an index of LiDAR HD tiles).

The services and their limits are documented at https://cartes.gouv.fr. All names of layers and attributes are
settings, because IGN changes them.
"""

import hashlib
import json
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import geopandas as gpd
import numpy as np
import shapely
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile

from p2wss.config import Geoplateforme
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import Bounds, bounds_text
from p2wss.fetching.cloud import append_checksum, check_cloud
from p2wss.fetching.http import Client, NotFoundError, quote
from p2wss.storage import files, integrity
from p2wss.storage.messages import InputError, log, reading

_ATTEMPTS_AT_EMPTY_PAGE = 3
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


class _NotListedError(InputError):
    """The index of LiDAR tiles cannot be read, or lists no tile in the bounds."""


@dataclass(frozen=True)
class MapRequest:
    """One WMS GetMap request, and the block of cells of the whole raster that its response fills."""

    row: int
    column: int
    rows: int
    columns: int
    params: dict[str, str]


class GeoplateformeSource:
    """IGN's services, see :class:`p2wss.fetching.source.Source`.

    Responses are stored in ``downloads``, each with its checksum under a name that follows from the request. An intact
    stored response is not requested again.
    """

    def __init__(
        self, config: Geoplateforme, crs: str, downloads: Path, client: Client | None = None
    ) -> None:
        self.config = config
        self.crs = crs
        self.name = f"{config.wfs_url} {config.footprints_type}"
        self.downloads = downloads
        self.client = client or Client(config)

    def footprints(self, bounds: Bounds) -> gpd.GeoDataFrame:
        """See :class:`p2wss.fetching.source.Source`. Raises :class:`InputError` if the service fails."""
        windows = self.footprint_windows(bounds)
        features: list[dict[str, Any]] = []
        for number, window in enumerate(windows):
            features += self._features(self.config.footprints_type, window, self.config.footprints_id)
            if len(windows) > 1:
                log.info(f"footprints: window {number + 1} of {len(windows)}, {len(features)} features")
        if not features:
            raise InputError(f"{self.name}: no building in {bounds_text(bounds)}")
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
        cell = self.config.dtm_resolution_m
        left, top, rows, columns = _grid(bounds, cell)
        heights = np.empty((rows, columns), np.float32)
        for request in self.map_requests(bounds):
            window = heights[request.row : request.row + request.rows]
            window[:, request.column : request.column + request.columns] = self._heights(request)
        heights[heights <= self.config.dtm_nodata_below_m] = np.nan
        return Terrain(heights, left * cell, top * cell, cell)

    def lidar(self, bounds: Bounds) -> list[Path]:
        """Tiles that overlap ``bounds``, from the first index whose addresses all exist.

        Raises :class:`InputError` if no index is usable.
        """
        reasons = []
        for type_name in self.config.lidar_types:
            try:
                return self._tiles(self._lidar_urls(type_name, bounds))
            except (_NotListedError, NotFoundError) as error:
                # a stored index may be out of date: the next attempt asks for it again
                self._features_path(type_name, bounds, None).unlink(missing_ok=True)
                reasons.append(f"{type_name}: {error}")
        raise InputError(f"no LiDAR HD in {bounds_text(bounds)}: {'; '.join(reasons)}")

    def _tiles(self, urls: list[str]) -> list[Path]:
        """The files of tiles, downloaded unless they are stored."""
        paths: list[Path] = []
        names = [Path(urlsplit(url).path).name for url in urls]
        for url, name in zip(urls, names, strict=True):
            path = self.downloads / "lidar" / name
            if names.count(name) > 1:  # a tile of two deliveries, one of which may have been alone before
                path = self._path("lidar", {"url": url}, f"_{name}")
            paths.append(path)
            if integrity.is_usable(path):
                continue
            log.info(f"downloading {url}")
            with files.atomic(path) as temporary:
                self._download(url, temporary)
                try:
                    check_cloud(temporary, self.crs)
                except InputError as error:
                    raise InputError(str(error).replace(str(temporary), url)) from error
                append_checksum(temporary)
        return paths

    def _path(self, kind: str, request: dict[str, Any], suffix: str) -> Path:
        """Where the response to a request is stored. kind: name of the folder."""
        digest = hashlib.blake2b(json.dumps(request, sort_keys=True).encode(), digest_size=8).hexdigest()
        return self.downloads / kind / f"{digest}{suffix}"

    def _features_path(self, type_name: str, bounds: Bounds, sort_by: str | None) -> Path:
        return self._path("features", self._feature_params(type_name, bounds, sort_by), ".geojson")

    def _features(self, type_name: str, bounds: Bounds, id_field: str | None) -> list[dict[str, Any]]:
        """All features of a WFS type in ``bounds``, from the store or the service; stored once complete."""
        path = self._features_path(type_name, bounds, id_field)
        if not integrity.is_usable(path):
            features = self._all_pages(type_name, bounds, id_field)
            files.write_json(path, {"type": "FeatureCollection", "features": features})
        return files.read_json(path)["features"]

    def _all_pages(self, type_name: str, bounds: Bounds, id_field: str | None) -> list[dict[str, Any]]:
        """All features, requested page by page until there are as many as the service states.

        The service may cut a page without saying so. So the next page starts after the features that were received, not
        after those that were requested.
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

    def _feature_params(self, type_name: str, bounds: Bounds, sort_by: str | None) -> dict[str, str]:
        params = {
            "SERVICE": "WFS",
            "VERSION": "2.0.0",
            "REQUEST": "GetFeature",
            "TYPENAMES": type_name,
            "SRSNAME": self.crs,
            "BBOX": ",".join([*(f"{value:.10g}" for value in bounds), self.crs]),
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

    def map_requests(self, bounds: Bounds) -> list[MapRequest]:
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
                    "FORMAT": "image/geotiff",
                    "CRS": self.crs,
                    "BBOX": ",".join(f"{value:.3f}" for value in box),
                    "WIDTH": str(columns),
                    "HEIGHT": str(rows),
                }
                requests.append(MapRequest(row, column, rows, columns, params))
        return requests

    def _heights(self, request: MapRequest) -> np.ndarray:
        """The heights of one GetMap request; the response is stored once it decodes to heights."""
        path = self._path("terrain", request.params, ".tif")
        if integrity.is_usable(path):
            return self._decode_heights(path.read_bytes(), request)
        body = self.client.get(self.config.wms_url, request.params)
        heights = self._decode_heights(body, request)
        files.write_bytes(path, body, seal=True)
        return heights

    def _decode_heights(self, body: bytes, request: MapRequest) -> np.ndarray:
        name = f"{self.config.wms_url} {self.config.dtm_layer}"
        size = f"{request.columns} x {request.rows} heights"
        if not body.startswith(_TIFF_MAGIC):
            raise InputError(f"{name}: expected a GeoTIFF of {size}, got {quote(body)}")
        with (
            warnings.catch_warnings(),
            reading(name, "a readable GeoTIFF, or truncated"),
            MemoryFile(body) as file,
        ):
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with file.open() as raster:
                if raster.dtypes[0] != "float32":
                    raise InputError(
                        f"{name}: expected heights as float32, got {raster.dtypes[0]}; "
                        "is the layer an image instead of heights?"
                    )
                heights = raster.read(1)
        if heights.shape != (request.rows, request.columns):
            raise InputError(f"{name}: requested {size}, got {heights.shape[1]} x {heights.shape[0]}")
        return heights

    def _lidar_urls(self, type_name: str, bounds: Bounds) -> list[str]:
        """The sorted URLs of the tiles of an index that overlap ``bounds`` by more than half a metre."""
        try:
            features = self._features(type_name, bounds, None)
        except InputError as error:
            raise _NotListedError(str(error)) from error
        window = shapely.box(*bounds).buffer(-0.5, join_style="mitre")
        urls: set[str] = set()
        for feature in features:
            outline = shapely.geometry.shape(feature["geometry"]) if feature.get("geometry") else None
            properties = feature.get("properties", {})
            url = next(
                (properties[name] for name in self.config.lidar_url_fields if properties.get(name)), None
            )
            if url and (outline is None or outline.intersects(window)):
                urls.add(self._with_service_scheme(str(url)))
        if not urls:
            raise _NotListedError("has no tile there")
        return sorted(urls)

    def _with_service_scheme(self, url: str) -> str:
        """``url`` with the scheme of the WFS if it has the same host: the index lists http:// addresses."""
        parts, service = urlsplit(url), urlsplit(self.config.wfs_url)
        return urlunsplit(parts._replace(scheme=service.scheme)) if parts.netloc == service.netloc else url

    def _download(self, url: str, path: Path) -> None:
        """Download a tile. Some file names in the index have a dash in place of an underscore: if the file is not
        found, the corrected name is tried."""
        try:
            self.client.download(url, path, magic=b"LASF")
        except NotFoundError:
            corrected = re.sub(r"_(\d{4})-(\d{4})_", r"_\1_\2_", url)
            if corrected == url:
                raise
            self.client.download(corrected, path, magic=b"LASF")


def _grid(bounds: Bounds, cell: float) -> tuple[float, float, int, int]:
    """The grid of cells that covers ``bounds``, with cells centred on multiples of ``cell`` metres.

    Returns the left and the top edge (in cells), the number of rows and the number of columns.
    """
    left, top = float(np.floor(bounds[0] / cell)) - 0.5, float(np.ceil(bounds[3] / cell)) + 0.5
    columns = int(np.ceil(bounds[2] / cell) + 0.5 - left)
    return left, top, int(top - np.floor(bounds[1] / cell) + 0.5), columns
