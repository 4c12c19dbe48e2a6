"""Discontinuous heights: a footprint cut along height jumps into parts with a roof each.

Cuts run along the footprint's main axes, so the polygon is turned into them first (:func:`main_frame`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.refine.jumps import jump_lines
from p2wss.refine.one_height import Effort, Fitter, OneHeight
from p2wss.refine.points import even_order, every_kth
from p2wss.refine.starts import edges

_LINES_PER_AXIS, _CORNERS_PER_AXIS = 3, 3
_CORNER_M, _NEARBY_M = 0.3, 0.35
_SHIFTS_M = (-0.25, -0.12, 0.12, 0.25)
_LEAST_AREA_M2, _HALF_WIDTH_M, _CLEARANCE_M = 2.0, 0.45, 0.05
_LEAST_POINTS = 10
# a cut through a corner of the footprint is preferred at this ratio of losses
_OFF_CORNER = 1.02
_NOISE_M = 0.03
_NUM_JUMP_POINTS = 1000
_SCREEN = Effort(num_search_points=60, num_points=60, num_descents=0)


@dataclass(frozen=True)
class Cutting:
    """max_parts: of one building. gain_m: metres of loss, over all its points, that one more part must gain;
    gain_share: and that share of the loss of what it cuts."""

    max_parts: int = 4
    gain_m: float = 0.012
    gain_share: float = 0.1


@dataclass(frozen=True)
class _Part:
    polygon: shapely.Polygon
    point_m: np.ndarray
    fit: OneHeight


@dataclass(frozen=True)
class _Split:
    gain_m: float
    parts: tuple[_Part, _Part]


def main_frame(rings: Sequence[np.ndarray]) -> np.ndarray:
    """Rotation (2, 2) with ``xy @ rotation`` along the axes that the edges prefer."""
    own = edges(rings)
    main = own.axis == 0
    turn = float(np.angle(np.sum(own.length_m[main] * np.exp(2j * own.bearing_rad[main])))) / 2
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


def fit_parts(
    fitter: Fitter,
    rings: Sequence[np.ndarray],
    point_m: np.ndarray,
    effort: Effort,
    cutting: Cutting,
    guesses: Sequence[np.ndarray] = (),
) -> list[OneHeight]:
    """The parts of a building, one if no cut gains enough; none if there is no roof to fit. All in the frame of
    ``rings``, which is that of :func:`main_frame`; vertices on a cut have exactly its coordinate.

    Greedy: the cut that gains most is made first. ``effort``: for each part that stays.
    """
    point_m = point_m[even_order(point_m)] if len(point_m) else point_m
    whole = fitter.fit(rings, point_m, effort, guesses)
    if whole is None:
        return []
    parts = [_Part(shapely.Polygon(rings[0], rings[1:]), point_m, whole)]
    splits: list[_Split | None] = [None]
    tried = [False]
    least = cutting.gain_m * len(point_m)
    while len(parts) < cutting.max_parts:
        for i, part in enumerate(parts):
            if not tried[i]:
                splits[i], tried[i] = _best_split(fitter, part, least, effort, cutting), True
        i = max(range(len(parts)), key=lambda k: split.gain_m if (split := splits[k]) else 0.0)
        chosen = splits[i]
        if chosen is None:
            break
        parts[i : i + 1] = chosen.parts
        splits[i : i + 1] = [None, None]
        tried[i : i + 1] = [False, False]
    return [fitter.tidied(part.fit, part.point_m, effort) for part in parts]


def _best_split(fitter: Fitter, part: _Part, least: float, effort: Effort, cutting: Cutting) -> _Split | None:
    loss, count = part.fit.total_loss_m, len(part.point_m)
    if loss - _NOISE_M * count < least or count < 2 * _LEAST_POINTS:
        return None
    xy_m = np.concatenate(list(part.fit.rings))
    screened = []
    for axis in (0, 1):
        for position in _candidates(part, xy_m, axis):
            found = _cut(fitter, part, axis, position, _SCREEN)
            if found is not None:
                screened.append((_total(found), axis, position))
    if not screened:
        return None
    _, axis, position = min(screened)
    corners = xy_m[:, axis]
    near = [float(c) for c in np.unique(corners[np.abs(corners - position) < _NEARBY_M])]
    best: tuple[float, float] | None = None
    for place in dict.fromkeys([position, *near, *(position + shift for shift in _SHIFTS_M)]):
        found = _cut(fitter, part, axis, place, _SCREEN)
        if found is not None:
            at_corner = bool((np.abs(corners - place) < 1e-9).any())
            cost = _total(found) * (1.0 if at_corner else _OFF_CORNER)
            if best is None or (cost, place) < best:
                best = (cost, place)
    final = _cut(fitter, part, axis, best[1], effort) if best else None
    if final is None:
        return None
    gain = loss - _total(final)
    return _Split(gain, final) if gain >= max(least, cutting.gain_share * loss) else None


def _candidates(part: _Part, xy_m: np.ndarray, axis: int) -> list[float]:
    some = part.point_m[every_kth(len(part.point_m), _NUM_JUMP_POINTS)]
    lines = jump_lines(xy_m, some, axis, _LINES_PER_AXIS)
    corners = [float(c) for c in np.unique(np.round(xy_m[:, axis], 9))]
    far = [c for c in corners if all(abs(c - line) >= _CORNER_M for line in lines)]
    low, high = xy_m[:, axis].min() + 2 * _HALF_WIDTH_M, xy_m[:, axis].max() - 2 * _HALF_WIDTH_M
    return lines + [c for c in far if low < c < high][:_CORNERS_PER_AXIS]


def _total(parts: tuple[_Part, _Part]) -> float:
    return parts[0].fit.total_loss_m + parts[1].fit.total_loss_m


def _cut(
    fitter: Fitter, part: _Part, axis: int, position: float, effort: Effort
) -> tuple[_Part, _Part] | None:
    """Both sides of the cut, fitted. None: a side is no polygon, too thin or small, or has too few points."""
    low_side = part.point_m[:, axis] < position
    if min(np.count_nonzero(low_side), np.count_nonzero(~low_side)) < _LEAST_POINTS:
        return None
    x_min, y_min, x_max, y_max = part.polygon.bounds
    low, high = [x_min - 1, y_min - 1, x_max + 1, y_max + 1], [x_min - 1, y_min - 1, x_max + 1, y_max + 1]
    low[2 + axis] = high[axis] = position
    clearance = shapely.minimum_clearance(part.polygon)
    made = []
    for bounds, own in ((low, low_side), (high, ~low_side)):
        side = shapely.intersection(part.polygon, shapely.box(bounds[0], bounds[1], bounds[2], bounds[3]))
        if not isinstance(side, shapely.Polygon) or side.area < _LEAST_AREA_M2:
            return None
        if shapely.buffer(side, -_HALF_WIDTH_M, quad_segs=1).is_empty:
            return None
        rings = _rings(side, axis, position)
        polygon = shapely.Polygon(rings[0], rings[1:])
        # a cut that grazes an edge leaves a sliver or a part that touches itself
        if not shapely.minimum_clearance(polygon) >= min(_CLEARANCE_M, clearance):
            return None
        fit = fitter.fit(rings, part.point_m[own], effort, [_inherited(part.fit, rings)])
        if fit is None:
            return None
        made.append(_Part(polygon, part.point_m[own], fit))
    return made[0], made[1]


def _rings(polygon: shapely.Polygon, axis: int, position: float) -> list[np.ndarray]:
    oriented = shapely.orient_polygons(polygon, exterior_cw=False)
    rings = []
    for ring in (oriented.exterior, *oriented.interiors):
        xy = np.array(ring.coords)[:-1, :2]
        on_cut = np.abs(xy[:, axis] - position) < 1e-6
        xy[on_cut, axis] = position
        # a vertex between two collinear pieces of the cut
        inner = on_cut & np.roll(on_cut, 1) & np.roll(on_cut, -1)
        rings.append(xy[~inner])
    return rings


def _inherited(parent: OneHeight, rings: Sequence[np.ndarray]) -> np.ndarray:
    """Angles of the parent for edges that lie on its own, 90 for the cut."""
    start = np.concatenate(list(parent.rings))
    along = np.concatenate([np.roll(ring, -1, axis=0) for ring in parent.rings]) - start
    squared = (along**2).sum(axis=1)
    middle = np.concatenate([(ring + np.roll(ring, -1, axis=0)) / 2 for ring in rings])
    offset = middle[:, None] - start
    share = np.clip((offset * along).sum(axis=2) / squared, 0, 1)
    gap = np.hypot(*np.moveaxis(offset - share[..., None] * along, 2, 0))
    nearest = gap.argmin(axis=1)
    on_parent = gap[np.arange(len(middle)), nearest] < 1e-4
    return np.where(on_parent, parent.angle_deg[nearest], 90.0)
