"""Fetch footprints, terrain and LiDAR of a place into a folder."""

from pathlib import Path
from typing import NamedTuple

import pyproj

from p2wss.config import Config
from p2wss.data.crs import bounds_in_crs, parsed_crs
from p2wss.data.terrain import write_terrain
from p2wss.data.tiling import Bounds, are_near, grown, tile_bounds, tiles_of_bounds
from p2wss.fetching.bdtopo import write_footprints
from p2wss.fetching.cloud import write_cloud
from p2wss.fetching.source import delivery_window, known_height_share, open_source, read_buildings
from p2wss.storage import files
from p2wss.storage.messages import InputError, log


class Fetched(NamedTuple):
    """The files of a place, in the CRS of the region.

    Attributes
    ----------
    footprints : Path
        A GeoPackage.
    terrain : Path
        A GeoTIFF.
    clouds : list of Path
        LAZ.
    """

    footprints: Path
    terrain: Path
    clouds: list[Path]


def fetch_area(bbox: Bounds, crs: str, folder: Path, config: Config) -> Fetched:
    """See :func:`p2wss.fetch`."""
    bounds = bounds_in_region(bbox, crs, config.region.crs)
    region = config.region.model_copy(update={"bounds_m": bounds})
    source = open_source(region, config.fetch, folder / "downloads")
    frame = read_buildings(source, region, config.fetch, bounds, f"{_text(bounds)} of {region.crs}")
    log.info("%d buildings from %s", len(frame), source.name)
    west, south, east, north = frame.total_bounds.tolist()  # a building at the border is fetched whole
    whole = min(bounds[0], west), min(bounds[1], south), max(bounds[2], east), max(bounds[3], north)
    around = grown(whole, config.fetch.margin_m)
    facts = files.provenance(crs=region.crs, bounds_m=list(bounds))
    result = Fetched(folder / "footprints.gpkg", folder / "terrain.tif", [folder / "lidar.laz"])
    write_footprints(result.footprints, frame, facts)
    terrain = source.dtm(around)
    known_height_share(terrain, bounds, f"terrain of {_text(bounds)}")
    write_terrain(result.terrain, terrain, region.crs, facts)
    cloud_crs, window = delivery_window(region, config.fetch, around)
    tiles = [tile_bounds(tile, region.tile_size_m) for tile in tiles_of_bounds(whole, region.tile_size_m)]
    # a file may be of several tiles
    paths = dict.fromkeys(path for tile in tiles for path in source.lidar(tile))
    num_points = write_cloud(result.clouds[0], list(paths), window, cloud_crs)
    log.info("%d points from %s", num_points, ", ".join(path.name for path in paths))
    return result


def bounds_in_region(bbox: Bounds, crs: str, region_crs: str) -> Bounds:
    """A box in the CRS of the region. Raises :class:`InputError` for an empty box, and for one that cannot be in
    ``crs`` or lies where the CRS of the region is not used."""
    stated = parsed_crs(crs, "crs")
    x_min, y_min, x_max, y_max = bbox
    if x_min >= x_max or y_min >= y_max:
        raise InputError(f"bbox {_text(bbox)}: is empty; state x_min, y_min, x_max, y_max")
    in_degrees = x_min >= -180 and x_max <= 180 and y_min >= -90 and y_max <= 90
    if stated.is_geographic != in_degrees:
        unit = "degrees" if stated.is_geographic else "metres"
        raise InputError(f"bbox {_text(bbox)}: not in {unit}, as {stated.name} requires; state its CRS")
    area = pyproj.CRS.from_user_input(region_crs).area_of_use
    if area is not None and not are_near(area.bounds, bounds_in_crs(bbox, stated, "EPSG:4326"), 0):
        unit = "degrees (longitude, latitude)" if in_degrees else "metres"
        raise InputError(f"{_text(bbox)}: {unit} outside {area.name}, where {region_crs} is used")
    return bounds_in_crs(bbox, stated, region_crs)


def bounds_of_bbox(bbox: Bounds, crs: str) -> Bounds:
    """A box in metres of a projected CRS, from a box in it or in degrees of longitude and latitude. A box counts as
    degrees if its coordinates can be: in metres, only one at the origin of the CRS could be mistaken. Raises
    :class:`InputError` for an impossible box, or where the CRS is not used."""
    in_metres = max(map(abs, bbox[::2])) > 180 or max(map(abs, bbox[1::2])) > 90
    return bounds_in_region(bbox, crs if in_metres else "EPSG:4326", crs)


def bounds_around(place: tuple[float, float], radius_m: float, crs: str) -> Bounds:
    """A square with sides of twice ``radius_m`` in a projected CRS around a place: latitude and longitude in degrees,
    in the order of maps, or x and y in metres of the CRS. Raises :class:`InputError` where the CRS is not used."""
    x, y = place
    if abs(x) <= 90 and abs(y) <= 180:
        west, south, east, north = bounds_of_bbox((y - 1e-9, x - 1e-9, y + 1e-9, x + 1e-9), crs)
        x, y = (west + east) / 2, (south + north) / 2
    return bounds_of_bbox(grown((x, y, x, y), radius_m), crs)


def _text(bounds: Bounds) -> str:
    return ", ".join(f"{value:.10g}" for value in bounds)
