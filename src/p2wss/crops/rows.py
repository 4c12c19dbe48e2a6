"""Crop the points of each building from real LiDAR, without labels, or from a simulated scan, with labels and a
split by location, in square blocks."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from p2wss.clouds.cropping import seen_share
from p2wss.clouds.crops import GROUND_REACH_M, CloudCrops, crop_cloud
from p2wss.clouds.reading import Cloud, read_clouds
from p2wss.clouds.scan_files import read_scan
from p2wss.config import Crops
from p2wss.data import polygon_arrays, reasons, tiling
from p2wss.data.crs import check_crs
from p2wss.data.las_classes import LAS, ClassSet
from p2wss.data.points import points_on_buildings
from p2wss.data.seeds import generator
from p2wss.skeleton.types import FaceKind, Polygons
from p2wss.storage import files
from p2wss.storage.features import Features
from p2wss.storage.schemas.crops import CROPS

_MAX_REACH_M = 320.0  # int16 centimetres end at 327 m
_OUT_OF_RANGE = -32768
Scan = tuple[Cloud, np.ndarray, np.ndarray]
_LABELS = ("building_id", "tile", "eave_height_m", "angle_deg", "roof_type")


def crop_columns(
    cloud: Cloud,
    cropped: CloudCrops,
    polygons: Polygons,
    origin_xy_m: np.ndarray,
    on_roof: np.ndarray,
    settings: Crops,
    num_excluded: Counter[str],
) -> tuple[np.ndarray, dict[str, Any]]:
    """The indices of the polygons that get a row, and their columns of :data:`p2wss.storage.schemas.crops.CROPS`.

    cropped: the crops of ``polygons`` from ``cloud``. origin_xy_m: float64 (num_polygons, 2). on_roof: bool
    (num_pairs,), which of the cropped points are on the roof of their building. Polygons that are too large or have too
    few points are excluded, and added to ``num_excluded``.
    """
    offset = cropped.offset
    num_pairs = np.diff(offset)
    local = polygon_arrays.moved(polygons, -origin_xy_m)
    heights = np.split(cloud.z_m[cropped.point], offset[1:-1])
    origin_z_m = np.round([np.median(z) if len(z) else np.nan for z in heights[: len(polygons)]])

    def relative_cm(value_m: np.ndarray, origin_m: np.ndarray) -> np.ndarray:
        value_cm = np.rint(100 * (value_m[cropped.point] - np.repeat(origin_m, num_pairs)))
        return np.where(np.abs(value_cm) <= 32767, value_cm, _OUT_OF_RANGE).astype(np.int16)

    x_cm = relative_cm(cloud.x_m, origin_xy_m[:, 0])
    y_cm = relative_cm(cloud.y_m, origin_xy_m[:, 1])
    z_cm = relative_cm(cloud.z_m, origin_z_m)
    in_range = z_cm != _OUT_OF_RANGE  # points 300 m above or below the others do not belong to the building

    reach_m = np.abs(local.xy_m).max(axis=1) + settings.buffer_m
    is_large = count_true(reach_m > _MAX_REACH_M, local.vertex_offset) > 0
    has_few = ~is_large & (count_true(in_range, offset) < settings.min_points)
    num_excluded[reasons.TOO_LARGE] += int(is_large.sum())
    num_excluded[reasons.TOO_FEW_POINTS] += int(has_few.sum())
    is_row = ~(is_large | has_few)
    selection = np.flatnonzero(is_row)
    mask = in_range & np.repeat(is_row, num_pairs)
    pairs = slice(None) if mask.all() else mask  # mostly all pairs are used, and none need be copied
    num_points = count_true(in_range, offset)[selection]
    point_offset = np.concatenate([[0], np.cumsum(num_points)])
    footprints = polygon_arrays.take(local, selection)
    shapes = polygon_arrays.to_geometries(footprints)
    xy_m, is_on = np.column_stack([x_cm[pairs], y_cm[pairs]]) / 100, on_roof[pairs]
    columns = {
        "num_points": num_points.astype(np.int32),
        "origin_x_m": origin_xy_m[selection, 0],
        "origin_y_m": origin_xy_m[selection, 1],
        "origin_z_m": origin_z_m[selection],
        "x_cm": files.ragged(x_cm[pairs], point_offset),
        "y_cm": files.ragged(y_cm[pairs], point_offset),
        "z_cm": files.ragged(z_cm[pairs], point_offset),
        "classification": files.ragged(cloud.classification[cropped.point[pairs]], point_offset),
        **polygon_arrays.to_columns(footprints, np.zeros((len(selection), 2))),
        "ground_z_m": cropped.ground_z_m[selection],
        "num_roof_points": count_true(on_roof & in_range, offset)[selection].astype(np.int32),
        "visible_roof_share": np.array(
            [
                seen_share(shape, *xy_m[first:last][is_on[first:last]].T)
                for shape, (first, last) in zip(shapes, pairwise(point_offset), strict=True)
            ],
            np.float32,
        ),
    }
    return selection, columns


def count_true(mask: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Number of true values of ``mask`` in each slice ``offset[i]:offset[i + 1]``, int64 (len(offset) - 1,)."""
    return np.diff(np.concatenate([[0], np.cumsum(mask)])[offset])


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


def scan_of(path: Path, crs: str) -> Scan:
    """The scan in a file (:func:`p2wss.clouds.scan_files.read_scan`). Raises :class:`InputError` if its CRS is not
    ``crs``, the CRS of the buildings."""
    scan = read_scan(path)
    check_crs(scan[0].crs, crs, path, "the footprints are", "reproject one of them")
    return scan


def crop_simulated(buildings: pa.Table, scan: Scan, settings: Crops) -> tuple[dict[str, Any], Counter[str]]:
    """The columns of :data:`p2wss.storage.schemas.crops.CROPS` with labels, and the number of excluded buildings per
    reason.

    buildings: the columns of :data:`p2wss.storage.schemas.buildings.BUILDINGS`. Buildings in the margin of the tile are
    not cropped, but may make buildings of the tile guards (:func:`p2wss.crops.rows.assign_splits`). scan: see
    :func:`scan_of`.
    """
    cloud, building_of_point, face_of_point = scan
    polygons = polygon_arrays.in_crs(buildings)
    split = assign_splits(polygons, settings)
    num_excluded: Counter[str] = Counter()
    tile_rows = np.flatnonzero(buildings["in_tile"].to_numpy())
    status = np.array(buildings["status"].to_pylist(), dtype=object)[tile_rows]
    num_excluded.update(status[status != "ok"].tolist())
    rows = tile_rows[status == "ok"]

    footprints = polygon_arrays.take(polygons, rows)
    cropped = crop_cloud(cloud, footprints, settings.buffer_m)
    is_own = building_of_point[cropped.point] == np.repeat(rows, np.diff(cropped.offset))
    kind = np.where(is_own, face_of_point[cropped.point] & 3, 0)
    on_roof = (kind == FaceKind.ROOF) | (kind == FaceKind.FLAT)
    on_wall = kind == FaceKind.WALL
    origin_xy_m = np.column_stack([buildings["origin_x_m"].to_numpy(), buildings["origin_y_m"].to_numpy()])
    selection, columns = crop_columns(
        cloud, cropped, footprints, origin_xy_m[rows], on_roof, settings, num_excluded
    )
    labels = buildings.take(rows[selection])
    columns |= {name: labels[name].combine_chunks() for name in _LABELS}
    columns |= {
        "label_terrain_z_m": labels["terrain_z_m"].combine_chunks(),
        "split": split[rows[selection]],
        "num_wall_points": count_true(on_wall, cropped.offset)[selection].astype(np.int32),
    }
    return columns, num_excluded


def assign_splits(polygons: Polygons, settings: Crops) -> np.ndarray:
    """The split of each polygon: "train", "val", "test" or "guard" (object array).

    polygons: in the CRS, not in local coordinates. The block of a polygon is that of its centroid. In every group of 5
    by 2 blocks, one block is drawn for val and another for test, so that the shares approach 80, 10 and 10 percent of a
    large area. A val or test building closer than ``guard_m`` to a building of another split becomes guard and is not
    used. A polygon without rings is guard too. If ``settings.split`` names a split, all other polygons are in it.
    """
    shapes = polygon_arrays.to_geometries(polygons)
    split = np.full(len(shapes), "guard", dtype=object)
    rows = np.flatnonzero(~shapely.is_empty(shapes))
    if settings.split != "blocks":
        split[rows] = settings.split
        return split
    shapes = shapes[rows]
    centroid = shapely.centroid(shapes)
    block = np.floor(shapely.get_coordinates(centroid) / settings.block_size_m).astype(np.int64)
    group, position = block // [5, 2], block % [5, 2]
    groups, group_index = np.unique(group, axis=0, return_inverse=True)
    # per group of blocks: the numbers (0 to 9) of its val block and of its test block
    val_and_test = np.array(
        [generator(settings.seed, "crops", "split", x, y).permutation(10)[:2] for x, y in groups.tolist()]
    ).reshape(-1, 2)[group_index.ravel()]
    number = position[:, 0] + 5 * position[:, 1]
    block_split = np.where(number == val_and_test[:, 0], "val", "train").astype(object)
    block_split[number == val_and_test[:, 1]] = "test"

    held_out = np.flatnonzero(block_split != "train")
    index, neighbour = shapely.STRtree(shapes).query(
        shapes[held_out], predicate="dwithin", distance=settings.guard_m
    )
    index = held_out[index]
    guarded_split = block_split.copy()
    guarded_split[index[block_split[index] != block_split[neighbour]]] = "guard"
    split[rows] = guarded_split
    return split
