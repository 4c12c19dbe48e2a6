"""The scene of lidar.py: terrain, buildings and settings made from a formula, and the pipeline on it. Used by lidar.py
and its other parts."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyarrow as pa
import pyproj
import shapely

from p2wss.clouds import crops as cloud_crops
from p2wss.clouds.reading import Cloud
from p2wss.config import Buildings, Clutter, Crops, Scans
from p2wss.crops.rows import crop_simulated
from p2wss.data import polygon_arrays
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import tile_bounds
from p2wss.scans import caster
from p2wss.scans import scan as scan_module
from p2wss.scans.surface import las_classes
from p2wss.scenes.buildings import build_scene
from p2wss.skeleton.types import Polygons
from p2wss.storage import files
from p2wss.storage.schemas.buildings import BUILDINGS
from p2wss.storage.schemas.crops import CROPS

TILE, TILE_SIZE_M, MARGIN_M = "0652_6862", 1000.0, 60.0
CRS = pyproj.CRS(2154)
NO_CLUTTER = Clutter(
    dormer_share=0,
    chimney_share=0,
    annex_share=0,
    trees_per_building=0,
    eave_overhang_share=0,
)


def settings(preset: str = "hd", seed: int = 0, **changes: Any) -> Scans:
    """A survey of about 10 million pulses per km2, without clutter unless ``changes`` ask for it."""
    values: dict[str, Any] = {"density_per_m2": 9.8, "density_spread": 0, "clutter": NO_CLUTTER}
    return Scans(preset=preset, seed=seed, **(values | changes))


def ground_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of rolling terrain at x, y in the CRS, metres above sea level."""
    return 120 + 0.02 * (x - 652_500) + 3 * np.sin(x / 90) * np.cos(y / 70)


def make_terrain(size_m: float) -> Terrain:
    """A raster of 1 m of that terrain, with 3 cm of roughness, for a tile of ``size_m`` and its margin."""
    x_min, _, x_max, y_max = tile_bounds(TILE, size_m, MARGIN_M)
    steps = np.arange(int(x_max - x_min)) + 0.5
    height = ground_m((x_min + steps)[None, :], (y_max - steps)[:, None])
    height += np.random.default_rng(1).normal(0, 0.03, height.shape)
    return Terrain(height.astype(np.float32), x_min, y_max, 1.0)


def make_buildings(num: int, size_m: float, seed: int = 0) -> pa.Table:
    """``num`` rectangles and L-shapes of 50 to 120 m2 with gable, hip and flat roofs, all over the tile."""
    rng = np.random.default_rng(seed)
    x_min, y_min, _, _ = tile_bounds(TILE, size_m)
    side = int(np.ceil(np.sqrt(num)))
    step = size_m / side
    shapes, angles, types = [], [], []
    for k in range(num):
        a, b = rng.uniform(3.5, 5.5, 2)
        slope = float(rng.integers(20, 46))
        kind = rng.choice(["gable", "hip", "flat", "wing"], p=[0.5, 0.2, 0.15, 0.15])
        corners = [(-a, -b), (a, -b), (a, b), (-a, b)]
        if kind == "wing":
            corners = [(-a, -b), (a, -b), (a, 0), (0, 0), (0, b), (-a, b)]
        shape = shapely.affinity.rotate(shapely.Polygon(corners), rng.uniform(0, 360), origin=(0, 0))
        centre = x_min + (k % side + 0.5) * step, y_min + (k // side + 0.5) * step
        shapes.append(shapely.affinity.translate(shape, *centre))
        angles.append(
            {"gable": [90.0, slope, 90.0, slope], "flat": [0.0] * 4}.get(kind, [slope] * len(corners))
        )
        types.append({"wing": "hip"}.get(kind, kind))
    middle = shapely.get_coordinates(shapely.centroid(np.array(shapes)))
    ground = ground_m(middle[:, 0], middle[:, 1])
    scene = gpd.GeoDataFrame(
        {
            "building_id": [f"B{k:05d}" for k in range(num)],
            "tile": TILE,
            "in_tile": True,
            "status": "ok",
            "eave_height_m": rng.uniform(3, 12, num).astype(np.float32),
            "eave_height_source": "hauteur",
            "terrain_z_m": ground,
            "base_z_m": ground - 1,
            "roof_type": types,
            "angle_deg": angles,
        },
        geometry=shapes,
        crs=2154,
    )
    return building_table(scene)


def building_table(scene: gpd.GeoDataFrame) -> pa.Table:
    """The buildings of a scene as the stage buildings makes them, with the columns of ``BUILDINGS``."""
    columns = build_scene(scene, Buildings())
    return pa.table({f.name: pa.array(columns[f.name], f.type) for f in BUILDINGS}, schema=BUILDINGS)


def footprints(buildings: pa.Table) -> Polygons:
    """The footprints of such a table in its CRS."""
    return polygon_arrays.in_crs(buildings)


def as_cloud(scan: scan_module.Scan) -> tuple[Cloud, np.ndarray, np.ndarray]:
    """What the stage crops reads from the file of a scan: the cloud, building id and face id per point."""
    x_m, y_m, z_m = (scan.points.xyz_mm[:, i] * 0.001 + scan.origin_m[i] for i in range(3))
    cloud = Cloud(x_m, y_m, z_m, las_classes(scan.points.face), CRS)
    return cloud, scan.points.building, scan.points.face


class Meter:
    """CPU seconds by name: wraps functions and adds up what their calls take."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._originals: list[tuple[Any, str, Any]] = []

    def watch(self, owner: Any, name: str, label: str) -> None:
        """Count the calls of ``owner.name`` under ``label`` until :meth:`stop`."""
        original = getattr(owner, name)

        def timed(*arguments: Any, **keywords: Any) -> Any:
            start = time.thread_time()
            try:
                return original(*arguments, **keywords)
            finally:
                self.seconds[label] = self.seconds.get(label, 0.0) + time.thread_time() - start

        setattr(owner, name, timed)
        self._originals.append((owner, name, original))

    def stop(self) -> None:
        """Put the original functions back."""
        for owner, name, original in reversed(self._originals):
            setattr(owner, name, original)


@dataclass(frozen=True)
class Run:
    """One scene from buildings to shard. step_s: CPU seconds by step; simulate_s, crop_s: of the two stages."""

    step_s: dict[str, float]
    simulate_s: float
    crop_s: float
    num_pulses: int
    num_points: int
    cloud: Cloud
    scan: scan_module.Scan | None


def run_scene(
    buildings: pa.Table, terrain: Terrain, size_m: float, folder: Path, keep_scan: bool = False
) -> Run:
    """Simulate and crop one scene and write its shard into ``folder``, with the CPU time of each step."""
    meter = Meter()
    meter.watch(scan_module, "build_surface", "scene built")
    meter.watch(caster.Caster, "__init__", "scene built")
    meter.watch(caster, "blocks_over", "pulses generated and culled")
    meter.watch(caster, "generate", "pulses generated and culled")
    meter.watch(caster.Caster, "first_hits", "cast")
    meter.watch(caster, "record", "noise, drop-out, tags")
    meter.watch(cloud_crops, "crop_points", "crop")
    begin = time.process_time()
    scan = scan_module.simulate(buildings, terrain, TILE, size_m, settings())
    simulate_s = time.process_time() - begin
    points, facts = as_cloud(scan), scan.facts
    returned_scan = scan if keep_scan else None
    del scan  # in the pipeline the crop is a process of its own
    start = time.process_time()
    columns, _ = crop_simulated(buildings, points, Crops())
    crop_s = time.process_time() - start
    start = time.process_time()
    files.write_table(folder / "shard.parquet", columns, CROPS, {})
    meter.seconds["shard written"] = time.process_time() - start
    meter.seconds["whole scene"] = time.process_time() - begin
    meter.stop()
    return Run(
        meter.seconds,
        simulate_s,
        crop_s,
        facts["pulses"]["cast"],
        facts["num_points"],
        points[0],
        returned_scan,
    )


def warm_up(folder: Path) -> None:
    """Compile everything that is measured."""
    run_scene(make_buildings(9, 100.0), make_terrain(100.0), 100.0, folder)
