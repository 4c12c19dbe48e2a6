"""Inputs of ``p2wss reconstruct``: the footprints of a tile, the window to read, the name of the outputs."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np

from p2wss.clouds.crops import GROUND_RINGS_M
from p2wss.config import Config, Scenes
from p2wss.data.tiling import Bounds, tiles_of_points


def footprint_settings(config: Config) -> Scenes:
    """The settings with which :func:`p2wss.footprints.cleaning.clean_footprints` cleans the user's footprints:
    those of the section scenes, but with ``reconstruct.simplify_m``."""
    return config.scenes.model_copy(update={"simplify_m": config.reconstruct.simplify_m})


def window(frame: gpd.GeoDataFrame) -> Bounds:
    """The bounds that a cloud must cover: the footprints and the ground around them."""
    if not len(frame):
        return 0.0, 0.0, 0.0, 0.0
    x_min, y_min, x_max, y_max = map(float, frame.total_bounds)
    margin_m = GROUND_RINGS_M[-1]
    return x_min - margin_m, y_min - margin_m, x_max + margin_m, y_max + margin_m


def in_tile(frame: gpd.GeoDataFrame, tile: str | None, tile_size_m: float) -> np.ndarray:
    """Whether the centre of each footprint is in the tile, bool (footprints,); all are without a tile."""
    if tile is None:
        return np.ones(len(frame), bool)
    result = np.zeros(len(frame), bool)
    is_known = np.isfinite(frame["centre_x_m"]).to_numpy()
    centre = frame.loc[is_known, ["centre_x_m", "centre_y_m"]].to_numpy()
    result[is_known] = tiles_of_points(centre[:, 0], centre[:, 1], tile_size_m) == tile
    return result


def output_stem(cloud: Path) -> str:
    """Name of the outputs: that of the folder, or of the cloud without its endings.

    >>> output_stem(Path("in/Semis_2021.copc.laz"))
    'Semis_2021'
    """
    return cloud.resolve().name if cloud.is_dir() else cloud.stem.removesuffix(".copc")
