"""Stage scans: a simulated airborne LiDAR survey of one scene (paper, section 5.1; model in
docs/methods/scans.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyproj

from p2wss.clouds import scan_files as schema
from p2wss.config import Scans
from p2wss.data.seeds import derive_seed
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import Bounds, tile_bounds
from p2wss.scans.caster import CHUNK_PULSES, cast
from p2wss.scans.clutter import add_clutter
from p2wss.scans.pulses import Box
from p2wss.scans.returns import Points
from p2wss.scans.scene import build_surface, buildings_without_terrain, local_buildings, scan_bounds
from p2wss.scans.surface import CLUTTER_KIND, Surface, is_tree, las_classes
from p2wss.scans.survey import Survey, plan
from p2wss.skeleton.types import FaceKind
from p2wss.storage.errors import InputError

_CLEARANCE_M = 100.0  # of the flight above the highest surface
_WRITTEN_AT_ONCE = 1_000_000


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

    ``buildings`` has the columns of ``schemas.buildings.BUILDINGS``. Those of the margin occlude what is
    behind them; points are kept over the tile, its own buildings and a margin. The same tile, settings and
    input give the same points whatever ``threads`` and ``chunk_pulses`` are. Raises :class:`InputError` if
    the terrain has no data over the tile, or rises to the altitude of the flight.
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
        "survey": survey.parameters,
        "pulses": num_pulses,
        **_point_facts(points, origin, bounds),
        "buildings_on_nodata": buildings_without_terrain(buildings, terrain),
        "clutter": num_clutter,
    }
    return Scan(origin, points, survey, facts)


class Place(NamedTuple):
    """Where a survey flies. name: for messages. origin_m: (3,), the zero of the local frame. bounds: over which the
    flight is planned. around: within which points are kept. Both in the CRS."""

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
    """(the survey of a surface, its points, the numbers of pulses).

    Raises :class:`InputError` if the surface rises to the altitude of the flight.
    """
    low, high = surface.z_range_m()
    if high + _CLEARANCE_M > settings.altitude_m[0]:
        raise InputError(
            f"{place.name}: its highest surface is {high:.0f} m above the median ground; "
            f"set scans.altitude_m above {high + _CLEARANCE_M:.0f} m"
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
    """The points by LAS dimension, some at a time."""
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
        "point_source_id": points.strip,
        "gps_time": start_s[points.strip] + points.pulse / survey.parameters["pulse_rate_hz"],
        "building_id": points.building,
        "face_id": points.face,
    }
