"""A survey over any meshes, without a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import trimesh

from p2wss.clouds.scan_files import as_las
from p2wss.config import Scans
from p2wss.data.crs import metric_crs, parsed_crs
from p2wss.data.terrain import Terrain, read_terrain
from p2wss.scans.scan import Place, fly, las_dimensions
from p2wss.scans.surface import Surface, encode_face
from p2wss.scans.terrain import TerrainGrid, local_grid
from p2wss.skeleton.types import FaceKind
from p2wss.storage.errors import InputError

# ground around the meshes
_MARGIN_M = 20.0
# faces with a steeper normal are roofs, or floors
_UPRIGHT_NZ = 0.05
_REFLECTANCE = 0.3


def scan_meshes(
    meshes: trimesh.Trimesh | Sequence[trimesh.Trimesh] | Mapping[str, Any],
    terrain: str | Path | None,
    crs: str | pyproj.CRS | None,
    settings: Scans,
    seed: int | None = None,
    threads: int = 1,
) -> laspy.LasData:
    """See :func:`p2wss.scan`."""
    if isinstance(meshes, Mapping):
        if hasattr(meshes, "in_metres"):
            meshes = meshes.in_metres()
        crs = crs or getattr(meshes, "crs", None)
        meshes = [getattr(each, "mesh", each) for each in meshes.values()]
    if isinstance(meshes, trimesh.Scene):
        meshes = meshes.dump()
    meshes = list(meshes) if isinstance(meshes, list | tuple | np.ndarray) else [meshes]
    if wrong := [each for each in meshes if not isinstance(each, trimesh.Trimesh)]:
        raise InputError(f"meshes: a {type(wrong[0]).__name__} is no trimesh.Trimesh")
    # a building without a mesh has a number, too
    corner_m = [mesh.bounds for mesh in meshes if len(mesh.faces)]
    if not corner_m:
        raise InputError("no mesh to scan")
    low, high = np.min(corner_m, axis=(0, 1)), np.max(corner_m, axis=(0, 1))
    bounds = (
        float(low[0]) - _MARGIN_M,
        float(low[1]) - _MARGIN_M,
        float(high[0]) + _MARGIN_M,
        float(high[1]) + _MARGIN_M,
    )
    stated = None if crs is None else parsed_crs(crs, "crs")
    metric = None if stated is None else metric_crs(stated, bounds, "meshes")[0]
    if metric is not None and not metric.is_source:
        raise InputError(
            f"crs: {metric.source.name} is not in metres there, as meshes are; convert them to another"
        )
    origin = np.floor([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    if terrain is None:
        ground = _level(bounds, float(low[2]))
    else:
        heights, heights_crs = read_terrain(terrain, None if stated is None else stated.to_wkt())
        ground = (heights if metric is None else metric.terrain(heights, heights_crs, terrain)).cut(bounds)
    if not np.isfinite(ground.height_m).any():
        raise InputError(f"{terrain}: has no height around the meshes")
    grid = local_grid(ground.height_m, ground.x_min_m, ground.y_max_m, ground.cell_m, origin)
    place = Place("the meshes", origin, bounds, bounds)
    seed = settings.seed if seed is None else seed
    survey, points, _ = fly(_surface(meshes, grid, origin), place, settings, seed, threads)
    return as_las(las_dimensions(points, survey), origin, stated)


def _level(bounds: tuple[float, float, float, float], z_m: float) -> Terrain:
    x_min, y_min, x_max, y_max = bounds
    rows, columns = int(np.ceil(y_max - y_min)) + 2, int(np.ceil(x_max - x_min)) + 2
    return Terrain(np.full((rows, columns), z_m, np.float32), x_min - 1, y_max + 1, 1.0)


def _surface(meshes: Sequence[trimesh.Trimesh], terrain: TerrainGrid, origin: np.ndarray) -> Surface:
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangle = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first, strict=False)])
    building = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    up = np.concatenate([mesh.face_normals[:, 2] for mesh in meshes])
    kind = np.where(up > _UPRIGHT_NZ, FaceKind.ROOF, FaceKind.WALL)
    reachable = up > -_UPRIGHT_NZ  # no pulse reaches the floor
    face = encode_face(kind, np.full(len(kind), -1))[reachable]
    return Surface(
        terrain=terrain,
        vertex_m=np.concatenate([mesh.vertices for mesh in meshes]) - origin,
        triangle=triangle[reachable].astype(np.int32),
        building=building[reachable].astype(np.int32),
        face=face,
        reflectance=np.full(len(face), _REFLECTANCE, np.float32),
        loss=np.zeros(len(face), np.float32),
    )
