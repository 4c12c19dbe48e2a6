"""Traced outlines of buildings, regularised to their main directions with few vertices, and fitted to the points.

A ring is a cycle of lines, each with a direction and an offset along its normal. Lines of nearly one direction get it
exactly; lines whose edge would be short go; parallel neighbours join, or get a step between them. Then each line moves
to where it best separates the points on roofs from those on the ground.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from p2wss.config import Outlines

# Douglas-Peucker on the trace, in cells: the staircase of a raster is within 0.71 of its line
_TOLERANCE_CELLS = 0.7
# edges that count for the direction of others
_LONG_CELLS = 8
# edges at most this far from a main direction get it
_SNAP_DEG = 22.0
# if their ends stay within this of where they were
_SNAP_M = 0.6
# width of the kernel for the peaks of directions, up to how many widths from a peak its directions are averaged, and
# the least share of the length of a second peak
_KERNEL_DEG, _NUM_WIDTHS, _MIN_SHARE, _MAX_DIRECTIONS = 4.0, 2.5, 0.12, 3
# bins of the histogram of directions
_BIN_DEG = 0.5
# fewest vertices of the trace along an edge whose line has a direction of its own, and how far that may be from the
# direction of the edge
_MIN_TRACE_VERTICES, _MAX_TURN_DEG = 8, 10
# lines whose directions differ by less are parallel
_PARALLEL_DEG = 3
# seams reach this many cells beyond the ends of their traces, so that they meet the outline
_REACH_CELLS = 3
# the grid of all coordinates, and the least length that an edge counts with
_GRID_M, _LEAST_LENGTH_M = 1e-3, 0.01
# an edge in no main direction, at most this long, goes if the tip of its neighbours has at most this area
_OBLIQUE_M, _TIP_M2 = 3.0, 1.5
# a fitted line moves by at most this
_MAX_MOVE_M = 0.8
# ends of an edge whose points do not count
_END_M = 0.4
_MIN_POINTS = 4
# before an edge, as a share of the density of roofs, and the least length of an edge that the density is counted over
_LEAST_DENSITY, _LEAST_COUNTED_M = 0.5, 0.5
# an edge is at most this far behind the last point on the roof
_MAX_GAP_M = 0.3
# a regularised outline differs from its trace by at most this share of the area, and by the overhang that is taken off
_MAX_DIFFERENCE = 0.2


@dataclass(frozen=True)
class EdgePoints:
    """Points around a block. roof, ground: x and y, (n, 2). density: points on roofs per square metre."""

    roof_m: np.ndarray
    ground_m: np.ndarray
    density: float


@dataclass
class _Line:
    """normal . xy = offset, with the inside of a ring to the left of the direction (for exteriors)."""

    angle: float
    offset: float
    length: float
    is_main: bool = True

    @property
    def direction(self) -> np.ndarray:
        return np.array([np.cos(self.angle), np.sin(self.angle)])

    @property
    def normal(self) -> np.ndarray:
        """To the right of the direction."""
        return np.array([np.sin(self.angle), -np.cos(self.angle)])


def directions(smooth: np.ndarray) -> list[float]:
    """Main directions of the edges in a smooth raster, in degrees from 0 to 90, that of most length first.

    A direction stands for itself and its perpendicular. The gradient of a smooth raster is perpendicular to its edges;
    the steps of the cells are not among them.
    """
    along_y, along_x = np.gradient(smooth)
    weight = np.hypot(along_x, along_y) ** 2
    angle_deg = np.degrees(np.arctan2(along_y, along_x)) % 90
    candidates = np.arange(0, 90, _BIN_DEG)
    middles = candidates + _BIN_DEG / 2
    bins = (angle_deg / _BIN_DEG).astype(int).ravel() % len(candidates)
    histogram = np.bincount(bins, weight.ravel(), len(candidates))
    result: list[float] = []
    total = histogram.sum()
    while len(result) < _MAX_DIRECTIONS:
        away = _apart_deg(middles[:, None], middles[None])
        score = np.exp(-0.5 * (away / _KERNEL_DEG) ** 2) @ histogram
        peak = int(np.argmax(score))
        near = away[peak] <= _NUM_WIDTHS * _KERNEL_DEG
        if histogram[near].sum() < (_MIN_SHARE if result else 0) * total or not total:
            break
        turn = (candidates[near] - candidates[peak] + 45) % 90 - 45
        result.append(float((middles[peak] + np.average(turn, weights=histogram[near])) % 90))
        histogram = np.where(away[peak] <= _SNAP_DEG, 0, histogram)
    return result


def mean_directions(trace: shapely.Polygon, main_deg: list[float], cell_m: float) -> list[float]:
    """The main directions, each as the mean of the lines through its long traced edges."""
    turns: list[list[tuple[float, float]]] = [[] for _ in main_deg]
    for ring in _rings(trace):
        traced_m = np.asarray(ring.coords)
        for line in _lines(_simple(ring, cell_m), traced_m, []):
            apart = [_apart_deg(np.degrees(line.angle), main) for main in main_deg]
            if line.length >= _LONG_CELLS * cell_m and apart and min(apart) <= 2 * _KERNEL_DEG:
                main = int(np.argmin(apart))
                turn = (np.degrees(line.angle) - main_deg[main] + 45) % 90 - 45
                turns[main].append((float(turn), line.length**3))
    return [
        main + float(np.average([t for t, _ in turn], weights=[w for _, w in turn])) if turn else main
        for main, turn in zip(main_deg, turns, strict=True)
    ]


def regularised(
    trace: shapely.Polygon, main_deg: list[float], points: EdgePoints, settings: Outlines, cell_m: float
) -> shapely.Polygon:
    """The outline with few vertices in the main directions, fitted to the points, valid, on a grid of millimetres.

    A ring for which that fails or differs too much from the trace is the simplified trace instead.
    """
    rings: list[shapely.Polygon] = []
    for ring in _rings(trace):
        xy_m = _simple(ring, cell_m)
        rough = shapely.Polygon(xy_m)
        best = rough
        lines = _lines(xy_m, np.asarray(ring.coords), main_deg)
        for fits in (False, True):
            _reduce(lines, settings)
            _sharpen(lines)
            if fits:
                lines = _fitted(lines, points, bool(rings), settings.overhang_m)
                _reduce(lines, settings)
                _sharpen(lines)
            shape = _polygon(lines)
            reference = shapely.Polygon(ring)
            most_m2 = _MAX_DIFFERENCE * reference.area + fits * settings.overhang_m * reference.length
            if shape is None or shape.symmetric_difference(reference).area > most_m2:
                break
            best = shape
        rings.append(best)
    result: BaseGeometry = rings[0]
    for hole in rings[1:]:
        if result.buffer(-settings.min_edge_m / 2).contains(hole):
            result = result.difference(hole)
    parts = shapely.get_parts(shapely.set_precision(result, _GRID_M))
    largest: shapely.Polygon = parts[np.argmax(shapely.area(parts))]
    return largest


def seam_lines(
    parts: list[shapely.Polygon],
    outline: shapely.Polygon,
    main_deg: list[float],
    settings: Outlines,
    cell_m: float,
) -> list[shapely.LineString]:
    """The walls between the traced parts of a block, straight and in the main directions, somewhat too long."""
    result = []
    shapes = np.array(parts, dtype=object)
    first, second = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        if a >= b:
            continue
        common = shapely.intersection(parts[a].boundary, parts[b].boundary)
        lines = [line for line in shapely.get_parts(common) if line.geom_type == "LineString"]
        if not lines:
            continue
        merged = shapely.line_merge(shapely.union_all(lines))
        for line in shapely.get_parts(merged):
            seam = _seam(line, main_deg, settings, cell_m)
            if seam is not None and seam.intersects(outline):
                result.append(seam)
    return result


def _seam(
    line: shapely.LineString, main_deg: list[float], settings: Outlines, cell_m: float
) -> shapely.LineString | None:
    if line.length < settings.min_edge_m or line.is_ring:
        return line if line.is_ring else None
    # twice the tolerance of an outline: a jump in height is not as sharp as an edge
    xy_m = np.asarray(shapely.simplify(line, 2 * _TOLERANCE_CELLS * cell_m).coords)
    lines = _lines(xy_m, np.asarray(line.coords), main_deg)
    chain = [lines[0]]
    for following in lines[1:]:
        if np.isclose(np.sin(following.angle - chain[-1].angle), 0, atol=1e-6):
            total = chain[-1].length + following.length
            sign = np.sign(np.cos(following.angle - chain[-1].angle))
            chain[-1].offset = (
                chain[-1].offset * chain[-1].length + sign * following.offset * following.length
            ) / total
            chain[-1].length = total
        else:
            chain.append(following)
    reach_m = _REACH_CELLS * cell_m
    start, end = _foot(chain[0], xy_m[0]), _foot(chain[-1], xy_m[-1])
    corners = [_corner(a, b) for a, b in itertools.pairwise(chain)]
    inner = [corner for corner in corners if corner is not None]
    result = [
        start - reach_m * chain[0].direction,
        *inner,
        end + reach_m * chain[-1].direction,
    ]
    seam = shapely.LineString(result)
    # a corner far away means nearly parallel lines
    return seam if seam.length <= 2 * line.length + 2 * reach_m else shapely.LineString(xy_m)


def _rings(polygon: shapely.Polygon) -> list[shapely.LinearRing]:
    """Exterior and courtyards, all counter-clockwise."""
    return [
        shapely.geometry.polygon.orient(shapely.Polygon(ring)).exterior for ring in shapely.get_rings(polygon)
    ]


def _simple(ring: shapely.LinearRing, cell_m: float) -> np.ndarray:
    """Douglas-Peucker on a ring, closed (n + 1, 2), from the vertex that is farthest from the centre."""
    xy_m = np.asarray(ring.coords)[:-1]
    start = int(np.argmax(np.hypot(*(xy_m - xy_m.mean(axis=0)).T)))
    closed = np.vstack([xy_m[start:], xy_m[: start + 1]])
    result = np.asarray(shapely.simplify(shapely.LineString(closed), _TOLERANCE_CELLS * cell_m).coords)
    return result if len(result) > 3 else closed


def _lines(simple_m: np.ndarray, traced_m: np.ndarray, main_deg: list[float]) -> list[_Line]:
    """One line per edge of the simplified trace, through the middle of its staircase, in a main direction if near."""
    sides_m = (traced_m[:-1] + traced_m[1:]) / 2
    weight = np.hypot(*np.diff(traced_m, axis=0).T)
    vertex = _indices(simple_m, traced_m)
    result = []
    for index, (start, end) in enumerate(itertools.pairwise(simple_m)):
        vector = end - start
        length = float(np.hypot(*vector))
        angle = float(np.arctan2(vector[1], vector[0]))
        first, last = vertex[index], vertex[index + 1]
        members = (
            np.arange(first, last)
            if last > first
            else np.concatenate([np.arange(first, len(sides_m)), np.arange(last)])
        )
        angle = _angle_of_points(sides_m[members], weight[members], angle)
        # the direction of a long edge is accurate; a short one gets that of the building
        most_deg = min(_SNAP_DEG, float(np.degrees(np.arctan2(2 * _SNAP_M, length))))
        turn = min(((np.degrees(angle) - main + 45) % 90 - 45 for main in main_deg), key=abs, default=90.0)
        is_main = abs(turn) <= most_deg
        if is_main:
            angle -= float(np.radians(turn))
        line = _Line(angle, 0.0, length, bool(is_main))
        offset = sides_m[members] @ line.normal
        line.offset = float(np.average(offset, weights=weight[members]))
        result.append(line)
    return result


def _angle_of_points(xy_m: np.ndarray, weight: np.ndarray, angle: float) -> float:
    """The direction of the line through points, on the side of ``angle``; ``angle`` for few points."""
    if len(xy_m) < _MIN_TRACE_VERTICES:
        return angle
    local = xy_m - np.average(xy_m, axis=0, weights=weight)
    xx, yy, xy = (local[:, [0, 1, 0]] * local[:, [0, 1, 1]]).T @ weight
    axis = 0.5 * np.arctan2(2 * xy, xx - yy)
    turn = (axis - angle + np.pi / 2) % np.pi - np.pi / 2
    return float(angle + turn) if abs(turn) < np.radians(_MAX_TURN_DEG) else angle


def _indices(simple_m: np.ndarray, traced_m: np.ndarray) -> np.ndarray:
    """The number of each vertex of the simplified trace within the trace."""
    position = {tuple(xy): number for number, xy in reversed(list(enumerate(traced_m.tolist())))}
    result = np.array([position[tuple(xy)] for xy in simple_m.tolist()])
    if result[-1] == 0:
        result[-1] = len(traced_m) - 1
    return result


def _reduce(lines: list[_Line], settings: Outlines) -> None:
    """Join parallel neighbours and remove short edges, until there are none."""
    # steps are put in once only: an edge that goes later was no longer than the step between its neighbours
    min_step_m = settings.min_edge_m
    index = 0
    while index < len(lines) and len(lines) > 3:
        if not _join_parallel(lines, index, min_step_m):
            index += 1
    while len(lines) > 4:
        length_m = _lengths(lines)
        shortest = int(np.argmin(length_m))
        if length_m[shortest] >= settings.min_edge_m:
            break
        for line, length in zip(lines, length_m.tolist(), strict=True):
            if np.isfinite(length):
                line.length = max(length, _LEAST_LENGTH_M)
        lines.pop(shortest)
        while len(lines) > 3 and any(_join_parallel(lines, i, np.inf) for i in range(len(lines))):
            pass


def _sharpen(lines: list[_Line]) -> None:
    """Remove short oblique edges, with which a raster cuts corners off."""
    while len(lines) > 4:
        corner, length_m = _corners(lines), _lengths(lines)
        removable = []
        for index, line in enumerate(lines):
            tip = _corner(lines[index - 1], lines[(index + 1) % len(lines)])
            if line.is_main or length_m[index] > _OBLIQUE_M or tip is None:
                continue
            (ax, ay), (bx, by) = corner[index] - tip, corner[(index + 1) % len(lines)] - tip
            if abs(ax * by - ay * bx) / 2 <= _TIP_M2:
                removable.append((length_m[index], index))
        if not removable:
            break
        lines.pop(min(removable)[1])


def _join_parallel(lines: list[_Line], index: int, min_step_m: float) -> bool:
    """Join a line with the next if they are parallel, or put a step of at least ``min_step_m`` between them."""
    line, following = lines[index], lines[(index + 1) % len(lines)]
    turn = following.angle - line.angle
    if abs(np.sin(turn)) > np.sin(np.radians(_PARALLEL_DEG)):
        return False
    is_opposite = bool(np.cos(turn) < 0)
    total = line.length + following.length
    longer = line if line.length >= following.length else following
    step_m = following.offset - line.offset
    if is_opposite:
        merged = longer
    elif abs(step_m) < min_step_m:
        offset = (line.offset * line.length + following.offset * following.length) / total
        merged = _Line(longer.angle, offset, total, longer.is_main)
    else:
        # the step is perpendicular, through the end of the first
        start = _corner(lines[index - 1], line)
        end = (line.offset * line.normal if start is None else start) + line.length * line.direction
        step = _Line(float(line.angle - np.sign(step_m) * np.pi / 2), 0.0, abs(step_m))
        step.offset = float(end @ step.normal)
        lines.insert(index + 1, step)
        return True
    lines[index] = merged
    lines.pop((index + 1) % len(lines))
    return True


def _corner(first: _Line, second: _Line) -> np.ndarray | None:
    """Where two lines intersect; None if they are parallel."""
    matrix = np.array([first.normal, second.normal])
    if abs(np.linalg.det(matrix)) < np.sin(np.radians(_PARALLEL_DEG)):
        return None
    return np.linalg.solve(matrix, [first.offset, second.offset])


def _foot(line: _Line, xy_m: np.ndarray) -> np.ndarray:
    """The nearest point on the line."""
    return xy_m + (line.offset - xy_m @ line.normal) * line.normal


def _corners(lines: list[_Line]) -> np.ndarray:
    """Start of each edge, (n, 2); NaN between parallel lines."""
    corners = [_corner(lines[index - 1], line) for index, line in enumerate(lines)]
    return np.array([np.full(2, np.nan) if corner is None else corner for corner in corners])


def _lengths(lines: list[_Line]) -> np.ndarray:
    """Length of each edge, negative where its corners have changed order."""
    corner = _corners(lines)
    vector = np.roll(corner, -1, axis=0) - corner
    length_m = np.array([step @ line.direction for step, line in zip(vector, lines, strict=True)])
    return np.where(np.isnan(length_m), np.inf, length_m)


def _polygon(lines: list[_Line]) -> shapely.Polygon | None:
    corner = _corners(lines)
    if len(lines) < 3 or not np.isfinite(corner).all():
        return None
    shape = shapely.Polygon(corner)
    return shape if shape.is_valid and shape.area > 0 else None


def _fitted(lines: list[_Line], points: EdgePoints, is_hole: bool, overhang_m: float) -> list[_Line]:
    """The lines, each moved along its normal to where it best separates the two kinds of points, and from there inwards
    by the overhang of the roof."""
    corner = _corners(lines)
    if not np.isfinite(corner).all():
        return lines
    result = []
    sign = -1.0 if is_hole else 1.0
    for index, line in enumerate(lines):
        start = corner[index] @ line.direction
        end = corner[(index + 1) % len(lines)] @ line.direction
        roof_m, ground_m = (
            _across(xy_m, line, start + _END_M, end - _END_M) * sign
            for xy_m in (points.roof_m, points.ground_m)
        )
        move_m = sign * _separation(roof_m, ground_m, points.density, end - start - 2 * _END_M)
        offset = line.offset + move_m - sign * overhang_m
        result.append(_Line(line.angle, offset, line.length, line.is_main))
    return result


def _across(xy_m: np.ndarray, line: _Line, start_m: float, end_m: float) -> np.ndarray:
    """Distances along the normal of the points in reach of an edge."""
    along, across_m = xy_m @ line.direction, xy_m @ line.normal - line.offset
    return across_m[(along > start_m) & (along < end_m) & (np.abs(across_m) < _MAX_MOVE_M)]


def _separation(roof: np.ndarray, ground: np.ndarray, density: float, length_m: float) -> float:
    """The offset with the fewest roof points beyond and ground points before it, 0 without evidence.

    The strip before the edge must also be as dense as half a roof, which single points on hedges and walls are not.
    """
    if len(roof) < _MIN_POINTS:
        return 0.0
    candidates = np.sort(roof)
    wrong = len(roof) - 1 - np.arange(len(roof)) + np.searchsorted(np.sort(ground), candidates)
    per_metre = max(density * max(length_m, _LEAST_COUNTED_M), 1e-9)
    best = int(np.argmin(wrong + _LEAST_DENSITY * per_metre * candidates))
    # the edge is half as far behind the last point as points are apart along it
    return float(np.clip(candidates[best] + min(0.5 / per_metre, _MAX_GAP_M), -_MAX_MOVE_M, _MAX_MOVE_M))


def _apart_deg(first: np.ndarray | float, second: np.ndarray | float) -> np.ndarray:
    """Angle between directions, where a right angle is none."""
    return np.abs((np.asarray(first) - second + 45) % 90 - 45)
