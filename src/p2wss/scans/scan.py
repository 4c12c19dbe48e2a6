"""Stage scans: a simulated airborne LiDAR survey of one scene (paper, section 5.1; model in docs/methods/scans.md), or
of any meshes without a scene."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import laspy
import numpy as np
import pyarrow as pa
import pyproj
import trimesh

from p2wss.clouds import scan_files as schema
from p2wss.config import Scans
from p2wss.data import polygon_arrays
from p2wss.data.crs import metric_crs, parsed_crs
from p2wss.data.seeds import derive_seed, generator
from p2wss.data.terrain import Terrain, read_terrain
from p2wss.data.tiling import Bounds, grown, tile_bounds
from p2wss.scans.caster import CHUNK_PULSES, cast
from p2wss.scans.clutter import LocalBuildings, add_clutter
from p2wss.scans.pulses import Box
from p2wss.scans.returns import Points
from p2wss.scans.surface import CLUTTER_KIND, Surface, encode_face, is_tree, las_classes
from p2wss.scans.survey import PAPER_ALTITUDE_M, Survey, plan
from p2wss.scans.terrain import TerrainGrid, local_grid
from p2wss.skeleton.types import FaceKind
from p2wss.storage import files
from p2wss.storage.messages import InputError

# the reflectance of a roof or of walls has this beta distribution: a mean of 0.31 and a standard deviation of 0.12
_REFLECTANCE_BETA = (4, 9)
_CLEARANCE_M = 100.0  # of the flight above the highest surface
_WRITTEN_AT_ONCE = 1_000_000
# of any meshes: ground around them; faces with a steeper normal are roofs, or floors; reflectance
_MARGIN_M, _UPRIGHT_NZ, _REFLECTANCE = 20.0, 0.05, 0.3


def build_surface(buildings: pa.Table, terrain: Terrain, origin_m: np.ndarray, settings: Scans) -> Surface:
    """The terrain and every building that has a mesh, relative to ``origin_m`` (3,).

    The ground faces of the meshes are omitted, because no pulse can reach them.
    """
    flat_vertices, vertex_offset = files.list_column(buildings, "vertex_xyz_m")
    flat_triangles, triangle_offset = files.list_column(buildings, "triangle")
    kind, _ = files.list_column(buildings, "triangle_kind")
    edge, _ = files.list_column(buildings, "triangle_edge")
    frame = np.stack(
        [buildings[name].to_numpy() for name in ("origin_x_m", "origin_y_m", "terrain_z_m")], axis=1
    )
    num_vertices, num_triangles = np.diff(vertex_offset) // 3, np.diff(triangle_offset) // 3
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


@dataclass(frozen=True)
class Scan:
    """Recorded points in a local frame, and the survey that recorded them.

    origin_m: float64 (3,), whole metres, the zero of the local frame in the CRS. points: see
    :class:`returns.Points`. facts: parameters, counts and density reached, ready for JSON.
    """

    origin_m: np.ndarray
    points: Points
    survey: Survey
    facts: dict[str, Any]


def simulate(
    buildings: pa.Table,
    terrain: Terrain,
    tile: str,
    tile_size_m: float,
    settings: Scans,
    threads: int = 1,
    chunk_pulses: int = CHUNK_PULSES,
) -> Scan:
    """Survey one scene.

    ``buildings`` has the columns of ``schemas.buildings.BUILDINGS``. Buildings of the margin occlude what is behind
    them; points are kept over the tile, its own buildings and a margin. The same tile, settings and input give the same
    points whatever ``threads`` and ``chunk_pulses`` are. Raises :class:`InputError` if the terrain has no data over the
    tile, or rises to the altitude of the flight.
    """
    bounds = tile_bounds(tile, tile_size_m)
    height_m = terrain.cut(bounds).height_m
    if not np.isfinite(height_m).any():
        raise InputError(f"tile {tile}: the terrain has no data there; is it the DTM of another tile?")
    middle = [(bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2, float(np.nanmedian(height_m))]
    origin = np.floor(np.array(middle))
    seed = derive_seed(settings.seed, "scans", tile)
    surface = build_surface(buildings, terrain, origin, settings)
    num_clutter: dict[str, int] = {}
    if settings.preset == "hd":
        with_clutter = local_buildings(buildings, origin, settings.seed)
        surface, num_clutter = add_clutter(surface, with_clutter, settings.clutter)
    around = scan_bounds(buildings, bounds, settings.keep_margin_m)
    place = Place(f"tile {tile}", origin, bounds, around)
    survey, points, num_pulses = fly(surface, place, settings, seed, threads, chunk_pulses)
    facts = {
        "seed": seed,
        "origin_m": origin.tolist(),
        "survey": survey.parameters,
        "pulses": num_pulses,
        **_point_facts(points, origin, bounds),
        "buildings_on_nodata": buildings_without_terrain(buildings, terrain),
        "clutter": num_clutter,
    }
    return Scan(origin, points, survey, facts)


class Place(NamedTuple):
    """Where a survey flies. name: for messages. origin_m: (3,), the zero of the local frame in the CRS. bounds: the
    window for which the flight is planned. around: the window in which points are kept. Both are in the CRS."""

    name: str
    origin_m: np.ndarray
    bounds: Bounds
    around: Bounds


def fly(
    surface: Surface,
    place: Place,
    settings: Scans,
    seed: int,
    threads: int = 1,
    chunk_pulses: int = CHUNK_PULSES,
) -> tuple[Survey, Points, dict[str, int]]:
    """(the survey of a surface, its points, the number of pulses by outcome as of :func:`~p2wss.scans.caster.cast`).

    Raises :class:`InputError` if the surface rises to the altitude of the flight.
    """
    low, high = surface.z_range_m()
    is_paper = settings.preset == "paper"
    if high + _CLEARANCE_M > (PAPER_ALTITUDE_M if is_paper else settings.altitude_m[0]):
        raise InputError(
            f"{place.name}: its highest surface is {high:.0f} m above the median ground; "
            + ("choose another scans.preset and " if is_paper else "")
            + f"set scans.altitude_m above {high + _CLEARANCE_M:.0f} m"
        )
    box = _box(place.around, place.origin_m, low, high)
    survey = plan(settings, seed, box, _box(place.bounds, place.origin_m, low, high))
    points, num_pulses = cast(surface, survey.strips, box, threads, chunk_pulses)
    return survey, points, num_pulses


def _box(bounds: Bounds, origin: np.ndarray, low: float, high: float) -> Box:
    """``bounds`` in the local frame, from a little below to a little above every surface."""
    x_min, y_min, x_max, y_max = bounds
    return Box(
        x_min - origin[0], y_min - origin[1], x_max - origin[0], y_max - origin[1], low - 0.1, high + 0.1
    )


def _point_facts(points: Points, origin: np.ndarray, bounds: Bounds) -> dict[str, float]:
    """Counts of the points, and the density over the tile."""
    num_ground, num_trees = int((points.face < 0).sum()), int(is_tree(points.face).sum())
    by_kind = np.bincount(points.face & 3, minlength=4)
    low_mm, high_mm = (1000 * (np.array(corner) - origin[:2]) for corner in (bounds[:2], bounds[2:]))
    xy_mm = points.xyz_mm[:, :2]
    in_tile = ((xy_mm >= low_mm) & (xy_mm < high_mm)).all(axis=1)
    return {
        "num_points": len(points.pulse),
        "num_ground_points": num_ground,
        "num_wall_points": int(by_kind[FaceKind.WALL]),
        # the face of the ground is -1, and -1 & 3 is the kind of a flat roof
        "num_roof_points": int(by_kind[FaceKind.ROOF] + by_kind[FaceKind.FLAT]) - num_ground,
        "num_tree_points": num_trees,
        "num_other_points": int(by_kind[CLUTTER_KIND]) - num_trees,
        "points_per_m2": int(in_tile.sum()) / ((bounds[2] - bounds[0]) * (bounds[3] - bounds[1])),
    }


def write_scan(path: str | Path, scan: Scan, crs: pyproj.CRS, threads: int = 1) -> None:
    """Write the points of a scan in the format of :mod:`p2wss.clouds.scan_files`; whole or not at all."""
    schema.write_scan(path, _las_chunks(scan), scan.origin_m, crs, threads)


def _las_chunks(scan: Scan) -> Iterator[dict[str, np.ndarray]]:
    """The points by LAS dimension, in chunks."""
    for first in range(0, len(scan.points.pulse), _WRITTEN_AT_ONCE):
        columns = Points(*(column[first : first + _WRITTEN_AT_ONCE] for column in scan.points))
        yield las_dimensions(columns, scan.survey)


def las_dimensions(points: Points, survey: Survey) -> dict[str, np.ndarray]:
    """Points by LAS dimension."""
    start_s = np.array([strip.start_s for strip in survey.strips])
    x_mm, y_mm, z_mm = points.xyz_mm.T
    return {
        "X": x_mm,
        "Y": y_mm,
        "Z": z_mm,
        "intensity": points.intensity,
        "scan_angle": points.scan_angle,
        "classification": las_classes(points.face),
        "return_number": np.ones(len(x_mm), np.uint8),
        "number_of_returns": np.ones(len(x_mm), np.uint8),
        "point_source_id": points.strip + np.uint16(1),  # LAS reserves 0
        "gps_time": start_s[points.strip] + points.pulse / survey.parameters["pulse_rate_hz"],
        "building_id": points.building,
        "face_id": points.face,
    }


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
    bounds = grown((float(low[0]), float(low[1]), float(high[0]), float(high[1])), _MARGIN_M)
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
    return schema.as_las(las_dimensions(points, survey), origin, stated)


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
