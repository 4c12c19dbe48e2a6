"""Real places, simulated again with the same footprints, terrain, flight lines and densities.

Clouds of different flights differ most by the angle from which they see walls. Here this angle is the same, so
differences are due to the model. Used by lidar_realism.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyarrow as pa
import rasterio
import shapely
from lidar_scene import building_table

from p2wss.clouds.crops import crop_cloud
from p2wss.clouds.reading import Cloud
from p2wss.config import Clutter, Scans
from p2wss.data import polygon_arrays
from p2wss.data.las_classes import VEGETATION_CLASS
from p2wss.data.terrain import Terrain
from p2wss.scans.caster import cast
from p2wss.scans.clutter import add_clutter
from p2wss.scans.pulses import PARALLEL, Box
from p2wss.scans.scan import build_surface, local_buildings
from p2wss.scans.surface import las_classes
from p2wss.scans.survey import Strip, plan

_ROOF_DEG = 30.0  # of every edge; the metrics look at walls and eaves
_LENGTH_M = 600.0  # of a flight line
_MIN_ROOF_POINTS = 50


@dataclass(frozen=True)
class Twin:
    """The simulated cloud of a place, and the mean angle off nadir of the real points."""

    cloud: Cloud
    mean_angle_deg: float


def simulate_again(laz: Path, dtm: Path, cloud: Cloud, shapes: np.ndarray, clutter: Clutter) -> Twin:
    """Simulate the place of ``cloud``, which was read from ``laz``, with the footprints ``shapes``.

    Each building is a hip roof of 30 degrees on its footprint, whose eaves are where the real roof points
    begin (their 5th percentile).
    """
    buildings = _buildings(cloud, shapes)
    with rasterio.open(dtm) as raster:
        height = raster.read(1).astype(np.float32)
        height[height == raster.nodata] = np.nan
        terrain = Terrain(height, raster.bounds.left, raster.bounds.top, raster.res[0])
    low, high = (np.array([f(cloud.x_m), f(cloud.y_m)]) for f in (np.min, np.max))
    origin = np.floor([*(low + high) / 2, np.nanmedian(height)])
    settings = Scans(preset="hd", density_per_m2=10, density_spread=0, attitude_deg=(0, 0), clutter=clutter)
    surface = build_surface(buildings, terrain, origin, settings)
    surface, _ = add_clutter(surface, local_buildings(buildings, origin, 0), clutter)
    z_low, z_high = surface.z_range_m()
    (x_low, y_low), (x_high, y_high) = low - origin[:2], high - origin[:2]
    box = Box(x_low, y_low, x_high, y_high, z_low - 0.1, z_high + 0.1)
    strips, angle_deg = _strips_of_file(laz, origin, box, plan(settings, 0, box, box).strips[0])
    points, _ = cast(surface, strips, box)
    x, y, z = (points.xyz_mm[:, i] / 1000 + origin[i] for i in range(3))
    simulated = Cloud(x, y, z, las_classes(points.face), None)
    return Twin(simulated, float(np.abs(angle_deg).mean()))


def wall_depths_m(cloud: Cloud, shapes: np.ndarray) -> np.ndarray:
    """Distances up to 1 m of points below the eaves from the edge of their footprint, float64 (n,).

    Below the eaves: 1 m above the ground or more, 0.7 m below the 5th percentile of the roof's points.
    """
    cropped = crop_cloud(cloud, polygon_arrays.to_polygons(shapes), 0.0)
    depths = [np.zeros(0)]
    for row, shape in enumerate(shapes):
        index = cropped.of(row)
        above = cloud.z_m[index] - cropped.ground_z_m[row]
        is_solid = cloud.classification[index] != VEGETATION_CLASS
        on_roof = (above > 2) & is_solid
        if on_roof.sum() >= _MIN_ROOF_POINTS:
            eave = np.percentile(above[on_roof], 5)
            below = index[(above > 1) & (above < eave - 0.7) & is_solid]
            points = shapely.points(cloud.x_m[below], cloud.y_m[below])
            depths.append(shapely.distance(shape.boundary, points))
    joined = np.concatenate(depths)
    return joined[joined < 1]


def _buildings(cloud: Cloud, shapes: np.ndarray) -> pa.Table:
    """The buildings of a place that have enough roof points, as a table of the stage buildings."""
    cropped = crop_cloud(cloud, polygon_arrays.to_polygons(shapes), 0.0)
    rows, eave_m = [], []
    for row in range(len(shapes)):
        index = cropped.of(row)
        above = cloud.z_m[index] - cropped.ground_z_m[row]
        on_roof = (above > 2) & (cloud.classification[index] != VEGETATION_CLASS)
        if on_roof.sum() >= _MIN_ROOF_POINTS:
            rows.append(row)
            eave_m.append(np.percentile(above[on_roof], 5))
    ground = cropped.ground_z_m[rows]
    num_edges = shapely.get_num_coordinates(shapes[rows]) - shapely.get_num_interior_rings(shapes[rows]) - 1
    return building_table(
        gpd.GeoDataFrame(
            {
                "building_id": [f"B{row}" for row in rows],
                "tile": "twin",
                "in_tile": True,
                "status": "ok",
                "eave_height_m": np.array(eave_m, np.float32),
                "eave_height_source": "hauteur",
                "terrain_z_m": ground,
                "base_z_m": ground - 1,
                "roof_type": "hip",
                "angle_deg": [[_ROOF_DEG] * count for count in num_edges],
            },
            geometry=[shapely.geometry.polygon.orient(shape) for shape in shapes[rows]],
            crs=2154,
        )
    )


def _strips_of_file(laz: Path, origin: np.ndarray, box: Box, model: Strip) -> tuple[list[Strip], np.ndarray]:
    """The strips of a file, estimated from the scan angles of its points; and these angles in degrees.

    The tangent of the angle grows with the distance to the right of the track: by one per altitude. What the file does
    not show is taken from ``model``.
    """
    las = laspy.read(laz)
    is_fine = "scan_angle" in las.point_format.dimension_names
    angle_deg = (
        np.asarray(las.scan_angle) * 0.006 if is_fine else np.asarray(las.scan_angle_rank).astype(float)
    )
    strips = []
    for number in np.unique(las.point_source_id):
        in_strip = np.asarray(las.point_source_id) == number
        xy = np.stack([las.x[in_strip] - origin[0], las.y[in_strip] - origin[1]], axis=1)
        tangent = np.tan(np.radians(angle_deg[in_strip]))
        slope = np.linalg.lstsq(np.column_stack([xy, np.ones(len(xy))]), tangent, rcond=None)[0]
        altitude_m = float(1 / np.hypot(*slope[:2]))
        right, middle = slope[:2] * altitude_m, slope[2]
        ahead = np.array([-right[1], right[0]])
        start = -middle * altitude_m * right - ahead * _LENGTH_M / 2
        area_m2 = (box.x_max_m - box.x_min_m) * (box.y_max_m - box.y_min_m)
        density = (np.asarray(las.return_number)[in_strip] == 1).sum() / area_m2
        half_angle = radians(max(30.0, float(np.abs(angle_deg[in_strip]).max()) + 1))
        speed = model.path.speed_m_per_s
        rotation = np.array([ahead[0], -ahead[1], 0, ahead[1], ahead[0], 0, 0, 0, 1])
        path = model.path._replace(
            pattern=PARALLEL,
            half_angle_rad=half_angle,
            altitude_m=altitude_m,
            start_x_m=float(start[0]),
            start_y_m=float(start[1]),
            heading_rad=float(np.arctan2(ahead[1], ahead[0])),
            duration_s=_LENGTH_M / speed,
            # the place gets only the pulses at angles of its own distance from the track
            pulse_rate_hz=float(density * speed * 2 * half_angle * altitude_m * (1 + middle**2)),
            scan_rate_hz=float(np.sqrt(density) * speed),
            knots=np.tile(np.concatenate([np.zeros(3), rotation]), (int(_LENGTH_M / speed / 0.05) + 3, 1)),
        )
        strips.append(Strip(path, model.errors._replace(reference_range_m=altitude_m), 0.0))
    return strips, angle_deg
