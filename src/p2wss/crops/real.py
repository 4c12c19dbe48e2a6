"""Crop the points of each building from real LiDAR, without labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from p2wss.clouds.crops import GROUND_REACH_M, crop_cloud
from p2wss.clouds.reading import read_clouds
from p2wss.config import Crops
from p2wss.crops.rows import crop_columns
from p2wss.data import polygon_arrays, tiling
from p2wss.data.crs import check_crs
from p2wss.data.las_classes import LAS, ClassSet
from p2wss.data.points import points_on_buildings
from p2wss.storage.features import Features
from p2wss.storage.schemas.crops import CROPS


def crop_real(
    features: Features,
    clouds: Sequence[str | Path],
    tile: str,
    tile_size_m: float,
    settings: Crops,
    classes: ClassSet = LAS,
) -> tuple[dict[str, Any], Counter[str]]:
    """The columns of :data:`p2wss.storage.schemas.crops.CROPS` without labels, and the number of excluded footprints
    per reason.

    features: the result of :func:`p2wss.footprints.cleaning.clean_footprints`. As in the scenes, the centre of its
    bounding box assigns a footprint to a tile; the footprints of ``tile`` are cropped. clouds: files of the tile and
    its margin, in the CRS of the footprints. classes: of these clouds; the columns have classes of LAS.

    Raises :class:`InputError` if a cloud is unreadable or in another CRS.
    """
    features = features.take(np.isfinite(features["centre_x_m"]))
    tiles = tiling.tiles_of_points(features["centre_x_m"], features["centre_y_m"], tile_size_m)
    features = features.take(tiles == tile)
    is_usable = features["status"] == "ok"
    num_excluded = Counter(features["status"][~is_usable])
    features = features.take(is_usable)
    polygons = polygon_arrays.to_polygons(features.geometry)
    # bounds of the polygons, or of the tile if there are none; the window also holds the ground around them
    bounds = tiling.bounds_of_points(*polygons.xy_m.T) or tiling.tile_bounds(tile, tile_size_m)
    cloud = read_clouds(clouds, tiling.grown(bounds, GROUND_REACH_M), classes)
    check_crs(cloud.crs, features.crs, clouds[0], "the footprints are", "reproject one of them")

    cropped = crop_cloud(cloud, polygons, settings.buffer_m)
    classification = cloud.classification[cropped.point]
    height_m = cloud.z_m[cropped.point] - np.repeat(cropped.ground_z_m, np.diff(cropped.offset))
    on_roof = points_on_buildings(cropped.inside, classification, height_m, cropped.offset)
    selection, columns = crop_columns(
        cloud, cropped, polygons, polygon_arrays.origins(polygons), on_roof, settings, num_excluded
    )
    for field in CROPS:
        if field.nullable:
            columns[field.name] = pa.nulls(len(selection), field.type)
    columns["building_id"] = features["building_id"][selection]
    columns["tile"] = np.full(len(selection), tile, dtype=object)
    columns["split"] = np.full(len(selection), "none", dtype=object)
    return columns, num_excluded
