"""Inputs of ``p2wss reconstruct``: the footprints of a tile, the window to read, the name of the outputs."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np

from p2wss.config import Config, Reconstruct, Scenes
from p2wss.data.cloud_crops import GROUND_RINGS_M
from p2wss.data.tiling import Bounds, tiles_of_points
from p2wss.reconstruct.registration import context


def footprint_settings(config: Config) -> Scenes:
    """The settings with which :func:`p2wss.data.footprints.clean_footprints` cleans the user's footprints: those of the
    section scenes, but with ``reconstruct.simplify_m``."""
    return config.scenes.model_copy(update={"simplify_m": config.reconstruct.simplify_m})


def window(frame: gpd.GeoDataFrame) -> Bounds:
    """The bounds that a cloud must cover: the footprints and the ground around them."""
    if not len(frame):
        return 0.0, 0.0, 0.0, 0.0
    x_min, y_min, x_max, y_max = map(float, frame.total_bounds)
    margin_m = GROUND_RINGS_M[-1]
    return x_min - margin_m, y_min - margin_m, x_max + margin_m, y_max + margin_m


def of_tile(frame: gpd.GeoDataFrame, tile: str, tile_size_m: float) -> gpd.GeoDataFrame:
    """The footprints whose centre is in the tile."""
    frame = frame[np.isfinite(frame["centre_x_m"])]
    in_tile = tiles_of_points(frame["centre_x_m"], frame["centre_y_m"], tile_size_m) == tile
    return frame[in_tile].reset_index(drop=True)


def around_tile(
    frame: gpd.GeoDataFrame, tile: str, tile_size_m: float, config: Reconstruct
) -> gpd.GeoDataFrame:
    """The footprints of :func:`of_tile`, and those on which their registration depends."""
    is_in_tile = np.zeros(len(frame), bool)
    is_known = np.isfinite(frame["centre_x_m"]).to_numpy()
    centre = frame.loc[is_known, ["centre_x_m", "centre_y_m"]].to_numpy()
    is_in_tile[is_known] = tiles_of_points(centre[:, 0], centre[:, 1], tile_size_m) == tile
    if config.registration:
        is_in_tile = context(frame, is_in_tile)
    return frame[is_in_tile].reset_index(drop=True)


def output_stem(cloud: Path) -> str:
    """Name of the outputs: that of the folder, or of the cloud without its endings.

    >>> output_stem(Path("in/Semis_2021.copc.laz"))
    'Semis_2021'
    """
    return cloud.resolve().name if cloud.is_dir() else cloud.stem.removesuffix(".copc")
