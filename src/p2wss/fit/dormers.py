"""Box dormers and other small boxes that rise out of a roof, as the points above the roof show them.

Everything is in the frame of :func:`p2wss.fit.parts.main_frame`: a box is a rectangle along its axes, clipped to the
footprint, with a flat top. Where the roof is higher than the box, the roof stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy import ndimage

from p2wss.fit.one_height import FittedRoof, Gain

_CELL_M = 0.8
_NUM_ROUNDS = 6
# a side lies midway between the points on either side of it, but never further than this from those inside
_MAX_GAP_M = 0.3
# how far a box extends below a rising roof, so that it ends inside the roof without a wall
_INTO_ROOF_M = 1.0
# a side within this distance of the footprint's edge is moved onto it
_TO_WALL_M = 0.6
# a side within this distance of a cut between parts is moved onto the cut
_TO_CUT_M = 0.15


@dataclass(frozen=True)
class Boxes(Gain):
    """Which boxes a building may have.

    max_boxes: of one building. above_m: how far above the roof a point has to lie for the search of a box to begin
    there. cap_m: larger residuals count as this. min_points: above the roof in a box. max_share: of the footprint's
    area that one box may cover.
    """

    max_boxes: int = 4
    above_m: float = 0.4
    cap_m: float = 1.0
    min_points: int = 5
    min_width_m: float = 0.8
    min_area_m2: float = 1.0
    max_area_m2: float = 40.0
    max_share: float = 0.5


def find_boxes(
    parts: Sequence[FittedRoof],
    vertex_m: np.ndarray,
    triangle: np.ndarray,
    point_m: np.ndarray,
    min_gain_m: float,
    boxes: Boxes,
) -> tuple[float, list[FittedRoof]]:
    """(sum of the residuals of all points with the boxes, the boxes that the points show above the mesh of ``parts``).

    Each box lowers the sum by at least ``min_gain_m``; the one that gains most comes first. A box is a part with a
    flat top, 0 degrees all around. vertex_m (v, 3), triangle (t, 3): the mesh, in the heights of the points (m, 3).
    """
    footprint = shapely.union_all([shapely.Polygon(part.rings[0], part.rings[1:]) for part in parts])
    lines = [np.unique(np.concatenate([ring[:, axis] for p in parts for ring in p.rings])) for axis in (0, 1)]
    roof_z, slant = roof_over(vertex_m, triangle, point_m[:, :2])
    result: list[FittedRoof] = []
    while True:
        best_gain, best = min_gain_m, None
        above = (point_m[:, 2] - roof_z) * slant > boxes.above_m
        seeds = _clusters(point_m, above, boxes.min_points) if len(result) < boxes.max_boxes else []
        for seed in seeds:
            gain, low, high, top = _grow_box(point_m, roof_z, slant, seed, boxes)
            if gain > best_gain:
                ring = _on_footprint(footprint, lines, low, high, boxes)
                if ring is not None:
                    best_gain, best = gain, (ring, top)
        if best is None:
            loss = np.minimum(np.abs(point_m[:, 2] - roof_z) * slant, boxes.cap_m).sum()
            return float(loss), result
        ring, top = best
        inside = shapely.contains_xy(shapely.Polygon(ring), point_m[:, 0], point_m[:, 1])
        raised = inside & (roof_z < top)
        result.append(FittedRoof([ring], np.zeros(len(ring)), top, np.inf, best_gain, int(inside.sum())))
        roof_z, slant = np.where(raised, top, roof_z), np.where(raised, 1.0, slant)


def is_over_boxes(boxes: Sequence[FittedRoof], point_m: np.ndarray) -> np.ndarray:
    """Which points (m, 3) lie over one of the boxes, bool (m,)."""
    within = np.zeros(len(point_m), bool)
    for box in boxes:
        within |= shapely.contains_xy(shapely.Polygon(box.rings[0]), point_m[:, 0], point_m[:, 1])
    return within


def roof_over(vertex_m: np.ndarray, triangle: np.ndarray, xy_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(height of the mesh's topmost face, z of its unit normal) over each position (m, 2); minus infinity and 1 outside
    the mesh."""
    corner = vertex_m[triangle]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(normal, axis=1)
    upward = normal[:, 2] > 1e-6 * np.maximum(length, 1e-9)
    height, slant = np.full(len(xy_m), -np.inf), np.ones(len(xy_m))
    for (a, b, c), n, size in zip(corner[upward], normal[upward], length[upward], strict=True):
        within = np.ones(len(xy_m), bool)
        for p, q in ((a, b), (b, c), (c, a)):
            within &= (q[0] - p[0]) * (xy_m[:, 1] - p[1]) - (q[1] - p[1]) * (xy_m[:, 0] - p[0]) >= -1e-9
        z = a[2] - ((xy_m - a[:2]) @ n[:2]) / n[2]
        higher = within & (z > height)
        height[higher], slant[higher] = z[higher], n[2] / size
    return height, slant


def _clusters(point_m: np.ndarray, above: np.ndarray, min_points: int) -> list[np.ndarray]:
    """Indices of the points above the roof, in groups of touching cells."""
    chosen = np.flatnonzero(above)
    if len(chosen) < min_points:
        return []
    cell = np.floor((point_m[chosen, :2] - point_m[chosen, :2].min(axis=0)) / _CELL_M).astype(int)
    grid = np.zeros(cell.max(axis=0) + 1, bool)
    grid[cell[:, 0], cell[:, 1]] = True
    label, count = ndimage.label(grid, np.ones((3, 3)))
    cluster = label[cell[:, 0], cell[:, 1]]
    groups = [chosen[cluster == k] for k in range(1, count + 1)]
    return [group for group in groups if len(group) >= min_points]


def _grow_box(
    point_m: np.ndarray, roof_z: np.ndarray, slant: np.ndarray, seed: np.ndarray, boxes: Boxes
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """(gain in metres of loss, low corner, high corner, top) of the box that gains most, from that around a
    cluster: alternately the best interval along each axis, exactly, and the top."""
    xy, z = point_m[:, :2], point_m[:, 2]
    before = np.minimum(np.abs(z - roof_z) * slant, boxes.cap_m)
    low, high = np.quantile(xy[seed], 0.02, axis=0) - 1e-6, np.quantile(xy[seed], 0.98, axis=0) + 1e-6
    top = float(np.median(z[seed]))
    best = (0.0, low, high, top)
    for _ in range(_NUM_ROUNDS):
        gain = np.where(roof_z < top, before - np.minimum(np.abs(z - top), boxes.cap_m), 0.0)
        low, high = low.copy(), high.copy()
        for axis in (0, 1):
            other = 1 - axis
            in_strip = np.flatnonzero((xy[:, other] >= low[other]) & (xy[:, other] <= high[other]))
            if not len(in_strip):
                return best
            low[axis], high[axis] = _interval(xy[in_strip, axis], gain[in_strip])
        inside = ((xy >= low) & (xy <= high)).all(axis=1)
        total = float(gain[inside].sum())
        above = inside & ((z - roof_z) * slant > 0.5 * boxes.above_m)
        if total <= best[0] + 1e-9 or above.sum() < boxes.min_points:
            break
        best = (total, low, high, top)
        top = float(np.median(z[above]))
    return best


def _interval(position: np.ndarray, gain: np.ndarray) -> tuple[float, float]:
    """Ends of the interval with the greatest sum of gains. An end lies midway to the next point that a longer interval
    would change, and further on below a rising roof (see :func:`_end`)."""
    order = np.argsort(position, kind="stable")
    position, sums = position[order], np.concatenate([[0.0], np.cumsum(gain[order])])
    start = np.maximum.accumulate(-sums[:-1])
    last = int(np.argmax(sums[1:] + start))
    first = int(np.flatnonzero(-sums[: last + 1] >= start[last])[-1])
    is_neutral = gain[order] == 0.0
    return (
        -_end(-position[first::-1], is_neutral[first::-1]),
        _end(position[last:], is_neutral[last:]),
    )


def _end(position: np.ndarray, is_neutral: np.ndarray) -> float:
    """The end of an interval whose last point is the first of ``position``, which ascends from there.

    is_neutral: points whose residual the box does not change, as the roof is higher there.
    """
    affected = np.flatnonzero(~is_neutral[1:]) + 1
    gap = float(position[affected[0]] - position[0]) if len(affected) else np.inf
    below_roof = position[: affected[0] if len(affected) else None]
    if gap > _INTO_ROOF_M and len(below_roof) > 1:
        return float(min(below_roof[-1], position[0] + _INTO_ROOF_M))
    return float(position[0] + min(0.5 * gap, _MAX_GAP_M))


def _on_footprint(
    footprint: shapely.Geometry, lines: Sequence[np.ndarray], low: np.ndarray, high: np.ndarray, boxes: Boxes
) -> np.ndarray | None:
    """The counter-clockwise ring of a box that is clipped to the footprint and whose sides are moved to walls and cuts
    nearby; None if its size is not allowed."""
    bounds = [low[0], low[1], high[0], high[1]]
    if min(high - low) < boxes.min_width_m:
        return None
    for side in range(4):
        nearest = lines[side % 2][np.argmin(np.abs(lines[side % 2] - bounds[side]))]
        if abs(nearest - bounds[side]) < _TO_CUT_M:
            bounds[side] = nearest
    # strips are those of the bounds before any side is moved beyond a wall
    original = list(bounds)
    for side in range(4):
        strip = list(original)
        strip[side] += -_TO_WALL_M if side < 2 else _TO_WALL_M
        strip[(side + 2) % 4] = original[side]
        beyond = shapely.box(*strip)
        if beyond.intersection(footprint).area < 0.9 * beyond.area:
            bounds[side] = strip[side]
    shape = shapely.box(*bounds).intersection(footprint)
    largest = min(boxes.max_area_m2, boxes.max_share * float(shapely.area(footprint)))
    if (
        not isinstance(shape, shapely.Polygon)
        or shape.interiors
        or not boxes.min_area_m2 <= shape.area <= largest
    ):
        return None
    return shapely.get_coordinates(shapely.orient_polygons(shape.simplify(0.01)))[:-1]
