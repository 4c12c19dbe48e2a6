"""Inputs of ``p2wss reconstruct``: the weights, the common CRS, the footprints of a tile, the window to read."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import geopandas as gpd
import numpy as np
import pyproj

from p2wss.config import Config, Reconstruct, Scenes
from p2wss.data.cloud_crops import GROUND_RINGS_M
from p2wss.data.clouds import horizontal, same_crs
from p2wss.data.tiling import Bounds, tiles_of_points
from p2wss.errors import InputError
from p2wss.reconstruct.registration import context

# in place of a file of weights: no network
NO_NETWORK = "none"


def weights_to_use(model: Path | None, config: Reconstruct) -> Path | None:
    """The file of weights: ``model``, or by default the one that came with the package, if there is one. None for no
    network, as with the ``model`` "none".

    Raises :class:`InputError` if there is neither a network nor a fit.
    """
    weights = shipped_model() if model is None else model
    if weights is not None and str(weights) == NO_NETWORK:
        weights = None
    if weights is None and not config.fit:
        raise InputError(
            "without the fit (--no-fit, reconstruct.fit) a network is needed: give one with --model"
        )
    return weights


def shipped_model() -> Path | None:
    """The weights that came with the package; None in a package without."""
    path = Path(str(files("p2wss"))) / "weights" / "point2wss.safetensors"
    return path if path.is_file() else None


def footprint_settings(config: Config) -> Scenes:
    """The settings with which :func:`p2wss.data.footprints.clean_footprints` cleans the user's footprints: those of the
    section scenes, but with ``reconstruct.simplify_m``."""
    return config.scenes.model_copy(update={"simplify_m": config.reconstruct.simplify_m})


def common_crs(
    cloud: pyproj.CRS | None, frame: pyproj.CRS | None, stated: str | None, names: tuple[str, str]
) -> tuple[pyproj.CRS, str | None]:
    """The common CRS of clouds and footprints, and a note if it was assumed.

    cloud, frame: the CRS that each of the two files states, if any. stated: the one that the user states. names: of the
    two files. Raises :class:`InputError` if two of them differ, if there is none, or if it is not projected in metres.
    """
    note = None
    if stated is not None:
        try:
            stated_crs = pyproj.CRS.from_user_input(stated)
        except pyproj.exceptions.CRSError as error:
            raise InputError(f"--crs {stated}: no such CRS; state one such as EPSG:28992") from error
        if cloud is not None and not same_crs(cloud, stated_crs):
            raise InputError(
                f"{names[0]} is in {cloud.name}, but --crs states {stated_crs.name}; leave --crs out"
            )
        # heights that the user states are part of the CRS
        cloud = stated_crs if cloud is None or not cloud.is_compound else cloud
    if cloud is not None and frame is not None and not same_crs(cloud, frame):
        source = "" if stated is None else " according to --crs"
        raise InputError(
            f"{names[0]} is in {cloud.name}{source}, but {names[1]} is in {frame.name}; reproject one of them"
        )
    crs = cloud or frame
    if crs is None:
        raise InputError(
            f"neither {names[0]} nor {names[1]} states its CRS; state it with --crs, such as EPSG:28992"
        )
    if cloud is None:
        note = (
            f"{names[0]} does not state its CRS; assuming {crs.name} as in {names[1]} (--crs overrides this)"
        )
    flat = horizontal(crs)
    if not flat.is_projected or any(axis.unit_conversion_factor != 1.0 for axis in flat.axis_info):
        raise InputError(
            f"{names[0]}: {crs.name} is not a projected CRS in metres; reproject clouds and footprints"
        )
    return crs, note


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
    """Name of the outputs: the cloud's, without its endings.

    >>> output_stem(Path("in/Semis_2021.copc.laz"))
    'Semis_2021'
    """
    return cloud.stem.removesuffix(".copc")
