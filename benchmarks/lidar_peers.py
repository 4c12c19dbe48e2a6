"""The cast against embreex and trimesh, the crop against shapely. Used by lidar.py."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import shapely
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from lidar_scene import TILE, footprints, settings

from p2wss.clouds.cropping import crop_points
from p2wss.clouds.reading import Cloud
from p2wss.data import polygon_arrays
from p2wss.data.terrain import Terrain
from p2wss.scans import scan as scans
from p2wss.scans.caster import CHUNK_PULSES, Caster
from p2wss.scans.hits import Hits, empty_hits
from p2wss.scans.pulses import BLOCK_PULSES, Box, blocks_over, empty_rays, generate
from p2wss.scans.scan import build_surface
from p2wss.scans.surface import Surface
from p2wss.scans.survey import Strip

_MAX_CHUNKS = 40


@dataclass(frozen=True)
class CastComparison:
    """Speed of the cast divided by the speed of embreex alone, of trimesh, and of trimesh where both build their trees
    first; million rays per CPU-second of each."""

    to_embreex: float
    to_trimesh: float
    to_trimesh_with_trees: float
    million_rays_per_s: dict[str, float]


def compare_cast(buildings: pa.Table, terrain: Terrain, size_m: float, num_slow: int) -> CastComparison:
    """The same rays by this cast and by its peers.

    embreex gets the same rays in the same chunks and all triangles, also those of the terrain, and answers in float32;
    this cast passes only the triangles of buildings to Embree, finds the terrain itself and locates every point in
    float64. trimesh gets ``num_slow`` of the rays in one call, with its default arguments, which return all hits of a
    ray.
    """
    scan = scans.simulate(buildings, terrain, TILE, size_m, settings())
    surface = build_surface(buildings, terrain, scan.origin_m, settings())
    low, high = surface.z_range_m()
    half_m = size_m / 2 + settings().keep_margin_m
    rays = _rays(scan.survey.strips, Box(-half_m, -half_m, half_m, half_m, low - 0.1, high + 0.1))
    vertex, triangle = _all_triangles(surface)

    start = time.process_time()
    scene = EmbreeScene()
    mesh = TriangleMesh(scene, vertex.astype(np.float32), triangle)
    scene.run(*(column[:1] for column in rays[0]))
    print(f"  embreex and {len(triangle):,} triangles: {time.process_time() - start:.2f} s to build its tree")
    start = time.process_time()
    caster = Caster(surface)
    build_s = time.process_time() - start

    hits = empty_hits(max(len(origin) for origin, _ in rays))
    best_s = {"this cast": np.inf, "embreex": np.inf}
    for _ in range(2):
        start = time.process_time()
        for origin, direction in rays:
            caster.first_hits(origin, direction, Hits(*(column[: len(origin)] for column in hits)))
        best_s["this cast"] = min(best_s["this cast"], time.process_time() - start)
        start = time.process_time()
        for origin, direction in rays:
            scene.run(origin, direction, query="INTERSECT", output=1)
        best_s["embreex"] = min(best_s["embreex"], time.process_time() - start)
    del mesh
    num_rays = sum(len(origin) for origin, _ in rays)
    speed = {name: num_rays / seconds for name, seconds in best_s.items()}
    slow_rays = [np.concatenate([ray[i] for ray in rays])[:num_slow].astype(float) for i in range(2)]
    slow = _trimesh_speeds(vertex, triangle, *slow_rays)
    with_tree = num_slow / (build_s + num_slow / speed["this cast"])
    return CastComparison(
        speed["this cast"] / speed["embreex"],
        speed["this cast"] / slow["trimesh"],
        with_tree / slow["trimesh, with its tree"],
        {name: round(rate / 1e6, 2) for name, rate in (speed | slow).items()},
    )


def _rays(strips: list[Strip], box: Box) -> list[tuple[np.ndarray, np.ndarray]]:
    """Origins and directions, float32 (n, 3), of the first chunks of the pulses that pass over ``box``."""
    chunks: list[tuple[np.ndarray, np.ndarray]] = []
    for strip in strips:
        blocks = blocks_over(strip.path, strip.path.num_blocks, box)
        step = CHUNK_PULSES // BLOCK_PULSES
        for first in range(0, len(blocks), step):
            if len(chunks) == _MAX_CHUNKS:
                return chunks
            rays = empty_rays(CHUNK_PULSES)
            n = generate(strip.path, blocks[first : first + step], box, rays)
            if n:
                chunks.append((rays.origin[:n], rays.direction[:n]))
    return chunks


def _all_triangles(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and triangles (t, 3) of the terrain and of the buildings."""
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
    return vertex, np.concatenate([ground, surface.triangle + rows * columns]).astype(np.int32)


def _trimesh_speeds(
    vertex: np.ndarray, triangle: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> dict[str, float]:
    """Rays per CPU-second of trimesh, with all hits of a ray and with the first only, without and with the
    time to build its tree."""
    speeds = {}
    for name, all_hits in (("trimesh", True), ("trimesh, first hit only", False)):
        mesh = trimesh.Trimesh(vertex, triangle, process=False)
        start = time.process_time()
        mesh.ray.intersects_location(origin[:1], direction[:1], multiple_hits=all_hits)
        build_s = time.process_time() - start
        start = time.process_time()
        mesh.ray.intersects_location(origin, direction, multiple_hits=all_hits)
        cast_s = time.process_time() - start
        speeds[name] = len(origin) / cast_s
        speeds[f"{name}, with its tree"] = len(origin) / (cast_s + build_s)
    return speeds


def compare_crop(buildings: pa.Table, cloud: Cloud, num_points: int) -> tuple[float, bool]:
    """Speed of the crop divided by the speed of shapely's dwithin, and whether their results are equal.

    shapely gets ``num_points`` points in a strip of the scene.
    """
    polygons = footprints(buildings)
    start = time.process_time()
    crop_points(cloud.x_m, cloud.y_m, polygons, 1.0)
    speed = len(cloud) / (time.process_time() - start)
    southernmost = np.argsort(cloud.y_m, kind="stable")[:num_points]
    x, y = cloud.x_m[southernmost], cloud.y_m[southernmost]
    point, _, offset = crop_points(x, y, polygons, 1.0)
    shapes = polygon_arrays.to_geometries(polygons)
    start = time.process_time()
    peer_point, peer_polygon = shapely.STRtree(shapes).query(
        shapely.points(x, y), predicate="dwithin", distance=1.0
    )
    peer_speed = num_points / (time.process_time() - start)
    pairs = np.repeat(np.arange(len(polygons)), np.diff(offset)) * num_points + point
    is_same = np.array_equal(np.sort(pairs), np.sort(peer_polygon * num_points + peer_point))
    return speed / peer_speed, is_same
