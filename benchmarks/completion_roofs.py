"""Drawn roofs, and what a survey with few points shows of them: the samples from which the completion learns.

Used by completion.py."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np
import shapely
from drawn_towns.old import draw_old
from drawn_towns.surface import draw_details
from drawn_towns.wings import draw_terraces, draw_wings

from p2wss.data.las_classes import BUILDING_CLASS
from p2wss.nets.clues import MAX_AROUND, MAX_POINTS, MAX_SIZE_M, MAX_VERTICES, SCALE_M, Clues
from p2wss.towns import draw_town
from p2wss.towns.buildings import DrawnBuilding, Wing

# number of towns of each kind: above all houses of several bodies, and terraces
KINDS = {
    "terraces": (draw_terraces, 30),
    "wings": (draw_wings, 120),
    "old": (draw_old, 6),
    "streets": (draw_town, 6),
}
NUM_SAMPLES, NUM_PLACES, NUM_NEIGHBOURS, NUM_OF_NEIGHBOUR = 160, 32, 6, 16
MIN_POINTS = 3
_NEAR_M, _SMALL_M2 = 12.0, 8.0
_SIMPLIFY_M, _NOISE_M, _OVERLAP_M = 0.3, 0.04, 0.05


class DrawnRoofs(NamedTuple):
    """n drawn buildings. ring: (n, v, 2), NaN for padding, and xy: (n, k, 2), samples of the roof, both relative to
    centre: (n, 2). z: (n, k), height of the roof above the ground. slope: (n, k, 2). seen_z: (n, k), height with the
    chimneys and dormers that a model leaves out. neighbour: int (n, 6), the nearest buildings, -1 for none."""

    ring: np.ndarray
    centre: np.ndarray
    xy: np.ndarray
    z: np.ndarray
    slope: np.ndarray
    seen_z: np.ndarray
    neighbour: np.ndarray


def draw_roofs(seed: int, share: float = 1.0, num_processes: int = 1) -> DrawnRoofs:
    """The roofs of towns of all kinds, the same whatever the number of processes. share: of the towns of each kind to
    draw, rounded up."""
    towns = [(kind, town) for kind, (_, num) in KINDS.items() for town in range(int(np.ceil(share * num)))]
    if num_processes == 1:
        drawn = [_roofs_of_town(seed, *town) for town in towns]
    else:
        with ProcessPoolExecutor(num_processes, mp_context=get_context("fork")) as pool:
            drawn = list(pool.map(partial(_roofs_of_town, seed), *zip(*towns, strict=True)))
    first, parts = 0, []
    for part in drawn:
        parts.append(part._replace(neighbour=np.where(part.neighbour < 0, -1, part.neighbour + first)))
        first += len(part.z)
    return DrawnRoofs(*map(np.concatenate, zip(*parts, strict=True)))


def _roofs_of_town(seed: int, kind: str, town: int) -> DrawnRoofs:
    rng = np.random.default_rng([seed, *kind.encode(), town])
    return _sampled(KINDS[kind][0](rng), rng)


def _sampled(town: Sequence[DrawnBuilding], rng: np.random.Generator) -> DrawnRoofs:
    rows, polygons = [], []
    for building in town:
        polygon = building.footprint
        ring_m = shapely.get_coordinates(shapely.get_exterior_ring(polygon.simplify(_SIMPLIFY_M)))[:-1]
        is_large = np.ptp(ring_m, axis=0).max() > MAX_SIZE_M
        if polygon.area < _SMALL_M2 or is_large or len(ring_m) > MAX_VERTICES:
            continue
        xy_m = _places_within(polygon, rng)
        z_m, slope = _roof(building.wings, xy_m)
        # the map is not the roof
        known = np.flatnonzero(z_m > 0.5)
        if len(known) < NUM_SAMPLES // 2:
            continue
        chosen = np.concatenate([known, rng.choice(known, NUM_SAMPLES - len(known))])
        xy_m, z_m, slope = xy_m[chosen], z_m[chosen], slope[chosen]
        details = [each for each in draw_details(building, rng) if each.seen_as == BUILDING_CLASS]
        seen_m = np.maximum(z_m, _roof(details, xy_m)[0])
        centre = ring_m.mean(axis=0)
        padded = np.full((MAX_VERTICES, 2), np.nan)
        padded[: len(ring_m)] = ring_m - centre
        rows.append((padded, centre, xy_m - centre, z_m, slope, seen_m))
        polygons.append(polygon)
    neighbour = np.full((len(rows), NUM_NEIGHBOURS), -1)
    tree = shapely.STRtree(polygons)
    for number, polygon in enumerate(polygons):
        near = tree.query(polygon, "dwithin", _NEAR_M)
        near = near[near != number]
        away_m = shapely.distance(polygon, tree.geometries[near])
        near = near[np.argsort(away_m, kind="stable")][:NUM_NEIGHBOURS]
        neighbour[number, : len(near)] = near
    ring, centre, xy, z, slope, seen_z = (np.stack(each) for each in zip(*rows, strict=True))
    return DrawnRoofs(ring, centre, xy, z, slope, seen_z, neighbour)


def _places_within(polygon: shapely.Polygon, rng: np.random.Generator) -> np.ndarray:
    found = np.zeros((0, 2))
    while len(found) < NUM_SAMPLES:
        xy_m = rng.uniform(polygon.bounds[:2], polygon.bounds[2:], (4 * NUM_SAMPLES, 2))
        found = np.vstack([found, xy_m[shapely.contains_xy(polygon, *xy_m.T)]])
    return found[:NUM_SAMPLES]


def _roof(wings: Sequence[Wing], xy_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of the highest wing at each place, z (n,), minus infinity beside all wings, and its slope (n, 2)."""
    z_m, slope = np.full(len(xy_m), -np.inf), np.zeros_like(xy_m)
    for wing in wings:
        outline = shapely.Polygon(wing.outline).buffer(_OVERLAP_M)
        number = np.flatnonzero(shapely.contains_xy(outline, *xy_m.T))
        start, along, above_m, tangent = wing.planes()
        offset = xy_m[number, None] - start
        inside_m = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
        rise_m, row = above_m + np.maximum(inside_m, 0) * tangent, np.arange(len(number))
        lowest = rise_m.argmin(axis=1)
        steep = tangent[lowest] * (inside_m[row, lowest] > 0)
        top_m = wing.eave_m + rise_m[row, lowest]
        higher = top_m > z_m[number]
        z_m[number[higher]] = top_m[higher]
        rising = np.column_stack([-along[lowest, 1], along[lowest, 0]]) * steep[:, None]
        slope[number[higher]] = rising[higher]
    return z_m, slope


def draw_batch(
    roofs: DrawnRoofs, index: np.ndarray, rng: np.random.Generator
) -> tuple[Clues, np.ndarray, np.ndarray]:
    """(clues, z (b, q) and slope (b, q, 2) at their places) of buildings ``index`` (b,), varied beyond what is drawn:
    stretched, raised, steeper, with a lower part across one end, as behind the houses of a row, with wide dormers, and
    points with errors."""
    num, row = len(index), np.arange(len(index))[:, None]
    order = rng.random((num, NUM_SAMPLES)).argsort(axis=1)
    own, asked = order[:, :MAX_POINTS], order[:, -NUM_PLACES:]
    least, most = np.log(MIN_POINTS), np.log(MAX_POINTS)
    count = np.exp(rng.uniform(least, most, num)).astype(int)
    is_point = np.arange(MAX_POINTS) < count[:, None]
    point, point_z = (_samples(each, index[:, None], own) for each in (roofs.xy, roofs.seen_z))
    place, z, slope = (_samples(each, index[:, None], asked) for each in (roofs.xy, roofs.z, roofs.slope))
    ring = np.nan_to_num(roofs.ring[index])
    is_vertex = np.isfinite(roofs.ring[index, :, 0])
    around, around_z, is_around = _around(roofs, index, count, rng)
    # the frame of the longest edge
    following = (np.arange(MAX_VERTICES) + 1) % is_vertex.sum(axis=1)[:, None]
    edge = np.where(is_vertex[..., None], ring[row, following] - ring, 0)
    longest = edge[row[:, 0], (edge**2).sum(axis=-1).argmax(axis=1)]
    turn = _turn(np.arctan2(longest[:, 1], longest[:, 0]))
    flat = [each @ turn for each in (ring, point, around, place)]
    low, high = (
        function(np.where(is_vertex[..., None], flat[0], bad), axis=1)
        for function, bad in ((np.min, np.inf), (np.max, -np.inf))
    )
    flat, half = [each - ((low + high) / 2)[:, None] for each in flat], (high - low) / 2
    slope = slope @ turn
    # other sizes, pitches and heights, and mirrored ones
    size = (
        rng.uniform(0.75, 1.25, (num, 1))
        * rng.choice([-1.0, 1.0], (num, 2))
        * rng.uniform(0.85, 1.15, (num, 2))
    )
    steeper, raised = rng.uniform(0.75, 1.25, (num, 1)), rng.uniform(-1, 1, (num, 1))
    flat = [each * size[:, None] for each in flat]
    half, slope = half * np.abs(size), slope / size[:, None] * steeper[..., None]
    heights = [each * steeper + raised for each in (point_z, around_z, z)]
    ring, point, around, place = flat
    for axis, share in ((0, 0.2), (1, 0.1)):
        _lower_part((point, around, place), heights, slope, half, (axis, share), rng)
    for share in (0.25, 0.15):
        _dormer((point, place), heights, slope, half, share, rng)
    point_z, around_z, z = heights
    point_z = point_z + rng.normal(0, _NOISE_M, point_z.shape)
    around_z = around_z + rng.normal(0, _NOISE_M, around_z.shape)
    is_low = rng.random(point_z.shape) < 0.08 * rng.random((num, 1))
    point_z = point_z - np.where(is_low, rng.uniform(0, 3, point_z.shape), 0)
    # the map is inexact, and its longest edge not quite along the house
    ring = ring + 0.1 * rng.random((num, 1, 1)) * rng.normal(size=ring.shape)
    ring = ring + 0.2 * rng.random((num, 1, 1)) * rng.normal(size=(num, 1, 2))
    turn = _turn(rng.uniform(-0.1, 0.1, num))
    mean = ((point_z * is_point).sum(axis=1) / count)[:, None]

    def scaled(xy: np.ndarray, height: np.ndarray) -> np.ndarray:
        return np.concatenate([xy @ turn, (height - mean)[..., None]], axis=-1) / SCALE_M

    clues = Clues(
        scaled(point, point_z),
        is_point,
        scaled(around, around_z),
        is_around,
        ring @ turn / SCALE_M,
        is_vertex,
        place @ turn / SCALE_M,
    )
    return clues, (z - mean) / SCALE_M, slope @ turn


def _samples(values: np.ndarray, building: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """``values`` (n, k, ..) at pairs of a building and a sample; several times faster than indexing with two arrays."""
    return values.reshape(-1, *values.shape[2:]).take(building * NUM_SAMPLES + sample, axis=0)


def _turn(angle: np.ndarray) -> np.ndarray:
    """Rotation matrices (b, 2, 2) for row vectors on their left."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)


def _around(
    roofs: DrawnRoofs, index: np.ndarray, count: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on the roofs around, the nearest ones: xy (b, a, 2), z (b, a), bool (b, a)."""
    num, beside = len(index), roofs.neighbour[index]
    chosen = rng.integers(NUM_SAMPLES, size=(num, NUM_NEIGHBOURS, NUM_OF_NEIGHBOUR))
    offset = roofs.centre[beside] - roofs.centre[index][:, None]
    xy = (_samples(roofs.xy, beside[..., None], chosen) + offset[:, :, None]).reshape(num, -1, 2)
    z = _samples(roofs.seen_z, beside[..., None], chosen).reshape(num, -1)
    is_known = (beside >= 0) & (rng.random((num, 1)) < 0.7)
    is_known = is_known[..., None] & (np.arange(NUM_OF_NEIGHBOUR) < count[:, None, None])
    low, high = (function.reduce(roofs.ring[index], axis=1)[:, None] for function in (np.fmin, np.fmax))
    x, y = np.moveaxis(np.maximum(np.maximum(low - xy, xy - high), 0), -1, 0)
    away = np.where(is_known.reshape(num, -1), np.sqrt(x**2 + y**2), np.inf)
    nearest = away.argsort(axis=1)[:, :MAX_AROUND]
    is_near = np.take_along_axis(away, nearest, axis=1) < _NEAR_M
    xy = np.take_along_axis(xy, nearest[..., None], axis=1)
    return np.where(is_near[..., None], xy, 0), np.take_along_axis(z, nearest, axis=1), is_near


def _lower_part(
    flat: Sequence[np.ndarray],
    heights: list[np.ndarray],
    slope: np.ndarray,
    half: np.ndarray,
    where: tuple[int, float],
    rng: np.random.Generator,
) -> None:
    """For a random share of the buildings, lower the roof at one end along an axis, and often the roofs around, too.
    Changes ``heights`` of points, points around and places, and ``slope`` of places."""
    axis, share = where
    num = len(half)

    def column(low: float, high: float) -> np.ndarray:
        return rng.uniform(low, high, (num, 1))

    side, other_side = rng.choice([-1.0, 1.0], (2, num, 1))
    start = half[:, axis : axis + 1] * (1 - 2 * column(0.1, 0.55))
    cut = column(-0.6, 0.6) * half[:, 1 - axis : 2 - axis]
    is_corner, is_on = column(0, 1) < 0.35, column(0, 1) < share
    storey = column(0, 1) < 0.6
    higher = 0.8 * np.maximum(heights[2].mean(axis=1, keepdims=True) - 2.3, 0.3)
    low = 2.3 + column(0, 1) * np.where(storey, 1.2, higher)
    tilt = np.where(column(0, 1) < 0.7, 0, column(-0.4, 0.4))
    is_lowered = (is_on, is_on & (column(0, 1) < 0.7), is_on)
    for number, (xy, is_part) in enumerate(zip(flat, is_lowered, strict=True)):
        along = xy[..., axis] * side
        inside = is_part & (along > start) & (~is_corner | (xy[..., 1 - axis] * other_side > cut))
        part_z = np.maximum(low + tilt * (along - start), 1)
        heights[number] = np.where(inside, part_z, heights[number])
    slope[inside] = 0
    slope[..., axis] = np.where(inside, tilt * side, slope[..., axis])


def _dormer(
    flat: Sequence[np.ndarray],
    heights: list[np.ndarray],
    slope: np.ndarray,
    half: np.ndarray,
    share: float,
    rng: np.random.Generator,
) -> None:
    """For a random share of the buildings, raise a level box out of the roof."""
    num = len(half)
    middle = rng.uniform(-0.8, 0.8, (num, 1, 2)) * half[:, None]
    size = rng.uniform(0.8, 2.8, (num, 1, 2))
    nearest = np.abs(flat[1] - middle).sum(axis=-1).argmin(axis=1)
    top = (heights[2][np.arange(num), nearest] + rng.random(num))[:, None]
    is_on = rng.random((num, 1)) < share
    for number, xy in zip((0, 2), flat, strict=True):
        is_along, is_across = np.moveaxis(np.abs(xy - middle) < size, -1, 0)
        inside = is_on & is_along & is_across & (heights[number] < top) & (top < heights[number] + 2.5)
        heights[number] = np.where(inside, top, heights[number])
    slope[inside] = 0
