"""The sources of data. Both kinds offer the same three methods (:class:`Source`)."""

from pathlib import Path
from typing import Protocol

import geopandas as gpd
import numpy as np

from p2wss.config import Fetch, Region
from p2wss.data.crs import bounds_in_crs, parsed_crs
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import Bounds, bounds_text
from p2wss.fetching.bdtopo import normalise
from p2wss.storage.messages import InputError


class Source(Protocol):
    """A source of data. All bounds are (x_min, y_min, x_max, y_max) in metres in the CRS of the region."""

    name: str  # used in messages

    def footprints(self, bounds: Bounds) -> gpd.GeoDataFrame:
        """Buildings that intersect ``bounds``, with the columns of BD TOPO in either spelling."""

    def dtm(self, bounds: Bounds) -> Terrain:
        """Terrain heights over ``bounds``, NaN where there are no data."""

    def lidar(self, bounds: Bounds) -> list[Path]:
        """Paths of LAS, LAZ or COPC files that hold the points in ``bounds``."""


def open_source(region: Region, config: Fetch, downloads: Path) -> Source:
    """Open the source that the config names.

    downloads: folder for downloaded files, which later runs reuse. Raises :class:`InputError` if a CRS of
    the config does not exist.
    """
    parsed_crs(region.crs, "config: region.crs:")
    parsed_crs(config.folder.lidar_crs or region.crs, "config: fetch.folder.lidar_crs:")
    if config.source == "folder":
        from p2wss.fetching.folder import FolderSource

        return FolderSource(config.folder, region.crs)
    from p2wss.fetching.geoplateforme import GeoplateformeSource

    return GeoplateformeSource(config.geoplateforme, region.crs, downloads)


def read_buildings(
    source: Source, region: Region, config: Fetch, bounds: Bounds, place: str
) -> gpd.GeoDataFrame:
    """The footprints that intersect ``bounds``, normalised. Raises :class:`InputError` if there is none. place: the
    bounds in words, for that message."""
    schema = config.folder.footprints_schema if config.source == "folder" else "bdtopo"
    frame = normalise(source.footprints(bounds), region.crs, source.name, schema)
    if not len(frame):
        raise InputError(f"{source.name}: no building in {place}")
    return frame


def delivery_window(region: Region, config: Fetch, bounds: Bounds) -> tuple[str, Bounds]:
    """The CRS in which the clouds are delivered, and the window in that CRS that contains ``bounds``."""
    crs = (config.folder.lidar_crs if config.source == "folder" else "") or region.crs
    return crs, bounds_in_crs(bounds, region.crs, crs)


def known_height_share(terrain: Terrain, bounds: Bounds, name: str) -> float:
    """Share (0 to 1) of the cells in ``bounds`` that have a height. name: used in messages.

    Raises :class:`InputError` if all cells are no data.
    """
    share = float(np.isfinite(terrain.cut(bounds).height_m).mean())
    if share == 0:
        raise InputError(f"{name}: no heights in {bounds_text(bounds)}: no cell has data")
    return share
