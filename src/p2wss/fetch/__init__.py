"""Stage 1, fetch: footprints, terrain and LiDAR from a service or from disk, in one form.

Both sources answer the same three questions; what comes out is normalised, so that no later stage knows where
it came from.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import geopandas as gpd
import numpy as np

from p2wss.config import Fetch, Region
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import Bounds
from p2wss.errors import InputError
from p2wss.fetch.batiment import normalise, write_footprints
from p2wss.fetch.cloud import write_cloud

__all__ = [
    "Source",
    "check_terrain",
    "delivered",
    "normalise",
    "open_source",
    "write_cloud",
    "write_footprints",
]


class Source(Protocol):
    """Where data comes from. All bounds are (x_min, y_min, x_max, y_max) in the CRS of the region."""

    name: str  # for messages

    def footprints(self, bounds: Bounds) -> gpd.GeoDataFrame:
        """Buildings that meet ``bounds``, with the columns of BD TOPO in either spelling."""
        ...

    def dtm(self, bounds: Bounds) -> Terrain:
        """Heights over ``bounds``, NaN where there are none."""
        ...

    def lidar(self, bounds: Bounds) -> list[Path]:
        """LAS, LAZ or COPC files with the points in ``bounds``."""
        ...


def open_source(region: Region, config: Fetch, downloads: Path) -> Source:
    """The source that the config names; downloads: folder for what it gets or unpacks, kept for later runs."""
    if config.source == "folder":
        from p2wss.fetch.folder import FolderSource

        return FolderSource(config.folder, region.crs, downloads / "unpacked")
    from p2wss.fetch.geoplateforme import GeoplateformeSource

    return GeoplateformeSource(config.geoplateforme, region.crs, downloads, config.offline)


def delivered(region: Region, config: Fetch, bounds: Bounds) -> tuple[str, Bounds]:
    """The CRS in which the clouds come, and the window of it that holds ``bounds``."""
    crs = (config.folder.lidar_crs if config.source == "folder" else "") or region.crs
    if crs == region.crs:
        return crs, bounds
    from p2wss.fetch.folder import in_crs

    return crs, in_crs(bounds, region.crs, crs)


def check_terrain(terrain: Terrain, bounds: Bounds, name: str) -> float:
    """Share of the cells in ``bounds`` that have a height. Raises :class:`InputError` if none has."""
    x_min, y_min, x_max, y_max = bounds
    share = float(np.isfinite(terrain.cut(bounds).height_m).mean())
    if share == 0:
        raise InputError(
            f"{name}: no heights in {x_min:.0f}..{x_max:.0f}, {y_min:.0f}..{y_max:.0f}, only no-data cells"
        )
    return share
