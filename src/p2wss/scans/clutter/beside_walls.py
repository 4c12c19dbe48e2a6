"""Clutter beside walls: annexes that the footprint does not include, and trees."""

import numpy as np
import shapely

from p2wss.data.polygon_arrays import to_geometries
from p2wss.scans.clutter.buildings import (
    STREAM_STEP,
    ClutterTriangles,
    LocalBuildings,
    between,
    blocks,
    draw_buildings,
    draw_edges,
    left_of,
    rectangles,
)
from p2wss.scans.randomness import uniforms
from p2wss.scans.surface import ClutterKind
from p2wss.scans.terrain import TerrainGrid

# Sizes are drawn evenly between two values in metres. An annex is as wide as its wall allows, and lower than the eaves
# by at least the given height. Between its wall and the footprint is a small gap, and footprints of neighbours may
# overlap it by a tolerance.
_ANNEX_WIDTH_M, _ANNEX_DEPTH_M, _ANNEX_HEIGHT_M = (2.5, 6), (2, 6), (2.2, 3.2)
_ANNEX_BELOW_EAVE_M, _ANNEX_GAP_M, _ANNEX_TOLERANCE_M, _MIN_HALF_SIZE_M = 0.3, 0.01, 0.05, 0.1
_MAX_TREES = 6
_CROWN_RADIUS_M, _TREE_HEIGHT_M, _TRUNK_TO_WALL_M = (1.2, 4.2), (4, 14), (0.5, 7)
# shares of a tree's height: the largest radius of its crown, and the height of the crown
_MAX_RADIUS_SHARE, _CROWN_SHARE = 0.45, (0.55, 0.85)
# leaf area over a square metre of ground: 1 lets a third of the pulses through, 3 one in twenty
_LEAF_AREA_INDEX = (1.0, 3.0)
_LEAF_AREA_M2 = 0.35  # of a triangle, which stands for a clump of leaves
_UNIT_TRIANGLE_M2 = 0.47  # the mean area of a triangle with corners in a ball of radius 1
_MAX_LEAVES = 2000


def annexes(buildings: LocalBuildings, share: float) -> ClutterTriangles:
    """Garages and sheds against a wall that the footprint does not include, lower than the eaves.

    None stands where it would intersect a footprint.
    """
    rows, u = draw_buildings(buildings, ClutterKind.ANNEX, share)
    edge, length, outwards = draw_edges(buildings, rows, u[:, 0])
    width = np.minimum(between(u[:, 1], *_ANNEX_WIDTH_M), length)
    depth = between(u[:, 2], *_ANNEX_DEPTH_M)
    along = left_of(outwards)
    middle = buildings.polygons.xy_m[edge] + (0.5 * width + u[:, 3] * (length - width))[:, None] * along
    half = np.stack([width, depth], axis=1) / 2
    middle = middle + (half[:, 1] + _ANNEX_GAP_M)[:, None] * outwards
    top = buildings.terrain_z_m[rows] + between(u[:, 4], *_ANNEX_HEIGHT_M)
    fits = (length >= _ANNEX_WIDTH_M[0]) & (top < buildings.eave_z_m[rows] - _ANNEX_BELOW_EAVE_M)
    outline = rectangles(middle, along, half)
    shrunk = shapely.polygons(
        rectangles(middle, along, np.maximum(half - _ANNEX_TOLERANCE_M, _MIN_HALF_SIZE_M))
    )
    fits &= ~_meet_footprints(buildings, np.asarray(shrunk))
    return blocks(outline[fits], buildings.base_z_m[rows][fits] - 1, top[fits], rows[fits])


def trees(terrain: TerrainGrid, buildings: LocalBuildings, mean: float) -> ClutterTriangles:
    """Crowns of small random triangles, beside walls and over roofs; pulses pass between the leaves.

    ``mean`` is the number of trees per building on average. No trunk stands on a footprint.
    """
    draws = uniforms(buildings.key, ClutterKind.TREE * STREAM_STEP, 1 + 8 * _MAX_TREES)
    # Poisson numbers by inversion
    term = np.exp(-mean) * np.cumprod(np.concatenate([[1.0], mean / np.arange(1, _MAX_TREES)]))
    num_trees = np.searchsorted(np.cumsum(term), draws[:, 0])
    num_trees[np.diff(buildings.polygons.polygon_offset) == 0] = 0
    rows = np.repeat(np.arange(len(num_trees)), num_trees)
    which = np.arange(len(rows)) - np.repeat(np.cumsum(num_trees) - num_trees, num_trees)
    u = draws[:, 1:].reshape(len(draws), _MAX_TREES, 8)[rows, which]
    edge, length, outwards = draw_edges(buildings, rows, u[:, 0])
    radius, height = between(u[:, 1], *_CROWN_RADIUS_M), between(u[:, 2], *_TREE_HEIGHT_M)
    radius = np.minimum(radius, _MAX_RADIUS_SHARE * height)
    to_wall = between(u[:, 3], *_TRUNK_TO_WALL_M)
    xy = (
        buildings.polygons.xy_m[edge]
        + (u[:, 4] * length)[:, None] * left_of(outwards)
        + to_wall[:, None] * outwards
    )
    is_free = ~_meet_footprints(buildings, np.asarray(shapely.points(xy)))
    foot = _nearest_height(terrain, xy, buildings.terrain_z_m[rows])
    crown_height = between(u[:, 5], *_CROWN_SHARE) * height
    middle = np.column_stack([xy, foot + height - crown_height / 2])
    leaf_area = np.pi * radius**2 * between(u[:, 6], *_LEAF_AREA_INDEX)
    num_leaves = np.minimum(np.ceil(leaf_area / (0.5 * _LEAF_AREA_M2)), _MAX_LEAVES).astype(np.int64) // 2 + 1
    num_leaves[~is_free] = 0
    keys = buildings.key[rows] + np.uint64(1) + which.astype(np.uint64)
    tree = np.repeat(np.arange(len(rows)), num_leaves)
    v = _leaf_draws(keys, num_leaves)
    half = np.column_stack([radius, radius, crown_height / 2])[tree]
    size = np.sqrt(_LEAF_AREA_M2 / _UNIT_TRIANGLE_M2)
    corner = (middle[tree] + _in_ball(v[:, 0], v[:, 1], v[:, 2]) * half)[:, None] + size * np.stack(
        [_in_ball(v[:, i], v[:, i + 1], v[:, i + 2]) for i in (3, 6, 9)], axis=1
    )
    return ClutterTriangles(corner, rows[tree].astype(np.int32), tree.astype(np.int32))


def _meet_footprints(buildings: LocalBuildings, shapes: np.ndarray) -> np.ndarray:
    """Which shapes intersect a footprint, bool (k,)."""
    index, _ = shapely.STRtree(to_geometries(buildings.polygons)).query(shapes, predicate="intersects")
    result = np.zeros(len(shapes), bool)
    result[index] = True
    return result


def _leaf_draws(keys: np.ndarray, num_leaves: np.ndarray) -> np.ndarray:
    """Twelve uniform draws per leaf, (l, 12), tree by tree."""
    parts = [np.zeros((0, 12))]
    parts += [uniforms(keys[i : i + 1], 2**40, 12 * int(n)).reshape(-1, 12) for i, n in enumerate(num_leaves)]
    return np.concatenate(parts)


def _in_ball(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Uniform points in the unit ball from three uniform draws each, float64 (n, 3)."""
    z, turn, radius = 2 * u - 1, 2 * np.pi * v, np.cbrt(w)
    flat = np.sqrt(1 - z * z)
    return radius[:, None] * np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])


def _nearest_height(grid: TerrainGrid, xy: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Height of the nearest cell of the terrain, or ``otherwise`` where it has none, float64 (k,)."""
    rows, columns = grid.height_m.shape
    column = np.rint((xy[:, 0] - grid.x_min_m) / grid.cell_m).astype(int)
    row = np.rint((grid.y_max_m - xy[:, 1]) / grid.cell_m).astype(int)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    height = np.where(inside, grid.height_m[np.where(inside, row, 0), np.where(inside, column, 0)], np.nan)
    return np.where(np.isfinite(height), height, otherwise)
