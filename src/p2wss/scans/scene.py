"""From the files of a scene to what the simulator works on: surface and buildings in the local frame."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from p2wss.config import Scans
from p2wss.data import polygon_arrays
from p2wss.data.seeds import derive_seed, generator
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import Bounds
from p2wss.scans.clutter import LocalBuildings
from p2wss.scans.surface import Surface, encode_face
from p2wss.scans.terrain import local_grid
from p2wss.skeleton.types import FaceKind
from p2wss.storage import files
from p2wss.storage.errors import InputError

# the reflectance of a roof or of walls has this beta distribution: a mean of 0.31 and a standard deviation of 0.12
_REFLECTANCE_BETA = (4, 9)


def build_surface(buildings: pa.Table, terrain: Terrain, origin_m: np.ndarray, settings: Scans) -> Surface:
    """The terrain and every building that has a mesh, relative to ``origin_m`` (3,).

    The ground faces of the meshes are omitted, because no pulse can reach them. Raises :class:`InputError`
    if the columns of the triangles differ in length.
    """
    flat_vertices, vertex_offset = files.list_column(buildings, "vertex_xyz_m")
    flat_triangles, triangle_offset = files.list_column(buildings, "triangle")
    kind, kind_offset = files.list_column(buildings, "triangle_kind")
    edge, _ = files.list_column(buildings, "triangle_edge")
    frame = np.stack(
        [buildings[name].to_numpy() for name in ("origin_x_m", "origin_y_m", "terrain_z_m")], axis=1
    )
    num_vertices, num_triangles = np.diff(vertex_offset) // 3, np.diff(triangle_offset) // 3
    if not np.array_equal(np.diff(kind_offset), num_triangles):
        raise InputError("buildings: triangle and triangle_kind differ in length; rerun the buildings stage")
    vertices = flat_vertices.reshape(-1, 3) + np.repeat(frame - origin_m, num_vertices, axis=0)
    building = np.repeat(np.arange(len(frame)), num_triangles)
    triangles = flat_triangles.reshape(-1, 3) + (vertex_offset[building] // 3)[:, None]
    is_roof = (kind == FaceKind.ROOF) | (kind == FaceKind.FLAT)
    roof_reflectance, wall_reflectance, roof_loss = _optics(buildings["building_id"].to_pylist(), settings)
    reflectance = np.where(is_roof, roof_reflectance[building], wall_reflectance[building])
    reachable = kind != FaceKind.GROUND
    return Surface(
        terrain=local_grid(terrain.height_m, terrain.x_min_m, terrain.y_max_m, terrain.cell_m, origin_m),
        vertex_m=np.ascontiguousarray(vertices),
        triangle=triangles[reachable].astype(np.int32),
        building=building[reachable].astype(np.int32),
        face=encode_face(kind, edge)[reachable],
        reflectance=reflectance[reachable].astype(np.float32),
        loss=np.where(is_roof, roof_loss[building], 0)[reachable].astype(np.float32),
    )


def _optics(building_ids: list[str], settings: Scans) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reflectance of the roof and of the walls, and loss of the roof, per building; the same in every tile
    that contains the building."""
    columns = np.empty((3, len(building_ids)))
    for i, building_id in enumerate(building_ids):
        rng = generator(settings.seed, "scans", "optics", building_id)
        is_dark = rng.uniform() < settings.dark_roof_share
        loss = rng.uniform(*settings.dark_roof_loss)
        columns[:, i] = (
            rng.beta(*_REFLECTANCE_BETA),
            rng.beta(*_REFLECTANCE_BETA),
            loss if is_dark and settings.preset == "hd" else 0,
        )
    return columns[0], columns[1], columns[2]


def local_buildings(buildings: pa.Table, origin_m: np.ndarray, seed: int) -> LocalBuildings:
    """The buildings that get clutter, relative to ``origin_m`` (3,)."""
    shapes = polygon_arrays.to_geometries(polygon_arrays.in_crs(buildings, origin_m[:2]))
    shapes[np.array(buildings["status"].to_pylist(), dtype=object) != "ok"] = None
    terrain_z_m = buildings["terrain_z_m"].to_numpy() - origin_m[2]
    keys = [derive_seed(seed, "scans", "clutter", name) for name in buildings["building_id"].to_pylist()]
    return LocalBuildings(
        polygons=polygon_arrays.to_polygons(shapes),
        eave_z_m=terrain_z_m + buildings["eave_height_m"].to_numpy().astype(float),
        terrain_z_m=terrain_z_m,
        base_z_m=buildings["base_z_m"].to_numpy() - origin_m[2],
        key=np.array(keys, np.uint64),
    )


def scan_bounds(buildings: pa.Table, tile_bounds: Bounds, margin_m: float) -> Bounds:
    """The tile and the footprints of its own buildings, which may extend beyond it, grown by ``margin_m``."""
    footprints = polygon_arrays.in_crs(buildings)
    in_tile = np.repeat(buildings["in_tile"].to_numpy(), np.diff(footprints.vertex_offset))
    x, y = footprints.xy_m[in_tile].T
    return (
        min(tile_bounds[0], x.min(initial=np.inf)) - margin_m,
        min(tile_bounds[1], y.min(initial=np.inf)) - margin_m,
        max(tile_bounds[2], x.max(initial=-np.inf)) + margin_m,
        max(tile_bounds[3], y.max(initial=-np.inf)) + margin_m,
    )


def buildings_without_terrain(buildings: pa.Table, terrain: Terrain) -> list[str]:
    """Ids of the tile's own buildings with a footprint vertex where the terrain has no data."""
    footprints = polygon_arrays.in_crs(buildings)
    row = np.repeat(np.arange(len(footprints)), np.diff(footprints.vertex_offset))
    without = np.isnan(terrain.interpolated(*footprints.xy_m.T)) & buildings["in_tile"].to_numpy()[row]
    return [buildings["building_id"][int(i)].as_py() for i in np.unique(row[without])]
