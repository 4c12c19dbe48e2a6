"""A stand-in for one LiDAR HD tile: an oscillating scanner over the surface of a town. It is not LiDAR HD data.

Its roofs come from the drawn wings and not from the kernel, and its buildings have what the training data
lacks: dormers, chimneys, garages lower than their house, trees.
"""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pyproj

from drawn_towns.surface import CELL_M, Surface, draw_trees
from p2wss.storage import files
from p2wss.towns.buildings import DrawnBuilding
from p2wss.towns.ign import DATE
from p2wss.towns.site import (
    BUILDING_CLASS,
    CRS,
    LIDAR_X_MIN,
    LIDAR_Y_MAX,
    UNCLASSIFIED_CLASS,
    VEGETATION_CLASS,
    ground_z_m,
    in_lidar_tile,
)

LIDAR = "lidar/LHD_FXX_0653_6861_PTS_LAMB93_IGN69.laz"
FLIGHT_M = 850.0  # above the ground
SWING_DEG = 18.0
SWINGS_PER_S = 150.0  # half swings, from one side to the other
SPEED_M_S = 62.0
PULSES_PER_S = 270_000
HEADINGS_DEG = (64.0, 244.0)  # two strips, there and back


def scan_town(
    town: list[DrawnBuilding], rng: np.random.Generator, swings_per_s: float = SWINGS_PER_S
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """A survey of the buildings of the LiDAR tile: the dimensions of its points (n,) by their names in LAS, in the
    order of flight, and whether a point is in the tile and near a building, bool (n,)."""
    buildings = [building for building in town if in_lidar_tile(building.footprint)]
    surface = Surface(buildings, rng)
    trees = draw_trees(buildings, rng)
    strips = [_scan(surface, trees, number, swings_per_s, rng) for number in range(len(HEADINGS_DEG))]
    points = {name: np.concatenate([strip[name] for strip in strips]) for name in strips[0]}
    is_in_tile = (points["x"] >= LIDAR_X_MIN) & (points["y"] < LIDAR_Y_MAX)
    return points, surface.near(points["x"], points["y"]) & is_in_tile


def write_points(points: dict[str, np.ndarray], is_kept: np.ndarray, path: Path) -> None:
    """Write the kept points of a survey into LAZ (LAS 1.4, point format 6)."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.01] * 3, [0, 0, 0]
    header.creation_date = DATE
    header.generating_software = "p2wss towns"
    header.system_identifier = "stand-in, not LiDAR HD"
    header.add_crs(pyproj.CRS(CRS))
    cloud = laspy.LasData(header)
    for name, values in points.items():
        cloud[name] = values[is_kept]
    with files.atomic(path) as temporary:
        cloud.write(temporary)


def _scan(
    surface: Surface, trees: np.ndarray, strip: int, swings_per_s: float, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """One strip: pulses of an oscillating mirror, each followed down to the first surface."""
    heading = np.radians(90 - HEADINGS_DEG[strip])
    forward, right = (
        np.array([np.cos(heading), np.sin(heading)]),
        np.array([np.sin(heading), -np.cos(heading)]),
    )
    rows, columns = surface.z.shape
    size = CELL_M * np.array([columns, rows])
    middle = np.array([surface.x_min, surface.y_min]) + size / 2 + (-1) ** strip * 35 * right
    half_length = np.hypot(*size) / 2 + 30
    time = np.arange(0, 2 * half_length / SPEED_M_S, 1 / PULSES_PER_S)
    angle = np.radians(SWING_DEG) * np.sin(2 * np.pi * swings_per_s / 2 * time)
    plane_z = float(ground_z_m(*middle)) + FLIGHT_M
    plane_xy = middle + (SPEED_M_S * time - half_length)[:, None] * forward
    sideways = np.tan(angle)[:, None] * right  # horizontal metres per metre of descent
    keep = surface.near(*(plane_xy + FLIGHT_M * sideways).T)
    time, angle, plane_xy, sideways = time[keep], angle[keep], plane_xy[keep], sideways[keep]

    descent, kind = _first_hit(surface, plane_xy, plane_z, sideways)
    in_crown, passing = _crown_hit(trees, plane_xy, plane_z, sideways, descent, rng)
    hit_crown = np.isfinite(in_crown)
    through = hit_crown & (rng.random(len(time)) < passing)  # a second return below the crown
    single = np.where(hit_crown, in_crown, descent)
    pulse = np.concatenate([np.arange(len(time)), np.flatnonzero(through)])
    depth = np.concatenate([single, descent[through]])
    classes = np.concatenate([np.where(hit_crown, VEGETATION_CLASS, kind), kind[through]])
    returns = np.concatenate([np.ones(len(time), np.uint8), np.full(through.sum(), 2, np.uint8)])
    order = np.lexsort([returns, pulse])
    pulse, depth, classes, returns = pulse[order], depth[order], classes[order], returns[order]
    xy = plane_xy[pulse] + depth[:, None] * sideways[pulse] + rng.normal(0, 0.03, (len(pulse), 2))
    return {
        "x": xy[:, 0],
        "y": xy[:, 1],
        "z": plane_z - depth + rng.normal(0, 0.02, len(pulse)),
        "classification": classes.astype(np.uint8),
        "intensity": np.choose(np.searchsorted([1, 2, 5, 6], classes), [700, 1100, 500, 900]).astype(
            np.uint16
        ),
        "return_number": returns,
        "number_of_returns": np.where(through, 2, 1)[pulse].astype(np.uint8),
        "scan_angle": np.rint(np.degrees(angle[pulse]) / 0.006).astype(np.int16),
        "gps_time": 400_000_000.0 + 600 * strip + time[pulse],
        "point_source_id": np.full(len(pulse), strip + 1, np.uint16),
    }


def _first_hit(
    surface: Surface, plane_xy: np.ndarray, plane_z: float, sideways: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Descent (metres below the aircraft) and class where each pulse meets the surface."""
    step = 0.2
    upper = np.full(len(plane_xy), plane_z - surface.z.max() - step)
    flying = np.ones(len(plane_xy), bool)
    while flying.any():
        at = upper[flying] + step
        z, _ = surface.at(*(plane_xy[flying] + at[:, None] * sideways[flying]).T)
        above = plane_z - at > z
        upper[np.flatnonzero(flying)[above]] = at[above]
        flying[np.flatnonzero(flying)[~above]] = False
    lower = upper + step
    for _ in range(6):
        middle = (upper + lower) / 2
        z, _ = surface.at(*(plane_xy + middle[:, None] * sideways).T)
        above = plane_z - middle > z
        upper, lower = np.where(above, middle, upper), np.where(above, lower, middle)
    z, kind = surface.at(*(plane_xy + lower[:, None] * sideways).T)
    on_wall = (kind == BUILDING_CLASS) & (z - (plane_z - lower) > 0.6)
    return lower, np.where(on_wall, UNCLASSIFIED_CLASS, kind)


def _crown_hit(
    trees: np.ndarray,
    plane_xy: np.ndarray,
    plane_z: float,
    sideways: np.ndarray,
    descent: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """(descent at which leaves stop a pulse, NaN if none do before ``descent``; the chance that a part of the pulse
    passes)."""
    result, passing = np.full((2, len(plane_xy)), np.nan)
    chance, inside = rng.random(len(plane_xy)), rng.random(len(plane_xy))
    for x, y, z, radius, half, density in trees:
        start = plane_xy - (x, y)
        candidates = np.flatnonzero(np.hypot(*(start + (plane_z - z) * sideways).T) < radius + half)
        s, d = start[candidates] / radius, sideways[candidates] / radius
        a = (d**2).sum(axis=1) + 1 / half**2
        b = (s * d).sum(axis=1) - (plane_z - z) / half**2
        c = (s**2).sum(axis=1) + ((plane_z - z) / half) ** 2 - 1
        root = b**2 - a * c
        met = (root > 0) & (chance[candidates] < density)
        first, width = (-b - np.sqrt(np.maximum(root, 0))) / a, 2 * np.sqrt(np.maximum(root, 0)) / a
        leaf = first + width * inside[candidates] ** 2 * 0.6
        met &= leaf < descent[candidates]
        result[candidates[met]], passing[candidates[met]] = leaf[met], 1.4 * (1 - density)
    return result, passing
