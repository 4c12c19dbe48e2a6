"""An outline read by the network, fitted to the points of the building.

Number and order of the vertices are those of the reading. The outline is sought among the polygons whose edges lie in
two perpendicular directions (:func:`_search`): the one that holds the points on the roof and none on the ground. Then
each edge is moved and turned to where its own points show the end of the roof (:func:`_fit_edges`). Where a building
continues beyond an edge, as at a party wall, that end is not shown, and the edge stays where the network read it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import shapely
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from p2wss.clouds.las_classes import BUILDING_CLASS, GROUND_CLASS, WATER_CLASS

# points of class building this far below the eaves are on a wall or on a lower annex
_BELOW_EAVES_M = 0.6
_MIN_POINTS = 20
# the search: cells, margin around points and reading, weight of a metre between an edge and its reading per metre of
# its length, shortest edge, and how many ways to lay the edges in two directions are tried; from how many metres the
# distance from the reading no longer counts, weight of a metre against the order and the signs of the sequence, and how
# many metres are allowed
_CELL_M, _MARGIN_M, _READING_WEIGHT, _MIN_EDGE_M, _NUM_STARTS = 0.2, 1.0, 0.1, 0.6, 24
_MAX_READING_M, _ORDER_WEIGHT, _TOLERANCE_M = 1.0, 5.0, 0.3
_MAX_SEARCHED_VERTICES = 16
# a point of class building below the eaves, on a wall or an annex, is a weak sign that the outline ends inside it
_LOW_WEIGHT = -0.4
# standard deviation of the smoothing before the direction of borders is measured, in cells
_SMOOTH_CELLS = 2.0
# from this far from all points a cell is not seen, and its weight then
_UNSEEN_M, _UNSEEN_WEIGHT = 0.5, -0.3
_NEGATIVE_LENGTH_WEIGHT = 30.0
# sweeps over all vertices, the first of which look at every second cell only
_NUM_SWEEPS, _NUM_COARSE_SWEEPS = 4, 2
_NUM_ROUNDS = 2
# the end of the roof at an edge: depth of the strip of points inside and outside, the ends of the edge that are not
# used, the fewest points below the roof and in all, the largest distance of the end from the outermost point on the
# roof, the turns that are tried, and how many points a degree is worth
_DEPTH_M, _WINDOW_M, _END_M, _MIN_STEP_POINTS, _MIN_EDGE_POINTS = 2.5, 1.2, 0.3, 4, 12
_GAP_M = 0.1
# ground counts from this far inside the edge, and on this share of the metres of a free edge; lines of edges whose
# directions differ by less (the sine) have no corner; and scores that differ by less are equal
_INSIDE_M, _MIN_FREE_SHARE, _MIN_SINE, _ROUNDING = 0.3, 0.5, 0.3, 1e-9
_TURNS_DEG, _TURN_WEIGHT = (0, -1, 1, -2, 2, -3, 3, -5, 5, -7, 7, -9, 9), 0.7
# the break of the roof at a party wall: from this far the reading is not used, how far from the reading breaks are
# sought, standard deviations of the reading and of a point on the roof, and how much better a break must explain these
_MAX_MISREADING_M = 2.5
_BREAK_M, _READING_SD_M, _ROOF_SD_M, _CLEAR_BREAK = 0.8, 0.3, 0.1, 20.0
# step of the search for a break, depth of the strip of points on either side, and the largest squared distance from a
# plane that a point counts with, in variances: three standard deviations, as every point of a part that is too small
# for a plane counts with
_BREAK_STEP_M, _BREAK_DEPTH_M, _MAX_SQUARE, _MIN_PLANE_POINTS = 0.1, 2.0, 9.0, 4


def fit_outline(
    reading_m: np.ndarray, eave_height_m: float, point_m: np.ndarray, classification: np.ndarray
) -> np.ndarray:
    """The outline (v, 2) nearest to what the points show, its vertices in the order of the reading.

    reading_m: (v, 2), counter-clockwise, as the network read it, not necessarily simple; its first vertex is the
    uppermost, as in a token sequence, and the signs around the mean of the points are right. eave_height_m: as the
    network read it, above the ground. point_m: (n, 3), z above the ground. classification: LAS classes (n,).

    Where points are too few, or no simple polygon comes of them, the reading is returned.
    """
    evidence_m, weight = _evidence(eave_height_m, point_m, classification)
    if (weight > 0).sum() < _MIN_POINTS or not np.isfinite(reading_m).all():
        return reading_m
    outline = None
    if len(reading_m) % 2 == 0 and len(reading_m) <= _MAX_SEARCHED_VERTICES:
        outline = _search(reading_m, evidence_m[:, :2], weight, point_m[:, :2])
    if outline is None:
        outline = reading_m
    if not shapely.Polygon(outline).is_valid:
        return reading_m
    for _ in range(_NUM_ROUNDS):
        outline = _fit_edges(outline, reading_m, evidence_m, weight)
    return outline


def _evidence(
    eave_height_m: float, point_m: np.ndarray, classification: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The points (k, 3) that are evidence, and their weights (k,): 1 on the roof, -1 on the ground, less on walls."""
    weight = np.zeros(len(point_m))
    on_building = classification == BUILDING_CLASS
    weight[np.isin(classification, (GROUND_CLASS, WATER_CLASS))] = -1.0
    is_low = point_m[:, 2] < eave_height_m - _BELOW_EAVES_M
    weight[on_building & ~is_low] = 1.0
    weight[on_building & is_low] = _LOW_WEIGHT
    counts = weight != 0
    return point_m[counts], weight[counts]


# --- search among rectilinear outlines ---


@dataclass(frozen=True)
class _Field:
    """The integral of the weights below and left of every place of a grid, in a turned frame."""

    low_m: np.ndarray
    total: np.ndarray

    def at(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """The integral up to places, interpolated linearly between the corners of cells."""
        rows, columns = self.total.shape
        column = np.clip((x_m - self.low_m[0]) / _CELL_M, 0, columns - 1.001)
        row = np.clip((y_m - self.low_m[1]) / _CELL_M, 0, rows - 1.001)
        c, r = column.astype(np.int64), row.astype(np.int64)
        fc, fr = column - c, row - r
        total = self.total
        return (total[r, c] * (1 - fc) + total[r, c + 1] * fc) * (1 - fr) + (
            total[r + 1, c] * (1 - fc) + total[r + 1, c + 1] * fc
        ) * fr


def _search(
    reading_m: np.ndarray, xy_m: np.ndarray, weight: np.ndarray, point_m: np.ndarray
) -> np.ndarray | None:
    centre = point_m.mean(axis=0)
    best_score, best = -np.inf, None
    for theta in _directions(xy_m, weight, reading_m):
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        reading, points = reading_m @ turn, xy_m @ turn
        field = _Raster.of(points, weight, np.vstack([points, reading])).integral()
        for direction in _layouts(reading):
            offset, score = _descend(direction, reading, field)
            corner = _corners(direction, offset) @ turn.T
            score -= _ORDER_WEIGHT * _disorder_m(corner, reading_m, centre)
            if score > best_score and shapely.Polygon(corner).is_valid:
                best_score, best = score, corner
    return best


def _disorder_m(corner: np.ndarray, reading_m: np.ndarray, centre_m: np.ndarray) -> float:
    """By how much vertices contradict what the sequence states: its first vertex is the uppermost, and signs."""
    above = max(float(corner[:, 1].max() - corner[0, 1]) - _TOLERANCE_M, 0.0)
    beyond = -(corner - centre_m) * np.sign(reading_m - centre_m)
    return above + float(np.maximum(beyond - _TOLERANCE_M, 0.0).sum())


def _directions(xy_m: np.ndarray, weight: np.ndarray, reading_m: np.ndarray) -> list[float]:
    """Angles, modulo a quarter turn, of the two directions: that of the borders between roof and ground, that of the
    edges of the reading."""
    field = _Raster.of(xy_m, weight, xy_m)
    dy, dx = np.gradient(gaussian_filter(field.value, _SMOOTH_CELLS))
    dy, dx = dy[field.is_seen], dx[field.is_seen]
    border = ((dx + 1j * dy) ** 4 / np.maximum(np.hypot(dx, dy), 1e-9) ** 2).sum()
    edge = (np.roll(reading_m, -1, axis=0) - reading_m) @ [1, 1j]
    read = (edge**4 / np.maximum(np.abs(edge), 1e-9) ** 3).sum()
    return [float(np.angle(value)) / 4 for value in (border, read)]


@dataclass(frozen=True)
class _Raster:
    """Cells with the weight of the nearest point, and whether one is near; low_m: their lower left corner."""

    low_m: np.ndarray
    value: np.ndarray
    is_seen: np.ndarray

    @staticmethod
    def of(points: np.ndarray, weight: np.ndarray, extent: np.ndarray) -> _Raster:
        low, high = extent.min(axis=0) - _MARGIN_M, extent.max(axis=0) + _MARGIN_M
        columns, rows = (np.ceil((high - low) / _CELL_M).astype(int) + 1).tolist()
        x, y = low[:, None] + (np.arange(max(rows, columns)) + 0.5) * _CELL_M
        cell = np.stack(np.meshgrid(x[:columns], y[:rows]), axis=-1)
        distance, nearest = cKDTree(points).query(cell)
        return _Raster(low, weight[nearest], distance < _UNSEEN_M)

    def integral(self) -> _Field:
        """Where no point is near, nothing says whether a building is there."""
        value = np.where(self.is_seen, self.value, _UNSEEN_WEIGHT)
        total = np.zeros(np.add(value.shape, 1))
        total[1:, 1:] = value.cumsum(axis=0).cumsum(axis=1) * _CELL_M**2
        return _Field(self.low_m, total)


def _layouts(reading: np.ndarray) -> np.ndarray:
    """The likeliest directions of the edges: int (k, v), quarter turns from the x axis, counter-clockwise around."""
    count = len(reading)
    num_reflex = (count - 4) // 2
    edge = np.roll(reading, -1, axis=0) - reading
    chosen = list(combinations(range(count), num_reflex))
    reflex = np.array(chosen, np.int64).reshape(len(chosen), num_reflex)
    turn = np.ones((len(reflex), count), np.int64)
    np.put_along_axis(turn, reflex, -1, axis=1)
    # turn i is at vertex i, where edge i begins
    heading = np.cumsum(turn, axis=1) - turn[:, :1]
    layouts = np.concatenate([(heading + first) % 4 for first in range(4)])
    gain = np.stack([edge[:, 0], edge[:, 1], -edge[:, 0], -edge[:, 1]], axis=1)
    score = gain[np.arange(count), layouts].sum(axis=1)
    return layouts[np.argsort(-score, kind="stable")[:_NUM_STARTS]]


def _corners(direction: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Vertices (v, 2): vertex i is where edge i - 1 meets edge i."""
    before = np.roll(offset, 1)
    horizontal = direction % 2 == 0
    return np.column_stack([np.where(horizontal, before, offset), np.where(horizontal, offset, before)])


def _descend(direction: np.ndarray, reading: np.ndarray, field: _Field) -> tuple[np.ndarray, float]:
    """The offsets (v,) of the edges: y of those along x, x of those along y; and their score.

    Each vertex in turn is moved to the best place, its two edges with it.
    """
    count = len(direction)
    horizontal = direction % 2 == 0
    middle = (reading + np.roll(reading, -1, axis=0)) / 2
    read_offset = np.where(horizontal, middle[:, 1], middle[:, 0])
    offset = read_offset.copy()
    length = np.maximum(np.linalg.norm(np.roll(reading, -1, axis=0) - reading, axis=1), 1.0)
    rows, columns = field.total.shape
    axis_x = field.low_m[0] + np.arange(1, columns - 1) * _CELL_M
    axis_y = field.low_m[1] + np.arange(1, rows - 1) * _CELL_M
    # the integral over a polygon is a sum over its vertices: plus where an edge along x begins, minus where it ends
    sign_of_start = np.where(horizontal, 1.0, -1.0)

    def prior(i: int, value: np.ndarray) -> np.ndarray:
        return -_READING_WEIGHT * length[i] * np.minimum(np.abs(value - read_offset[i]), _MAX_READING_M)

    def along(i: int, change: dict[int, np.ndarray]) -> np.ndarray:
        """The length of edge i, negative if it runs against its direction."""
        before, after = (i - 1) % count, (i + 1) % count
        start, end = change.get(before, offset[before]), change.get(after, offset[after])
        return np.asarray((end - start) * (1 if direction[i] in (0, 1) else -1))

    def area(i: int, change: dict[int, np.ndarray]) -> np.ndarray:
        """The part of vertex i in the integral."""
        before = (i - 1) % count
        here, there = change.get(i, offset[i]), change.get(before, offset[before])
        if horizontal[i]:
            return np.asarray(sign_of_start[i] * field.at(*np.broadcast_arrays(there, here)))
        return np.asarray(sign_of_start[i] * field.at(*np.broadcast_arrays(here, there)))

    def score_of(change: dict[int, np.ndarray], vertices: set[int]) -> np.ndarray:
        result: np.ndarray = np.zeros(())
        for i in vertices:
            result = result + area(i, change)
        for i in {(e + step) % count for e in change for step in (-1, 1)}:
            result = result - _NEGATIVE_LENGTH_WEIGHT * np.maximum(_MIN_EDGE_M - along(i, change), 0)
        for i, value in change.items():
            result = result + prior(i, value)
        return result

    for sweep in range(_NUM_SWEEPS):
        before_sweep = offset.copy()
        step = 2 if sweep < _NUM_COARSE_SWEEPS else 1
        for i in range(count):
            left = (i - 1) % count
            value_i = (axis_y if horizontal[i] else axis_x)[::step, None]
            value_left = (axis_y if horizontal[left] else axis_x)[None, ::step]
            score = score_of({i: value_i, left: value_left}, {i, (i + 1) % count, left})
            row, column = np.unravel_index(np.argmax(score), score.shape)
            offset[i], offset[left] = value_i[row, 0], value_left[0, column]
        if step == 1 and np.array_equal(offset, before_sweep):
            break
    whole = {i: np.asarray(offset[i]) for i in range(count)}
    return offset, float(score_of(whole, set(range(count))))


# --- the ends of the roof at each edge ---


def _fit_edges(
    outline: np.ndarray, reading_m: np.ndarray, point_m: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Each edge at the end of the roof there. If the building continues beyond it, the edge is where the network read
    it or, near there, where the roof breaks."""
    middle, normal = _lines(outline)
    along = np.column_stack([-normal[:, 1], normal[:, 0]])
    length = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)
    read_middle = (reading_m + np.roll(reading_m, -1, axis=0)) / 2
    moved, turn = np.zeros(len(outline)), np.zeros(len(outline))
    for i in range(len(outline)):
        relative = point_m[:, :2] - middle[i]
        t, d = relative @ along[i], relative @ normal[i]
        is_near = (np.abs(t) < length[i] / 2 - min(_END_M, length[i] / 6)) & (d > -_DEPTH_M) & (d < _WINDOW_M)
        t, d, w, z = t[is_near], d[is_near], weight[is_near], point_m[is_near, 2]
        if len(t) < _MIN_EDGE_POINTS:
            continue
        if _is_free(t, d, w, length[i]):
            moved[i], turn[i] = _end_of_roof(t, d, w, length[i])
        else:
            read_m = float((read_middle[i] - middle[i]) @ normal[i])
            if abs(read_m) > _MAX_MISREADING_M:
                read_m = 0.0
            moved[i] = _break_of_roof(t[w == 1], d[w == 1], z[w == 1], read_m)
    fitted = _meet(middle + moved[:, None] * normal, np.arctan2(normal[:, 1], normal[:, 0]) - turn)
    if fitted is None or not shapely.Polygon(fitted).is_valid:
        return outline
    return fitted


def _lines(outline: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles and outward normals of the edges, both (v, 2)."""
    end = np.roll(outline, -1, axis=0)
    along = (end - outline) / np.maximum(np.linalg.norm(end - outline, axis=1, keepdims=True), 1e-9)
    return (outline + end) / 2, np.column_stack([along[:, 1], -along[:, 0]])


def _meet(point: np.ndarray, normal_rad: np.ndarray) -> np.ndarray | None:
    """Vertices (v, 2) where each line meets the one before; None where two are parallel."""
    normal = np.column_stack([np.cos(normal_rad), np.sin(normal_rad)])
    offset = (point * normal).sum(axis=1)
    matrix = np.stack([np.roll(normal, 1, axis=0), normal], axis=1)
    if (np.abs(np.linalg.det(matrix)) < _MIN_SINE).any():
        return None
    right = np.stack([np.roll(offset, 1), offset], axis=1)[..., None]
    vertex: np.ndarray = np.linalg.solve(matrix, right)[..., 0]
    return vertex


def _is_free(t: np.ndarray, d: np.ndarray, weight: np.ndarray, length: float) -> bool:
    """Whether there is ground before half of the edge."""
    ground = t[(weight < 0) & (d > -_INSIDE_M)]
    num_parts = max(int(length), 2)
    part = np.floor((ground / length + 0.5) * num_parts)
    return len(ground) >= _MIN_STEP_POINTS and len(np.unique(part)) >= _MIN_FREE_SHARE * num_parts


def _end_of_roof(t: np.ndarray, d: np.ndarray, weight: np.ndarray, length: float) -> tuple[float, float]:
    """How far outwards the roof ends, and the turn of the edge, counter-clockwise in radians."""
    best = (-np.inf, 0.0, 0.0)
    for turn in np.deg2rad(_TURNS_DEG):
        distance = d - t * np.tan(turn)
        order = np.argsort(distance)
        distance, w = distance[order], weight[order]
        score = np.cumsum(w)
        candidate = np.abs(distance) < _WINDOW_M
        if not candidate.any():
            continue
        last = int(np.argmax(np.where(candidate, score, -np.inf)))
        value = score[last] - _TURN_WEIGHT * abs(np.rad2deg(turn))
        if value > best[0] + _ROUNDING:
            upper = distance[last + 1] if last + 1 < len(distance) else _WINDOW_M
            spacing = _DEPTH_M / max((w > 0).sum(), 1) + _GAP_M
            best = (value, distance[last] + min((upper - distance[last]) / 2, spacing), turn)
    return (0.0, 0.0) if best[0] == -np.inf else best[1:]


def _break_of_roof(t: np.ndarray, d: np.ndarray, z: np.ndarray, read_m: float) -> float:
    """Where two planes, before and behind, explain the points best, near where the edge was read."""
    is_near = np.abs(d - read_m) < _BREAK_DEPTH_M
    t, d, z = t[is_near], d[is_near], z[is_near]
    best, result = _break_value(t, d, z, read_m, read_m) - _CLEAR_BREAK, read_m
    for offset in read_m + np.arange(-_BREAK_M, _BREAK_M + _BREAK_STEP_M / 10, _BREAK_STEP_M):
        value = _break_value(t, d, z, read_m, offset)
        if value < best:
            best, result = value, offset
    return float(result)


def _break_value(t: np.ndarray, d: np.ndarray, z: np.ndarray, read_m: float, offset: float) -> float:
    """The negative log-likelihood of a break at ``offset``, up to a constant."""
    inside = d < offset
    misfit = _misfit(t[inside], d[inside], z[inside]) + _misfit(t[~inside], d[~inside], z[~inside])
    return misfit + ((offset - read_m) / _READING_SD_M) ** 2 / 2


def _misfit(t: np.ndarray, d: np.ndarray, z: np.ndarray) -> float:
    """The squared distances to the plane through the points, over their variance, none counted above a limit."""
    if len(z) < _MIN_PLANE_POINTS:
        return _MAX_SQUARE / 2 * len(z)
    design = np.column_stack([np.ones(len(z)), t, d])
    solution = np.linalg.lstsq(design, z, rcond=None)[0]
    return float(np.minimum(((z - design @ solution) / _ROOF_SD_M) ** 2, _MAX_SQUARE).sum() / 2)
