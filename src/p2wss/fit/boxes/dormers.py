"""Dormers and other small boxes that rise out of a roof, and recesses in it (terraces, loggias, corners that the
building leaves out), as the points above and below the roof show them.

Everything is in the frame of :func:`p2wss.fit.parts.parts.main_frame`: a box is a rectangle along its axes, clipped
to the footprint, with a flat top. Where the roof is higher than the box, the roof stays; where it is lower than the
floor of a recess, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy import ndimage

from p2wss.fit.boxes.intervals import Survey, grow_box
from p2wss.fit.parts.roofs import Roof
from p2wss.fit.roof.fitter import FittedRoof, Fitter
from p2wss.fit.settings import Boxes

_CELL_M = 0.8
# a side within this distance of the footprint's edge is moved onto it
_TO_WALL_M = 0.6
# a strip of which less than this share is over the footprint ends at a wall
_INSIDE_SHARE = 0.9
# a side within this distance of a cut between parts is moved onto the cut
_TO_CUT_M = 0.15
# a box gains at most this multiple of the residuals of the points from which its search begins
_MOST_GAIN = 2.0


@dataclass(frozen=True)
class Box:
    """A box that rises out of a roof up to ``top_z_m`` or, if ``is_recess``, space above ``top_z_m`` that the roof
    leaves out. ring: (n, 2), counter-clockwise; of a recess, the rectangle."""

    ring: np.ndarray
    top_z_m: float
    is_recess: bool

    def as_part(self) -> FittedRoof:
        """The box as a part; a flat roof has 0 degrees all around."""
        return FittedRoof([self.ring], np.zeros(len(self.ring)), self.top_z_m, np.inf, 0)


def find_boxes(
    fitter: Fitter,
    parts: Sequence[Roof],
    point_m: np.ndarray,
    boxes: Boxes,
    price_share: float = 1.0,
) -> tuple[float, list[Box]]:
    """(sum of the residuals of all points with the boxes, the boxes that the points (m, 3) show on the roofs of
    ``parts``). Each box lowers the sum by at least ``price_share`` of its price; the one that gains most comes
    first."""
    price_m = price_share * boxes.price_m(len(point_m))
    roof_z, slant = _roof_over(fitter, parts, point_m)
    x, y, z = np.ascontiguousarray(point_m.T)
    result: list[Box] = []
    footprint, lines = None, []
    orders = np.argsort(x, kind="stable"), np.argsort(y, kind="stable")
    reach_m, extent_m = boxes.max_area_m2**0.5, float(max(np.ptp(x), np.ptp(y)))
    grown: dict[tuple[int, bytes], tuple[float, np.ndarray, np.ndarray, float]] = {}
    signs = (1, -1) if boxes.recesses else (1,)
    while True:
        above_m = (z - roof_z) * slant
        before = np.minimum(np.abs(above_m), boxes.cap_m)
        survey = Survey(x, y, z, roof_z, slant, before, *orders)
        best_gain, best = price_m, None
        for sign in signs if len(result) < boxes.max_boxes else ():
            off = sign * above_m > boxes.above_m
            # together, the clusters have no more to gain than all their points
            if _MOST_GAIN * before[off].sum() <= best_gain:
                continue
            for seed in _clusters(point_m, off, boxes.min_points):
                if _MOST_GAIN * before[seed].sum() <= best_gain:
                    continue
                key = sign, seed.tobytes()
                if key not in grown:
                    near, near_seed = survey, seed
                    around = _around(x, y, seed, reach_m) if extent_m > reach_m else None
                    if around is not None:
                        near, near_seed = survey.of(around), (np.cumsum(around) - 1)[seed]
                    grown[key] = grow_box(near, near_seed, sign, boxes.above_m, boxes.cap_m, boxes.min_points)
                gain, low, high, top = grown[key]
                if gain > best_gain:
                    if footprint is None:
                        footprint = shapely.union_all(
                            [shapely.Polygon(p.rings[0], p.rings[1:]) for p in parts]
                        )
                        lines = [
                            np.unique(np.concatenate([ring[:, axis] for p in parts for ring in p.rings]))
                            for axis in (0, 1)
                        ]
                    ring = _on_footprint(footprint, lines, low, high, boxes, sign < 0)
                    if ring is not None:
                        best_gain, best = gain, (ring, top, sign)
        if best is None:
            return float(before.sum()), result
        ring, top, sign = best
        box = Box(ring, top, sign < 0)
        changed = is_over_boxes([box], point_m)
        changed[changed] = sign * (top - roof_z[changed]) > 0
        result.append(box)
        roof_z, slant = np.where(changed, top, roof_z), np.where(changed, 1.0, slant)
        grown = {key: value for key, value in grown.items() if not _covers_any(*value[1:3], point_m[changed])}


def is_over_boxes(boxes: Sequence[Box], point_m: np.ndarray) -> np.ndarray:
    """Which points (m, 3) lie over one of the boxes, bool (m,)."""
    within = np.zeros(len(point_m), bool)
    for box in boxes:
        within |= shapely.contains_xy(shapely.Polygon(box.ring), point_m[:, 0], point_m[:, 1])
    return within


def _covers_any(low: np.ndarray, high: np.ndarray, point_m: np.ndarray) -> bool:
    return bool(((point_m[:, :2] >= low) & (point_m[:, :2] <= high)).all(axis=1).any())


def _around(x: np.ndarray, y: np.ndarray, seed: np.ndarray, reach_m: float) -> np.ndarray | None:
    """Which points are within ``reach_m`` of those in ``seed`` along both axes, as far as a box may reach; None if all
    are."""
    around = np.ones(len(x), bool)
    for along in (x, y):
        around &= (along >= along[seed].min() - reach_m) & (along <= along[seed].max() + reach_m)
    return None if around.all() else around


def _roof_over(fitter: Fitter, parts: Sequence[Roof], point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(height of the topmost roof, z of its unit normal) over each point (m, 3); minus infinity and 1 outside the
    parts."""
    height, slant = np.full(len(point_m), -np.inf), np.ones(len(point_m))
    for part in parts:
        low, high = part.rings[0].min(axis=0), part.rings[0].max(axis=0)
        near = np.flatnonzero(((point_m[:, :2] >= low) & (point_m[:, :2] <= high)).all(axis=1))
        z, of_part = part.height_over(point_m[near], fitter)
        higher = z > height[near]
        height[near[higher]], slant[near[higher]] = z[higher], of_part[higher]
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


def _on_footprint(
    footprint: shapely.Geometry,
    lines: Sequence[np.ndarray],
    low: np.ndarray,
    high: np.ndarray,
    boxes: Boxes,
    is_recess: bool,
) -> np.ndarray | None:
    """The counter-clockwise ring of a box whose sides are moved to walls and cuts nearby, and that is clipped to the
    footprint unless it is a recess; None if its size is not allowed."""
    bounds = np.concatenate([low, high])
    if min(high - low) < boxes.min_width_m:
        return None
    for side in range(4):
        nearest = lines[side % 2][np.argmin(np.abs(lines[side % 2] - bounds[side]))]
        if abs(nearest - bounds[side]) < _TO_CUT_M:
            bounds[side] = nearest
    bounds = moved_to_walls(bounds, footprint, _TO_WALL_M)
    rectangle = shapely.box(*bounds)
    shape = rectangle.intersection(footprint)
    largest = min(boxes.max_area_m2, boxes.max_share * float(shapely.area(footprint)))
    if (
        not isinstance(shape, shapely.Polygon)
        or shape.interiors
        or not boxes.min_area_m2 <= shape.area <= largest
    ):
        return None
    if is_recess:
        shape = rectangle
    return shapely.get_coordinates(shapely.orient_polygons(shape.simplify(0.01)))[:-1]


def moved_to_walls(bounds: np.ndarray, footprint: shapely.Geometry, reach_m: float) -> np.ndarray:
    """The bounds (4,) of a rectangle, the low ones first, with those sides moved outwards by ``reach_m`` beside which
    the footprint ends within that distance."""
    # for each side the bounds of the strip beyond it, before any side is moved
    strips = np.tile(bounds, (4, 1))
    for side in range(4):
        strips[side, side] += -reach_m if side < 2 else reach_m
        strips[side, (side + 2) % 4] = bounds[side]
    beyond = shapely.box(*strips.T)
    ends_at_wall = shapely.area(shapely.intersection(beyond, footprint)) < _INSIDE_SHARE * shapely.area(
        beyond
    )
    return np.where(ends_at_wall, strips.diagonal(), bounds)
