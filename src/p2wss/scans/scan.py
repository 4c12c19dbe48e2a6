"""Stage scans: a simulated airborne LiDAR survey of one scene (paper, section 5.1; model in
docs/lidar.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
import pyarrow as pa
import pyproj

from p2wss.config import Scans
from p2wss.data import files, polygon_arrays
from p2wss.data.clouds import same_crs
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS, VEGETATION_CLASS
from p2wss.data.seeds import derive_seed, generator
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import Bounds, tile_bounds
from p2wss.errors import InputError
from p2wss.scans.caster import CHUNK_PULSES, cast
from p2wss.scans.clutter import Houses, clutter
from p2wss.scans.pulses import Box
from p2wss.scans.returns import Points, count_points
from p2wss.scans.surface import Surface, encode_face, is_tree
from p2wss.scans.survey import Survey, plan
from p2wss.scans.terrain import local_grid
from p2wss.skeleton.types import FaceKind, Polygons

_CLEARANCE_M = 100.0  # of the flight above the highest surface
_WRITTEN_AT_ONCE = 1_000_000


@dataclass(frozen=True)
class Scan:
    """Recorded points in a local frame, with the survey that made them.

    origin_m: float64 (3,), whole metres, what the local frame's zero is in the CRS. points: see
    :class:`lidar.returns.Points`. facts: parameters, counts and realised density, ready for JSON.
    """

    origin_m: np.ndarray
    points: Points
    survey: Survey
    facts: dict[str, Any]


def check_dtm_crs(dtm: pyproj.CRS, wanted: pyproj.CRS, name: str | Path) -> None:
    """Raise :class:`InputError` if the terrain is in another CRS than the buildings."""
    if not same_crs(dtm, wanted):
        raise InputError(f"{name} is in {dtm.name}, but the buildings are in {wanted.name}; reproject it")


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

    ``buildings`` has the columns of ``io.BUILDINGS``; those of the margin cast shadows, and points are kept
    over the tile, its buildings and a margin. The same tile, settings and input give the same points
    whatever ``threads`` and ``chunk_pulses``. Raises :class:`InputError` if the terrain has no data over the
    tile or rises to the flight.
    """
    bounds = tile_bounds(tile, tile_size_m)
    inside = terrain.cut(bounds).height_m
    if not np.isfinite(inside).any():
        raise InputError(f"tile {tile}: the terrain has no data there; is it the DTM of another tile?")
    middle = [(bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2, float(np.nanmedian(inside))]
    origin = np.floor(np.array(middle))
    seed = derive_seed(settings.seed, "scans", tile)
    surface = _surface(buildings, terrain, origin, settings)
    things: dict[str, int] = {}
    if settings.preset == "hd":
        surface, things = clutter(surface, _houses(buildings, origin, settings.seed), settings.clutter)
    low, high = surface.z_range_m()
    if high + _CLEARANCE_M > settings.altitude_m[0]:
        raise InputError(
            f"tile {tile}: its highest surface is {high:.0f} m above the median ground; "
            f"set scans.altitude_m above {high + _CLEARANCE_M:.0f} m"
        )
    box = _box(_kept_bounds(buildings, bounds, settings.keep_margin_m), origin, low, high)
    survey = plan(settings, seed, box, _box(bounds, origin, low, high))
    points, counts = cast(surface, survey.strips, box, threads, chunk_pulses)
    facts = _facts(points, counts, survey, buildings, terrain, origin, bounds, seed) | {"clutter": things}
    return Scan(origin, points, survey, facts)


def _box(bounds: Bounds, origin: np.ndarray, low: float, high: float) -> Box:
    """``bounds`` in the local frame, from a little below to a little above every surface."""
    x_min, y_min, x_max, y_max = bounds
    return Box(
        x_min - origin[0], y_min - origin[1], x_max - origin[0], y_max - origin[1], low - 0.1, high + 0.1
    )


def _surface(buildings: pa.Table, terrain: Terrain, origin: np.ndarray, settings: Scans) -> Surface:
    """Terrain and every building that has a mesh, without the meshes' ground faces, which no pulse can
    reach."""
    flat_vertices, vertex_offset = files.list_column(buildings, "vertex_xyz_m")
    flat_triangles, triangle_offset = files.list_column(buildings, "triangle")
    kind, kind_offset = files.list_column(buildings, "triangle_kind")
    edge, _ = files.list_column(buildings, "triangle_edge")
    frame = np.stack(
        [buildings[name].to_numpy() for name in ("origin_x_m", "origin_y_m", "ground_z_m")], axis=1
    )
    num_vertices, num_triangles = np.diff(vertex_offset) // 3, np.diff(triangle_offset) // 3
    if not np.array_equal(np.diff(kind_offset), num_triangles):
        raise InputError("buildings: triangle and triangle_kind differ in length; rerun the buildings stage")
    vertices = flat_vertices.reshape(-1, 3) + np.repeat(frame - origin, num_vertices, axis=0)
    owner = np.repeat(np.arange(len(frame)), num_triangles)
    triangles = flat_triangles.reshape(-1, 3) + (vertex_offset[owner] // 3)[:, None]
    roof = (kind == FaceKind.ROOF) | (kind == FaceKind.FLAT)
    roof_reflectance, wall_reflectance, roof_loss = _optics(buildings["building_id"].to_pylist(), settings)
    reachable = kind != FaceKind.GROUND
    return Surface(
        terrain=local_grid(terrain.height_m, terrain.x_min_m, terrain.y_max_m, terrain.cell_m, origin),
        vertex_m=np.ascontiguousarray(vertices),
        triangle=triangles[reachable].astype(np.int32),
        building=owner[reachable].astype(np.int32),
        face=encode_face(kind, edge)[reachable],
        reflectance=np.where(roof, roof_reflectance[owner], wall_reflectance[owner])[reachable].astype(
            np.float32
        ),
        loss=np.where(roof, roof_loss[owner], 0)[reachable].astype(np.float32),
        porous=np.zeros(int(reachable.sum()), bool),
    )


def _houses(buildings: pa.Table, origin: np.ndarray, seed: int) -> Houses:
    """What the clutter needs to know of the buildings, in the local frame."""
    local = polygon_arrays.from_columns(buildings)
    xy = np.stack([buildings["origin_x_m"].to_numpy(), buildings["origin_y_m"].to_numpy()], axis=1)
    shift = np.repeat(xy - origin[:2], np.diff(local.vertex_offset), axis=0)
    absolute = Polygons(local.xy_m + shift, local.ring_offset, local.polygon_offset)
    usable = np.array(buildings["status"].to_pylist(), dtype=object) == "ok"
    counts = np.diff(absolute.polygon_offset) * usable
    ring_kept = np.repeat(usable, np.diff(absolute.polygon_offset))
    vertex_kept = np.repeat(ring_kept, np.diff(absolute.ring_offset))
    ring_offset = np.concatenate([[0], np.cumsum(np.diff(absolute.ring_offset)[ring_kept])])
    polygons = Polygons(
        absolute.xy_m[vertex_kept],
        ring_offset.astype(np.int64),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
    )
    ground_z_m = buildings["ground_z_m"].to_numpy() - origin[2]
    keys = [derive_seed(seed, "scans", "clutter", name) for name in buildings["building_id"].to_pylist()]
    return Houses(
        polygons=polygons,
        eave_z_m=ground_z_m + buildings["eave_height_m"].to_numpy().astype(float),
        ground_z_m=ground_z_m,
        base_z_m=buildings["base_z_m"].to_numpy() - origin[2],
        key=np.array(keys, np.uint64),
    )


def _optics(building_ids: list[str], settings: Scans) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reflectance of roof and of walls, and loss of the roof, per building; equal in every tile that sees
    it."""
    drawn = np.empty((3, len(building_ids)))
    for i, name in enumerate(building_ids):
        rng = generator(settings.seed, "scans", "optics", name)
        dark = rng.uniform() < settings.dark_roof_share
        loss = rng.uniform(*settings.dark_roof_loss)
        drawn[:, i] = rng.beta(4, 9), rng.beta(4, 9), loss if dark and settings.preset == "hd" else 0
    return drawn[0], drawn[1], drawn[2]


def _kept_bounds(buildings: pa.Table, bounds: Bounds, margin_m: float) -> Bounds:
    """The tile and the footprints of its own buildings, which may stick out, grown by ``margin_m``."""
    own = buildings["in_tile"].to_numpy()
    x, y, row = _footprint_vertices(buildings)
    x, y = x[own[row]], y[own[row]]
    return (
        min(bounds[0], x.min(initial=np.inf)) - margin_m,
        min(bounds[1], y.min(initial=np.inf)) - margin_m,
        max(bounds[2], x.max(initial=-np.inf)) + margin_m,
        max(bounds[3], y.max(initial=-np.inf)) + margin_m,
    )


def _footprint_vertices(buildings: pa.Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y in the CRS and row of every footprint vertex."""
    values, offset = files.list_column(buildings, "footprint_xy_m")
    row = np.repeat(np.arange(len(buildings)), np.diff(offset) // 2)
    local = values.reshape(-1, 2)
    x = local[:, 0] + buildings["origin_x_m"].to_numpy()[row]
    y = local[:, 1] + buildings["origin_y_m"].to_numpy()[row]
    return x, y, row


def _facts(
    points: Points,
    counts: dict[str, int],
    survey: Survey,
    buildings: pa.Table,
    terrain: Terrain,
    origin: np.ndarray,
    bounds: Bounds,
    seed: int,
) -> dict[str, Any]:
    low, high = (1000 * (np.array(corner) - origin[:2]) for corner in (bounds[:2], bounds[2:]))
    ground, walls, roofs, trees, others, inside, first = count_points(points, low, high).tolist()
    area_m2 = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])
    vertex_x, vertex_y, row = _footprint_vertices(buildings)
    bare = np.unique(
        row[np.isnan(terrain.interpolated(vertex_x, vertex_y)) & buildings["in_tile"].to_numpy()[row]]
    )
    return {
        "seed": seed,
        "survey": survey.parameters,
        "pulses": counts,
        "num_points": len(points.pulse),
        "num_ground_points": ground,
        "num_wall_points": walls,
        "num_roof_points": roofs,
        "num_tree_points": trees,
        "num_other_points": others,
        "points_per_m2": inside / area_m2,
        "pulses_per_m2": first / area_m2,
        "buildings_on_nodata": [buildings["building_id"][int(i)].as_py() for i in bare],
    }


def busiest_place(points: Points, cell_m: float = 50.0) -> np.ndarray:
    """Middle of the cell with most buildings, float64 (2,) in the local frame; zero without a building."""
    hit = points.building >= 0
    cell = np.floor(points.xyz_mm[hit, :2] / (1000 * cell_m)).astype(np.int64)
    pair = np.unique(np.column_stack([cell, points.building[hit]]), axis=0)[:, :2]
    if not len(pair):
        return np.zeros(2)
    cells, counts = np.unique(pair, axis=0, return_counts=True)
    middle: np.ndarray = (cells[counts.argmax()] + 0.5) * cell_m
    return middle


def point_classes(points: Points) -> np.ndarray:
    """LAS class per point, uint8: 2 ground, 5 vegetation, 6 building and what stands on it."""
    result = np.full(len(points.face), BUILDING_CLASS, np.uint8)
    result[points.face < 0] = GROUND_CLASS
    result[is_tree(points.face)] = VEGETATION_CLASS
    return result


def write_scan(path: str | Path, scan: Scan, crs: pyproj.CRS, threads: int = 1) -> None:
    """Write LAS 1.4 points of format 6, compressed; whole or not at all.

    Classes: 2 ground, 5 vegetation, 6 building. Extra dimensions: ``building_id`` int32, the row in the
    buildings file or -1; ``face_id`` int32, see :func:`lidar.surface.encode_face` and ``encode_thing``.
    """
    points, survey = scan.points, scan.survey
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), scan.origin_m
    header.system_identifier, header.generating_software = "p2wss simulated survey", "p2wss"
    header.creation_date = None  # the same points make the same file on any day
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.WEEK_TIME
    header.add_crs(crs)
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("building_id", "int32", "row in buildings, -1 none"),
            laspy.ExtraBytesParams("face_id", "int32", "4 (edge + 1) + kind, -1 none"),
        ]
    )
    backend = laspy.LazBackend.LazrsParallel if threads > 1 else laspy.LazBackend.Lazrs
    with files.atomic(path) as temporary:
        try:
            with laspy.open(temporary, "w", header=header, laz_backend=backend, do_compress=True) as writer:
                for first in range(0, len(points.pulse), _WRITTEN_AT_ONCE):
                    part = Points(*(column[first : first + _WRITTEN_AT_ONCE] for column in points))
                    writer.write_points(_las_points(part, survey, header))
        except lazrs.LazrsError as error:  # a full disk, which io.atomic tells of
            raise OSError(str(error)) from error


def _las_points(points: Points, survey: Survey, header: laspy.LasHeader) -> laspy.ScaleAwarePointRecord:
    record = laspy.ScaleAwarePointRecord.zeros(len(points.pulse), header=header)
    record.X, record.Y, record.Z = points.xyz_mm.T
    record.intensity, record.scan_angle = points.intensity, points.scan_angle
    record.classification = point_classes(points)
    record.return_number, record.number_of_returns = points.return_number, points.num_returns
    record.point_source_id = points.strip
    start_s = np.array([strip.start_s for strip in survey.strips])
    record.gps_time = start_s[points.strip] + points.pulse / survey.parameters["pulse_rate_hz"]
    record.building_id, record.face_id = points.building, points.face
    return record
