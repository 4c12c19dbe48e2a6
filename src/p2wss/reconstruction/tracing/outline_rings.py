"""Traced outlines of buildings, regularised to their main directions with few vertices, and fitted to the points.

A ring is a cycle of lines, each with a direction and an offset along its normal. Lines near a main direction are turned
into it. Lines with a short edge are removed, and parallel neighbours joined. Then each line moves to where it best
separates the points on roofs from the points on the ground.
"""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from p2wss.config import Outlines
from p2wss.data.tiling import Bounds
from p2wss.fit.directions import turn_between


@dataclass(frozen=True)
class Rules:
    """How traces become outlines; ``benchmarks/outlines.py`` shows what each rule brings.

    tolerance_cells: of Douglas-Peucker on a trace; the staircase of a raster is within 0.71 cells of its line.
    snap_deg: edges at most this far from a main direction are turned into it. near_deg: edges this near have one
    direction. min_share: a second main direction needs this share of the sum of the cubed lengths of edges.
    rectangle_share: a trace that fills this share of the smallest rectangle around its points has the directions of the
    rectangle. min_trace_vertices, max_turn_deg: an edge with at least so many vertices of the trace gets the direction
    of the line fitted to them, unless this turns it by more. oblique_share: an edge in no main direction counts with
    this share of its length, as a raster cuts corners off by such edges. cut_cells: edges at most this far from a side
    of the bounds of the cloud are where the cloud ends, not a wall. parallel_deg: lines whose directions differ by less
    are parallel. spike_deg: no short edge is removed if that left a sharper corner. reach_cells: seams reach this far
    beyond the ends of their traces, so that they meet the outline. grid_m: of all coordinates. least_length_m: an edge
    counts with at least this length. max_move_m, min_points: an edge moves by at most this, and only with this many
    points on roofs near it. least_density: density of points on the roof in front of an edge that lets it move out, as
    a share of the density on roofs. max_difference: of an outline from its trace, as a share of the area of the trace.
    """

    tolerance_cells: float = 0.7
    snap_deg: float = 22.0
    near_deg: float = 8.0
    min_share: float = 0.02
    rectangle_share: float = 0.8
    min_trace_vertices: int = 8
    max_turn_deg: float = 10.0
    oblique_share: float = 0.4
    cut_cells: float = 1.5
    parallel_deg: float = 3.0
    spike_deg: float = 60.0
    reach_cells: int = 3
    grid_m: float = 1e-3
    least_length_m: float = 0.01
    max_move_m: float = 0.8
    min_points: int = 4
    least_density: float = 0.5
    max_difference: float = 0.3


RULES = Rules()


@dataclass(frozen=True)
class EdgePoints:
    """Points around a block. roof_m, ground_m: x and y, (n, 2). density: points on roofs per square metre. bounds: of
    the cloud; an edge of a trace along them is no wall."""

    roof_m: np.ndarray
    ground_m: np.ndarray
    density: float
    bounds: Bounds


@dataclass
class _Line:
    """normal . xy = offset, with the inside of a ring to the left of the direction (for exteriors)."""

    angle: float
    offset: float
    length: float
    is_main: bool

    @property
    def direction(self) -> np.ndarray:
        return np.array([np.cos(self.angle), np.sin(self.angle)])

    @property
    def normal(self) -> np.ndarray:
        """To the right of the direction."""
        return np.array([np.sin(self.angle), -np.cos(self.angle)])


def directions(trace: shapely.Polygon, points: EdgePoints, cell_m: float) -> list[float]:
    """The one or two main directions of a trace, in degrees; each stands for itself and its perpendicular.

    If the trace fills the smallest rectangle around its points on the roof, it is the direction of the rectangle. Else
    they are weighted means of the directions of the trace's edges. Where the border of the cloud cuts the building, the
    sides of the convex hull of the points count, too, but edges and sides along the border do not, nor sides across a
    corner without a wall. Long edges have more weight: their directions are more accurate, and short edges of a trace
    follow the raster. Points do not follow the raster.
    """
    rings = [(_simple(ring, cell_m), np.asarray(ring.coords)) for ring in _rings(trace)]
    lines = [line for xy_m, traced_m in rings for line in _lines(xy_m, traced_m, [])]
    angle_deg = np.degrees([line.angle for line in lines])
    length_m = np.array([line.length for line in lines])
    is_wall = ~np.concatenate([_is_cut(xy_m, points.bounds, cell_m) for xy_m, _ in rings])
    own_m = shapely.MultiPoint(points.roof_m[shapely.contains_xy(trace.buffer(cell_m), *points.roof_m.T)])
    if is_wall.all():
        around = shapely.minimum_rotated_rectangle(own_m)
        if trace.area >= RULES.rectangle_share * around.area > 0:
            east_m, north_m = np.diff(shapely.get_coordinates(around)[:2], axis=0)[0]
            return [math.degrees(math.atan2(north_m, east_m))]
    else:
        corner_m = shapely.get_coordinates(own_m.convex_hull)
        side_m, middle_m = np.diff(corner_m, axis=0), (corner_m[:-1] + corner_m[1:]) / 2
        is_near = shapely.distance(shapely.points(middle_m), trace.boundary) <= RULES.cut_cells * cell_m
        angle_deg = np.append(angle_deg, np.degrees(np.arctan2(side_m[:, 1], side_m[:, 0])))
        length_m = np.append(length_m, np.hypot(*side_m.T))
        is_wall = np.append(is_wall, is_near & ~_is_cut(corner_m, points.bounds, cell_m))
    weight = np.where(is_wall | ~is_wall.any(), length_m**3, 0.0)
    turn_deg = turn_between(angle_deg, angle_deg[:, None], 90.0)
    is_near, least = np.abs(turn_deg) <= RULES.near_deg, RULES.min_share * weight.sum()
    result: list[float] = []
    while len(result) < 2 and weight.max() > 0:
        total = is_near @ weight
        best = int(np.argmax(total))
        if result and total[best] < least:
            break
        result.append(float(angle_deg[best] + turn_deg[best] @ (is_near[best] * weight) / total[best]))
        weight = np.where(np.abs(turn_deg[best]) <= RULES.snap_deg, 0.0, weight)
    return result


def regularised(
    trace: shapely.Polygon, main_deg: list[float], points: EdgePoints, settings: Outlines, cell_m: float
) -> shapely.Polygon:
    """The outline with few vertices in the main directions, fitted to the points, valid, on a grid of millimetres.

    If a fitted ring is not valid, or differs too much from the trace, the regularised trace takes its place, or if that
    fails, too, the simplified trace. Courtyards that do not lie inside are left out.
    """
    rings: list[shapely.Polygon] = []
    for ring in _rings(trace):
        xy_m = _simple(ring, cell_m)
        lines = _lines(xy_m, np.asarray(ring.coords), main_deg, _is_cut(xy_m, points.bounds, cell_m))
        _reduce(lines, settings.min_edge_m)
        best = _polygon(lines, ring) or shapely.Polygon(xy_m)
        lines = _fitted(lines, points, bool(rings), settings.overhang_m)
        if not rings:
            _fill_corners(lines, points)
        _reduce(lines, settings.min_edge_m)
        rings.append(_polygon(lines, ring) or best)
    result: BaseGeometry = rings[0]
    for hole in rings[1:]:
        if result.buffer(-settings.min_edge_m / 2).contains(hole):
            result = result.difference(hole)
    parts = shapely.get_parts(shapely.set_precision(result, RULES.grid_m))
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
    # twice the tolerance of an outline, as a jump in height is not as sharp as an edge
    xy_m = np.asarray(shapely.simplify(line, 2 * RULES.tolerance_cells * cell_m).coords)
    lines = _lines(xy_m, np.asarray(line.coords), main_deg)
    reach_m = RULES.reach_cells * cell_m
    first, last = lines[0], lines[-1]
    start, end = _foot(first, xy_m[0]), _foot(last, xy_m[-1])
    corners = [_corner(a, b) for a, b in itertools.pairwise(lines)]
    inner = [corner for corner in corners if corner is not None]
    seam = shapely.LineString([start - reach_m * first.direction, *inner, end + reach_m * last.direction])
    # a seam much longer than its trace has a far corner, of nearly parallel lines
    return seam if seam.length <= 2 * line.length + 2 * reach_m else shapely.LineString(xy_m)


def _rings(polygon: shapely.Polygon) -> list[shapely.LinearRing]:
    """The exterior and the courtyards of a polygon, all counter-clockwise."""
    return [
        shapely.geometry.polygon.orient(shapely.Polygon(ring)).exterior for ring in shapely.get_rings(polygon)
    ]


def _simple(ring: shapely.LinearRing, cell_m: float) -> np.ndarray:
    """The ring simplified by Douglas-Peucker: closed, (n + 1, 2), beginning at the vertex farthest from the centre."""
    xy_m = np.asarray(ring.coords)[:-1]
    start = int(np.argmax(np.hypot(*(xy_m - xy_m.mean(axis=0)).T)))
    closed = np.vstack([xy_m[start:], xy_m[: start + 1]])
    result = np.asarray(shapely.simplify(shapely.LineString(closed), RULES.tolerance_cells * cell_m).coords)
    return result if len(result) > 3 else closed


def _is_cut(simple_m: np.ndarray, bounds: Bounds, cell_m: float) -> np.ndarray:
    """bool (n,): whether each edge of a simplified trace (n + 1, 2) is along the border of the cloud."""
    beside = np.abs(np.tile(simple_m, 2) - bounds) <= RULES.cut_cells * cell_m
    return np.asarray((beside[:-1] & beside[1:]).any(axis=1))


def _lines(
    simple_m: np.ndarray, traced_m: np.ndarray, main_deg: list[float], is_cut: np.ndarray | None = None
) -> list[_Line]:
    """One line per edge of the simplified trace, through the middle of its staircase, turned into a main direction if
    one is near. is_cut: edges along the border of the cloud, which are turned into the direction of an axis."""
    sides_m = (traced_m[:-1] + traced_m[1:]) / 2
    weight = np.hypot(*np.diff(traced_m, axis=0).T)
    vertex = _indices(simple_m, traced_m)
    result = []
    for index, (start, end) in enumerate(itertools.pairwise(simple_m)):
        vector = end - start
        length = float(np.hypot(*vector))
        angle = math.atan2(vector[1], vector[0])
        first, last = vertex[index], vertex[index + 1]
        members = (
            np.arange(first, last)
            if last > first
            else np.concatenate([np.arange(first, len(sides_m)), np.arange(last)])
        )
        angle = _angle_of_points(sides_m[members], weight[members], angle)
        among_deg = [0.0] if is_cut is not None and is_cut[index] else main_deg
        turns = (float(turn_between(np.degrees(angle), main, 90.0)) for main in among_deg)
        turn = min(turns, key=abs, default=90.0)
        is_main = bool(abs(turn) <= RULES.snap_deg)
        if is_main:
            angle -= float(np.radians(turn))
        line = _Line(angle, 0.0, length, is_main)
        offset = sides_m[members] @ line.normal
        line.offset = float(np.average(offset, weights=weight[members]))
        result.append(line)
    return result


def _angle_of_points(xy_m: np.ndarray, weight: np.ndarray, angle: float) -> float:
    """The angle of the line fitted to points, in the sense of ``angle``; ``angle`` itself if there are few points, or
    if the line is turned too far."""
    if len(xy_m) < RULES.min_trace_vertices:
        return angle
    local = xy_m - np.average(xy_m, axis=0, weights=weight)
    xx, yy, xy = (local[:, [0, 1, 0]] * local[:, [0, 1, 1]]).T @ weight
    axis = 0.5 * math.atan2(2 * xy, xx - yy)
    turn = (axis - angle + np.pi / 2) % np.pi - np.pi / 2
    return float(angle + turn) if abs(turn) < np.radians(RULES.max_turn_deg) else angle


def _indices(simple_m: np.ndarray, traced_m: np.ndarray) -> np.ndarray:
    """int (n + 1,): the index of each vertex of the simplified trace in the trace."""
    position = {tuple(xy): number for number, xy in reversed(list(enumerate(traced_m.tolist())))}
    result = np.array([position[tuple(xy)] for xy in simple_m.tolist()])
    if result[-1] == 0:
        result[-1] = len(traced_m) - 1
    return result


def _reduce(lines: list[_Line], min_edge_m: float) -> None:
    """Join parallel neighbours and remove short edges, in place, until there are none. The short end of a tapering
    building stays. Oblique edges, by which a raster cuts corners off, count as shorter than they are."""
    while True:
        while len(lines) > 3 and any(_join_parallel(lines, index) for index in range(len(lines))):
            pass
        length_m = _lengths(lines)
        counted_m = np.where([line.is_main for line in lines], length_m, RULES.oblique_share * length_m)
        counted_m[(length_m > 0) & _is_cap(lines)] = np.inf
        shortest = int(np.argmin(counted_m))
        if len(lines) <= 4 or counted_m[shortest] >= min_edge_m:
            break
        for line, length in zip(lines, length_m.tolist(), strict=True):
            line.length = max(length, RULES.least_length_m)
        lines.pop(shortest)


def _fill_corners(lines: list[_Line], points: EdgePoints) -> None:
    """Remove oblique edges of an exterior, in place, if the corner that the neighbour edges form beyond is full of
    points on the roof. A raster cuts off such corners of buildings that stand oblique to it."""
    for index in reversed(range(len(lines))):
        line, before, after = lines[index], lines[index - 1], lines[(index + 1) % len(lines)]
        ends = [_corner(before, line), _corner(line, after), _corner(before, after)]
        if line.is_main or len(lines) <= 3 or any(end is None for end in ends):
            continue
        start, end, tip = np.array(ends, float)
        if (end - start) @ line.direction > 0 and tip @ line.normal > line.offset:
            beyond = shapely.Polygon([start, tip, end])
            num_roof, num_ground = (
                int(shapely.contains_xy(beyond, *xy_m.T).sum()) for xy_m in (points.roof_m, points.ground_m)
            )
            if num_roof > max(num_ground, RULES.least_density * points.density * beyond.area):
                lines.pop(index)


def _is_cap(lines: list[_Line]) -> np.ndarray:
    """bool (n,): whether the neighbours of each edge would meet in a spike without it."""
    direction = np.array([line.direction for line in lines])
    cosine = (np.roll(direction, 1, axis=0) * np.roll(direction, -1, axis=0)).sum(axis=1)
    opposite, least = np.cos(np.radians([RULES.parallel_deg, RULES.spike_deg]))
    return np.asarray((cosine > -opposite) & (cosine < -least))


def _join_parallel(lines: list[_Line], index: int) -> bool:
    """Join a line with the next one, in place, if they are parallel: into their mean, or into the longer one if their
    directions are opposite. Returns whether they were joined."""
    line, following = lines[index], lines[(index + 1) % len(lines)]
    turn = following.angle - line.angle
    if abs(np.sin(turn)) > np.sin(np.radians(RULES.parallel_deg)):
        return False
    merged = line if line.length >= following.length else following
    if np.cos(turn) > 0:
        total = line.length + following.length
        offset = (line.offset * line.length + following.offset * following.length) / total
        merged = replace(merged, offset=offset, length=total)
    lines[index] = merged
    lines.pop((index + 1) % len(lines))
    return True


def _corner(first: _Line, second: _Line) -> np.ndarray | None:
    """Where two lines intersect; None if they are parallel."""
    matrix = np.array([first.normal, second.normal])
    if abs(np.linalg.det(matrix)) < np.sin(np.radians(RULES.parallel_deg)):
        return None
    return np.linalg.solve(matrix, [first.offset, second.offset])


def _foot(line: _Line, xy_m: np.ndarray) -> np.ndarray:
    """The point on the line that is nearest to a point (2,)."""
    return xy_m + (line.offset - xy_m @ line.normal) * line.normal


def _corners(lines: list[_Line]) -> np.ndarray:
    """Start of each edge, (n, 2); NaN between parallel lines."""
    corners = [_corner(lines[index - 1], line) for index, line in enumerate(lines)]
    return np.array([np.full(2, np.nan) if corner is None else corner for corner in corners])


def _lengths(lines: list[_Line]) -> np.ndarray:
    """Length of each edge, negative where its corners have changed order; NaN beside parallel lines."""
    corner = _corners(lines)
    vector = np.roll(corner, -1, axis=0) - corner
    return np.array([step @ line.direction for step, line in zip(vector, lines, strict=True)])


def _polygon(lines: list[_Line], trace: shapely.LinearRing) -> shapely.Polygon | None:
    """The polygon between lines, None if it is not valid or not like the trace."""
    corner = _corners(lines)
    if len(lines) < 3 or not np.isfinite(corner).all():
        return None
    shape = shapely.Polygon(corner)
    traced = shapely.Polygon(trace)
    is_like = shape.is_valid and shape.symmetric_difference(traced).area <= RULES.max_difference * traced.area
    return shape if is_like else None


def _fitted(lines: list[_Line], points: EdgePoints, is_hole: bool, overhang_m: float) -> list[_Line]:
    """The lines, each moved along its normal to where it best separates points on roofs from points on the ground, and
    from there inwards by the overhang of the roof."""
    corner = _corners(lines)
    if not np.isfinite(corner).all():
        return lines
    result = []
    sign = -1.0 if is_hole else 1.0
    for index, line in enumerate(lines):
        start_m, end_m = np.sort(corner[[index, (index + 1) % len(lines)]] @ line.direction)
        roof_m, ground_m = (
            _across(xy_m, line, start_m, end_m) * sign for xy_m in (points.roof_m, points.ground_m)
        )
        move_m = _separation(roof_m, ground_m, points.density * (end_m - start_m)) - overhang_m
        result.append(replace(line, offset=line.offset + sign * move_m))
    return result


def _across(xy_m: np.ndarray, line: _Line, start_m: float, end_m: float) -> np.ndarray:
    """The distances from a line, along its normal, of the points beside its edge that are in reach."""
    along, across_m = xy_m @ line.direction, xy_m @ line.normal - line.offset
    return across_m[(along > start_m) & (along < end_m) & (np.abs(across_m) < RULES.max_move_m)]


def _separation(roof: np.ndarray, ground: np.ndarray, per_metre: float) -> float:
    """The offset with the fewest points on roofs beyond it and points on the ground before it; 0 if there are few
    points on roofs.

    An edge moves out only over a strip that is at least half as dense as a roof, which single points on hedges and
    walls are not. roof, ground: offsets of the points. per_metre: number of points on a roof in a strip along the edge
    that is a metre deep.
    """
    if len(roof) < RULES.min_points:
        return 0.0
    candidates = np.sort(roof)
    wrong = len(roof) - 1 - np.arange(len(roof)) + np.searchsorted(np.sort(ground), candidates)
    return float(candidates[np.argmin(wrong + RULES.least_density * per_metre * candidates)])
