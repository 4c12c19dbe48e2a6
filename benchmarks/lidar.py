"""Speed, memory and realism of the simulated LiDAR and of cropping, against peers in the same run.

    python benchmarks/lidar.py [--quick] [--data FOLDER]

Speeds are CPU time of one core. The scene is 1 km2 of terrain with 5,000 buildings under about 10 million
pulses; --quick takes a sixteenth of it, whose times mean little. FOLDER holds real LiDAR (default:
../shared/data; what is absent is skipped). The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
# where memory is fragmented, the kernel tidies it up for each huge page that numpy asks for: 1.5 s per scene
os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")

import geopandas as gpd
import numpy as np
import pyarrow as pa
import pyproj
import shapely
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from figures import Figures, peak_mib
from lidar_twins import twin, wall_depths_m
from scipy.spatial import cKDTree

from p2wss import crops, scans
from p2wss.buildings import build_scene
from p2wss.config import Buildings, Clutter, Crops, Scans
from p2wss.crops import crop
from p2wss.data import files, polygon_arrays
from p2wss.data import points as points_module
from p2wss.data.clouds import Cloud, read_clouds
from p2wss.data.cropping import crop_points
from p2wss.data.points import crop_cloud
from p2wss.data.schemas.buildings import BUILDINGS
from p2wss.data.schemas.crops import CROPS
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import tile_bounds
from p2wss.scans import caster
from p2wss.scans import scan as scan_module
from p2wss.scans.hits import Hits, empty_hits
from p2wss.scans.surface import las_classes

ROOT = Path(__file__).resolve().parents[1]
TILE, TILE_SIZE_M, MARGIN_M = "0652_6862", 1000.0, 60.0
BARE = Clutter(
    dormer_share=0,
    chimney_share=0,
    raised_part_share=0,
    parapet_share=0,
    skylight_share=0,
    annex_share=0,
    trees_per_building=0,
    shade_share=0,
    lower_part_share=0,
    eave_overhang_share=0,
)
BARS = {
    "pulses generated and culled": 0.5,
    "scene built": 2.5,
    "cast": 2.2,
    "noise, drop-out, tags": 0.8,
    "crop": 1.3,
    "shard written": 0.8,
    "whole scene": 8.0,
}


def ground_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 120 + 0.02 * (x - 652_500) + 3 * np.sin(x / 90) * np.cos(y / 70)


def make_terrain(size_m: float) -> Terrain:
    """A rolling raster of 1 m with 3 cm of roughness."""
    x_min, _, x_max, y_max = tile_bounds(TILE, size_m, MARGIN_M)
    steps = np.arange(int(x_max - x_min)) + 0.5
    height = ground_m((x_min + steps)[None, :], (y_max - steps)[:, None])
    height += np.random.default_rng(1).normal(0, 0.03, height.shape)
    return Terrain(height.astype(np.float32), x_min, y_max, 1.0)


def make_buildings(num: int, size_m: float, seed: int = 0) -> pa.Table:
    """Rectangles and L-shapes of 50 to 120 m2 with gable, hip and flat roofs, all over the tile."""
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
        middle = x_min + (k % side + 0.5) * step, y_min + (k // side + 0.5) * step
        shapes.append(shapely.affinity.translate(shape, *middle))
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
            "ground_z_m": ground,
            "base_z_m": ground - 1,
            "roof_type": types,
            "angle_deg": angles,
        },
        geometry=shapes,
        crs=2154,
    )
    columns = build_scene(scene, Buildings())
    return pa.table({f.name: pa.array(columns[f.name], f.type) for f in BUILDINGS}, schema=BUILDINGS)


def settings(preset: str = "hd", seed: int = 0, **changes: Any) -> Scans:
    """A survey of about 10 million pulses per km2."""
    return Scans(
        preset=preset, seed=seed, density_per_m2=9.8, density_spread=0, **({"clutter": BARE} | changes)
    )


class Meter:
    """CPU seconds per name: wraps functions, sums what their calls take."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._undo: list[tuple[Any, str, Any]] = []

    def watch(self, owner: Any, name: str, label: str) -> None:
        original = getattr(owner, name)

        def timed(*arguments: Any, **named: Any) -> Any:
            start = time.thread_time()
            try:
                return original(*arguments, **named)
            finally:
                self.seconds[label] = self.seconds.get(label, 0.0) + time.thread_time() - start

        setattr(owner, name, timed)
        self._undo.append((owner, name, original))

    def stop(self) -> None:
        for owner, name, original in reversed(self._undo):
            setattr(owner, name, original)


def as_cloud(scan: scans.Scan) -> tuple[Cloud, np.ndarray, np.ndarray]:
    """What ``crops.read_scan`` reads of the scan's file."""
    xyz = [scan.points.xyz_mm[:, i] * 0.001 for i in range(3)]
    for column, origin in zip(xyz, scan.origin_m, strict=True):
        column += origin
    cloud = Cloud(*xyz, las_classes(scan.points.face), pyproj.CRS(2154), scan.points.strip)
    return cloud, scan.points.building, scan.points.face


def whole_scene(
    buildings: pa.Table, terrain: Terrain, size_m: float, folder: Path, keep_scan: bool = False
) -> dict[str, Any]:
    """One scene from buildings to shard, with the seconds of each step."""
    meter = Meter()
    meter.watch(scan_module, "build_surface", "scene built")
    meter.watch(caster.Caster, "__init__", "scene built")
    meter.watch(caster, "blocks_over", "pulses generated and culled")
    meter.watch(caster, "generate", "pulses generated and culled")
    meter.watch(caster.Caster, "first_hits", "cast")
    meter.watch(caster, "record", "noise, drop-out, tags")
    meter.watch(points_module, "crop_points", "crop")
    begin = time.process_time()
    scan = scans.simulate(buildings, terrain, TILE, size_m, settings())
    simulated = time.process_time() - begin
    cloud, facts = as_cloud(scan), scan.facts
    kept = scan if keep_scan else None
    del scan  # in the pipeline the crop is a process of its own
    start = time.process_time()
    columns, _ = crops.crop_simulated(buildings, cloud, Crops())
    cropped = time.process_time() - start
    start = time.process_time()
    files.write_table(folder / "shard.parquet", columns, CROPS, {})
    meter.seconds["shard written"] = time.process_time() - start
    total = time.process_time() - begin
    meter.stop()
    return {
        "steps": meter.seconds | {"whole scene": total},
        "simulated": simulated,
        "cropped": cropped,
        "pulses": facts["pulses"]["cast"],
        "points": facts["num_points"],
        "scan": kept,
        "cloud": cloud,
    }


def peers_of_the_cast(
    buildings: pa.Table, terrain: Terrain, size_m: float, num_slow: int
) -> tuple[float, float, float, dict[str, float]]:
    """Speed relative to embreex alone, to trimesh, to trimesh when both build their trees first; and million
    rays per CPU-second of each.

    embreex gets the same rays in the same chunks and all triangles, the terrain's too, and answers in float32;
    ours asks it for the buildings' triangles only, walks the terrain and locates every point in float64.
    trimesh gets ``num_slow`` of the rays in one call with its default arguments, which find all hits of a ray.
    """
    surfaces, rays = [], []
    original = caster.Caster.first_hits

    def keep(self: caster.Caster, origin: np.ndarray, direction: np.ndarray, hits: Hits) -> None:
        if len(origin) and len(rays) < 40:
            rays.append((origin.copy(), direction.copy()))
            surfaces.append(self.surface)
        original(self, origin, direction, hits)

    caster.Caster.first_hits = keep
    scans.simulate(buildings, terrain, TILE, size_m, settings())
    caster.Caster.first_hits = original
    surface, count = surfaces[0], sum(len(origin) for origin, _ in rays)
    grid = surface.terrain
    rows, columns = grid.height_m.shape
    x, y = np.meshgrid(
        grid.x_min_m + np.arange(columns) * grid.cell_m, grid.y_max_m - np.arange(rows) * grid.cell_m
    )
    index = np.arange(rows * columns).reshape(rows, columns)
    nw, ne, sw, se = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    ground = np.concatenate(
        [np.stack([nw, sw, se], -1).reshape(-1, 3), np.stack([nw, se, ne], -1).reshape(-1, 3)]
    )
    vertex = np.concatenate([np.stack([x.ravel(), y.ravel(), grid.height_m.ravel()], 1), surface.vertex_m])
    triangle = np.concatenate([ground, surface.triangle + rows * columns]).astype(np.int32)

    start = time.process_time()
    scene = EmbreeScene()
    mesh = TriangleMesh(scene, vertex.astype(np.float32), triangle)
    scene.run(*(a[:1] for a in rays[0]))
    build = time.process_time() - start
    ours, room = caster.Caster(surface), empty_hits(max(len(origin) for origin, _ in rays))
    best = {"ours": np.inf, "embreex": np.inf}
    for _ in range(2):
        start = time.process_time()
        for origin, direction in rays:
            ours.first_hits(origin, direction, Hits(*(column[: len(origin)] for column in room)))
        best["ours"] = min(best["ours"], time.process_time() - start)
        start = time.process_time()
        for origin, direction in rays:
            scene.run(origin, direction, query="INTERSECT", output=1)
        best["embreex"] = min(best["embreex"], time.process_time() - start)
    del mesh
    some = [np.concatenate([ray[i] for ray in rays])[:num_slow].astype(float) for i in range(2)]
    slow = {}
    for name, several in (("trimesh", True), ("trimesh, first hit only", False)):
        both = trimesh.Trimesh(vertex, triangle, process=False)
        start = time.process_time()
        both.ray.intersects_location(some[0][:1], some[1][:1], multiple_hits=several)
        peer_build = time.process_time() - start
        start = time.process_time()
        both.ray.intersects_location(*some, multiple_hits=several)
        slow[name] = num_slow / (time.process_time() - start)
        slow[f"{name}, with its tree"] = num_slow / (time.process_time() - start + peer_build)
    start = time.process_time()
    caster.Caster(surface)
    own_build = time.process_time() - start
    speed = {name: count / seconds for name, seconds in best.items()}
    rates = {name: round(rate / 1e6, 2) for name, rate in (speed | slow).items()}
    print(f"  embreex and {len(triangle):,} triangles: {build:.2f} s to build its tree")
    with_tree = num_slow / (own_build + num_slow / speed["ours"]) / slow["trimesh, with its tree"]
    return speed["ours"] / speed["embreex"], speed["ours"] / slow["trimesh"], with_tree, rates


def peers_of_the_crop(buildings: pa.Table, cloud: Cloud, num: int) -> tuple[float, bool]:
    """How many times as fast as shapely on ``num`` points in a strip of the scene, and whether the same."""
    polygons = crop._absolute(buildings)
    start = time.process_time()
    crop_points(cloud.x_m, cloud.y_m, polygons, 1.0)
    ours = len(cloud) / (time.process_time() - start)
    first = np.argsort(cloud.y_m, kind="stable")[:num]
    x, y = cloud.x_m[first], cloud.y_m[first]
    point, _, offset = crop_points(x, y, polygons, 1.0)
    shapes = polygon_arrays.to_geometries(polygons)
    start = time.process_time()
    found, polygon = shapely.STRtree(shapes).query(shapely.points(x, y), predicate="dwithin", distance=1.0)
    peer = num / (time.process_time() - start)
    mine = np.repeat(np.arange(len(polygons)), np.diff(offset)) * num + point
    same = np.array_equal(np.sort(mine), np.sort(polygon * num + found))
    return ours / peer, same


def two_at_once(quick: bool) -> dict[str, float]:
    """Wall and CPU seconds of one scene, the larger of two in two processes at once, and their peak memory.

    On a machine that does something else too, wall time tells little; the CPU time tells what the two cost each
    other in caches and memory.
    """

    def run(num: int) -> dict[str, float]:
        command = [sys.executable, __file__, "--one", *(["--quick"] if quick else [])]
        started = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(num)]
        answers = [json.loads(process.communicate()[0].splitlines()[-1]) for process in started]
        return {name: max(answer[name] for answer in answers) for name in answers[0]}

    one, two = run(1), run(2)
    return {
        "wall_one_s": one["wall_s"],
        "wall_two_s": two["wall_s"],
        "cpu_one_s": one["cpu_s"],
        "cpu_two_s": two["cpu_s"],
        "peak_gb": two["peak_gb"],
    }


def one_scene(num: int, size_m: float) -> dict[str, float]:
    """A scene in this process: wall and CPU seconds from buildings to shard, and peak memory."""
    buildings, terrain = make_buildings(num, size_m), make_terrain(size_m)
    with tempfile.TemporaryDirectory() as folder:
        warm_up(Path(folder))
        start, cpu = time.perf_counter(), time.process_time()
        whole_scene(buildings, terrain, size_m, Path(folder))
        return {
            "wall_s": time.perf_counter() - start,
            "cpu_s": time.process_time() - cpu,
            "peak_gb": peak_mib() / 1024,
        }


def warm_up(folder: Path) -> None:
    """Compile everything that is measured."""
    whole_scene(make_buildings(9, 100.0), make_terrain(100.0), 100.0, folder)


# --- realism ---

COLUMNS = (
    "density mean",
    "p5",
    "p95",
    "spacing m",
    "wall share",
    "walls seen",
    "roof noise m",
    "class 5",
    "returns",
    "strips",
)


def realism(
    cloud: Cloud, shapes: np.ndarray, on_wall: np.ndarray | None = None, num_returns: np.ndarray | None = None
) -> list[float]:
    """The figures of :data:`COLUMNS`, measured alike for simulated and real clouds.

    Density: points per m2 in cells of 2 m that hold any. Spacing: median distance in the plane to the nearest
    point. Walls: points within 0.5 m of a footprint's edge, at least 1 m above the ground and 0.7 m below the
    lowest twentieth of its roof's points; their share of wall and roof points, and the number of edges with
    10 of them, per building. Roof noise: median distance to a plane through the 15 nearest roof points.
    """
    cells, counts = np.unique(
        (np.stack([cloud.x_m, cloud.y_m], 1) // 2).astype(np.int64), axis=0, return_counts=True
    )
    del cells
    density = counts / 4
    rng = np.random.default_rng(0)
    some = rng.choice(len(cloud), min(len(cloud), 20_000), replace=False)
    xy = np.stack([cloud.x_m, cloud.y_m], 1)
    distance, _ = cKDTree(xy).query(xy[some], 2)
    walls, roofs, seen, noise = 0, 0, [], []
    if len(shapes):
        polygons = polygon_arrays.to_polygons(shapes)
        cropped = crop_cloud(cloud, polygons, 0.5)
        for p, shape in enumerate(shapes):
            own = cropped.of(p)
            inside = cropped.inside[cropped.offset[p] : cropped.offset[p + 1]]
            ground = cropped.ground_z_m[p]
            above = cloud.z_m[own] - ground
            solid = cloud.classification[own] != 5
            high = inside & (above > 2) & solid
            if high.sum() < 50 or not np.isfinite(ground):
                continue
            eave = np.percentile(above[high], 5)
            x, y = cloud.x_m[own], cloud.y_m[own]
            ring = np.asarray(shape.exterior.coords)[:, :2]
            candidates = np.flatnonzero((above > 1) & (above < eave - 0.7) & solid)
            at = shapely.points(x[candidates], y[candidates])
            edges = shapely.linestrings(np.stack([ring[:-1], ring[1:]], 1))
            away = shapely.distance(at[:, None], edges[None, :]) if len(at) else np.ones((0, len(edges)))
            near = away.min(axis=1, initial=np.inf) < 0.5
            nearest = away[near].argmin(axis=1) if near.any() else np.zeros(0, int)
            walls += int(near.sum())
            roofs += int((inside & (above >= eave)).sum())
            seen.append(int((np.bincount(nearest, minlength=1) >= 10).sum()))
            core = np.flatnonzero(high & (above > eave))
            roof = np.stack([x[core], y[core], above[core]], 1)
            roof = roof[rng.choice(len(roof), min(len(roof), 300), replace=False)]
            noise += _plane_residuals(roof)
    return [
        float(density.mean()),
        *(float(v) for v in np.percentile(density, [5, 95])),
        float(np.median(distance[:, 1])),
        walls / max(walls + roofs, 1) if seen else np.nan,
        float(np.mean(seen)) if seen else np.nan,
        float(np.median(noise)) if noise else np.nan,
        float((cloud.classification == 5).mean()),
        float(num_returns.mean()) if num_returns is not None else np.nan,
        float(len(np.unique(cloud.strip))) if cloud.strip is not None else np.nan,
    ]


def _plane_residuals(xyz: np.ndarray) -> list[float]:
    """Standard deviation about a plane through the 15 nearest points, for the flatter half of the places."""
    if len(xyz) < 30:
        return []
    _, index = cKDTree(xyz[:, :2]).query(xyz[:, :2], 15)
    near = xyz[index] - xyz[index].mean(axis=1, keepdims=True)
    smallest = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", near, near))[:, 0]
    sigma = np.sqrt(np.maximum(smallest, 0) / (15 - 3))
    return np.sort(sigma)[: len(sigma) // 2].tolist()


def real_clouds(data: Path) -> dict[str, list[float]]:
    """The same figures for the real clouds that are there."""
    import laspy

    rows = {}
    for name, folder, file, crs in (
        ("Delft AHN3", "delft_ahn3", "ahn3.laz", 28992),
        ("Bresse IGN", "bresse_ign", "lidar.laz", 2154),
    ):
        path = data / folder / file
        if not path.exists():
            print(f"  {name}: not here, skipped")
            continue
        frame = gpd.read_file(data / folder / "footprints.gpkg")
        frame = frame.set_crs(crs, allow_override=True) if frame.crs is None else frame
        frame = frame.assign(geometry=shapely.force_2d(frame.geometry.to_numpy())).explode(index_parts=False)
        returns = np.asarray(laspy.read(path).num_returns)
        cloud, shapes = read_clouds([path]), frame.geometry.to_numpy()
        again, simulated_returns, angle_deg = twin(path, data / folder / "dtm.asc", cloud, shapes, Clutter())
        name = f"{name}, {angle_deg:.0f} deg"
        rows[name] = realism(cloud, shapes, num_returns=returns)
        rows[f"{name}, simulated"] = realism(again, shapes, num_returns=simulated_returns)
        depth = np.percentile(wall_depths_m(cloud, shapes), [10, 50, 90])
        print(
            f"  {name}: points below the eaves are {depth[0]:.2f} to {depth[2]:.2f} m inside the footprint, "
            f"{depth[1]:.2f} m in the median"
        )
    for path in sorted((data / "lidarhd_crops").glob("*_IGN69.laz")):
        returns = np.asarray(laspy.read(path).num_returns)
        rows[f"LiDAR HD {path.name[:12]}"] = realism(
            read_clouds([path]), np.array([], dtype=object), num_returns=returns
        )
    return rows


def simulated_clouds(size_m: float) -> dict[str, list[float]]:
    """The same figures for each preset, ``hd`` on several surveys, in the configuration's density."""
    buildings, terrain = make_buildings(int(0.0025 * size_m**2), size_m), make_terrain(size_m)
    shapes = polygon_arrays.to_geometries(crop._absolute(buildings))
    rows = {}
    cases = [("none", {}), ("paper", {}), ("hd, no clutter", {"clutter": BARE})]
    for seed in range(4):
        cases.append((f"hd, survey {seed}", {"seed": seed}))
    cases.append(("hd, 7 returns", {"max_returns": 7}))
    for name, changes in cases:
        scan = scans.simulate(
            buildings,
            terrain,
            TILE,
            size_m,
            Scans(**({"preset": name.split(",")[0], "density_per_m2": None} | changes)),
        )
        cloud, _, _ = as_cloud(scan)
        survey = scan.facts["survey"]
        rows[f"{name} ({survey['pattern']})"] = realism(cloud, shapes, num_returns=scan.points.num_returns)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    arguments = parser.parse_args()
    num, size_m = (312, 250.0) if arguments.quick else (5000, TILE_SIZE_M)
    if arguments.one:
        print(json.dumps(one_scene(num, size_m)))
        return 0

    figures = Figures()
    buildings, terrain = make_buildings(num, size_m), make_terrain(size_m)
    with tempfile.TemporaryDirectory() as folder:
        warm_up(Path(folder))
        result = whole_scene(buildings, terrain, size_m, Path(folder), keep_scan=True)
        steps = result["steps"]
        print(f"{result['pulses']:,} pulses, {result['points']:,} points, preset hd without clutter")
        for name, bar in BARS.items():
            figures.at_most(f"{name}, CPU s", steps[name], bar)
        print(f"of the whole: simulated {result['simulated']:.2f} CPU s, cropped {result['cropped']:.2f}")
        figures.at_least("cast, M rays per CPU-second", result["pulses"] / steps["cast"] / 1e6, 4.5)

        # the file between the stages is no step of the bar
        start = time.process_time()
        scans.write_scan(Path(folder) / "scan.laz", result["scan"], pyproj.CRS(2154))
        written = time.process_time() - start
        start = time.process_time()
        crops.read_scan(Path(folder) / "scan.laz")
        read = time.process_time() - start
        print(f"LAZ between the stages, in no bar: written {written:.2f} s, read {read:.2f} s")

    cloud = result["cloud"][0]
    crop_ratio, crop_same = peers_of_the_crop(buildings, cloud, min(len(cloud), 500_000))
    figures.at_least("crop, times the speed of shapely dwithin", crop_ratio, 8)
    figures.at_least("crop, the same result", crop_same, 1)
    del result, cloud
    embreex_ratio, trimesh_ratio, tree_ratio, rates = peers_of_the_cast(
        buildings, terrain, size_m, 100_000 if arguments.quick else 1_000_000
    )
    print(f"M rays per CPU-second: {rates}; trees and rays, times trimesh's: {tree_ratio:.1f}")
    figures.at_least("cast, share of the speed of embreex alone", embreex_ratio, 0.85)
    figures.at_least("cast, times the speed of trimesh intersects_location", trimesh_ratio, 10)

    for name, changes in (
        ("clutter", {"clutter": Clutter()}),
        ("clutter, 5 returns", {"clutter": Clutter(), "max_returns": 5}),
    ):
        start = time.process_time()
        scans.simulate(buildings, terrain, TILE, size_m, settings(**changes))
        print(f"simulated with {name}, in no bar: {time.process_time() - start:.2f} s")

    pair = two_at_once(arguments.quick)
    for kind in ("wall", "cpu"):
        one, two = pair[f"{kind}_one_s"], pair[f"{kind}_two_s"]
        print(f"{kind} time: one scene {one:.1f} s, two at once {two:.1f} s: {two / one:.2f} times")
    # means something on a machine that does nothing else
    figures.at_most(
        "two scenes at once, times the wall time of one", pair["wall_two_s"] / pair["wall_one_s"], 1.25
    )
    figures.at_most("peak memory of one scene, GB", pair["peak_gb"], 1.5)

    print(f"\n{'realism':<34}" + "".join(f"{name:>14}" for name in COLUMNS))
    table = simulated_clouds(250.0) | real_clouds(arguments.data)
    for name, row in table.items():
        print(f"{name:<34}" + "".join(f"{value:>14.3f}" for value in row))
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
