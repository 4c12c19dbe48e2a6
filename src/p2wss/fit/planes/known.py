"""Planes and lines of a known roof, or between lines of a map: candidates where points are few."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from p2wss.fit.planes.arrangement import Arrangement, TooManyPlacesError, arrange
from p2wss.fit.planes.lines import Line
from p2wss.fit.points import every_kth
from p2wss.fit.settings import NOISE_M, Drawing, Limits
from p2wss.mesh import Mesh
from p2wss.mesh.topology import NEXT

# metres: lines reach beyond their ends, so that they meet
_REACH_M = 0.01
# places on a triangle, as shares of its corners
_SHARES = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6


def known_planes(mesh: Mesh) -> np.ndarray:
    """The planes (k, 3) of the roofs of a mesh."""
    corner = np.zeros(len(mesh.planes.normal), int)
    corner[mesh.number] = mesh.triangle[:, 0]
    is_roof = _is_roof(mesh)
    normal, place_m = mesh.planes.normal[is_roof], mesh.vertex_m[corner[is_roof]]
    slope = -normal[:, :2] / normal[:, 2:]
    return np.column_stack([slope, place_m[:, 2] - (slope * place_m[:, :2]).sum(axis=1)])


def known_places(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """(places (m, 2) on the roofs of a mesh, the plane of :func:`known_planes` at each)."""
    is_roof = _is_roof(mesh)
    on_roof = is_roof[mesh.number]
    place_m = _SHARES @ mesh.corner_m[on_roof, :, :2]
    number = np.cumsum(is_roof)[mesh.number[on_roof]] - 1
    return place_m.reshape(-1, 2), np.repeat(number, len(_SHARES))


def _is_roof(mesh: Mesh) -> np.ndarray:
    return np.asarray((mesh.planes.normal[:, 2] > 0) & ~mesh.planes.is_wall)


def known_lines(mesh: Mesh) -> list[Line]:
    """The lines along which the roofs of a closed mesh meet."""
    other, is_roof = mesh.twin // 3, mesh.doubled_m2[:, 2] > 0
    is_edge = is_roof[:, None] & is_roof[other] & (mesh.number[:, None] < mesh.number[other])
    side = np.stack([mesh.triangle, mesh.triangle[:, NEXT]], axis=2)[is_edge]
    return [Line.through(*end_m).along(end_m, _REACH_M) for end_m in mesh.vertex_m[side, :2]]


def between_lines(
    rings: Sequence[np.ndarray], end_m: np.ndarray, drawing: Drawing, limits: Limits
) -> Arrangement | None:
    """The cells between lines of a map with these ends (l, 2, 2). The lines are extended by ``mapped_gap_m``, so that
    they meet what they end at. Of too many lines, only the longest are used. None without lines."""
    longest = np.argsort(-np.hypot(*(end_m[:, 1] - end_m[:, 0]).T), kind="stable")[: limits.num_mapped_lines]
    while len(longest):
        lines = [Line.through(*each).along(each, drawing.mapped_gap_m) for each in end_m[np.sort(longest)]]
        with suppress(TooManyPlacesError):
            return arrange(rings, lines, limits.num_mapped_places)
        longest = longest[: len(longest) // 2]
    return None


def mapped_planes(
    cells: Arrangement, point_m: np.ndarray, stands_m2: np.ndarray, limits: Limits
) -> np.ndarray:
    """The planes (c, 3), one over each cell between the lines of a map, that are nearest to the points (m, 3) and meet
    at these lines: the least sum of absolute residuals and steps, by reweighted least squares. A step along a metre
    counts like residuals over a square metre. So a plane with hardly any points follows from the planes that it meets,
    and a step that points show remains. stands_m2: (m,), the area that each point stands for."""
    of_point = cells.cells_at(point_m[:, :2])
    rows = np.flatnonzero(of_point >= 0)
    rows = rows[every_kth(len(rows), limits.num_mapped_points)]
    point_m, of_point = point_m[rows], of_point[rows]
    is_inner = (cells.pair >= 0).all(axis=1)
    pair, end_m = cells.pair[is_inner].repeat(2, axis=0), cells.xy_m[cells.side[is_inner]]
    strip_m2 = np.hypot(*(end_m[:, 1] - end_m[:, 0]).T).repeat(2) / 2
    num, origin_m = len(cells.area_m2), point_m.mean(axis=0)
    place_m = np.concatenate([point_m[:, :2], end_m.reshape(-1, 2)]) - origin_m[:2]
    place_m = np.hstack([place_m, np.ones((len(place_m), 1))])
    row, first = np.arange(len(place_m)), len(point_m)
    # by_cell: the coefficients of the planes of all cells in the equation of each place
    by_cell = np.zeros((len(place_m), num, 3))
    by_cell[row[:first], of_point], by_cell[row[first:], pair[:, 0]] = place_m[:first], place_m[first:]
    by_cell[row[first:], pair[:, 1]] -= place_m[first:]
    matrix = by_cell.reshape(len(place_m), -1)
    target = np.append(point_m[:, 2] - origin_m[2], np.zeros(len(pair)))
    area_m2 = np.append(stands_m2[rows], strip_m2)
    # planes that meet do so to the micrometre
    noise_m = np.where(row < first, NOISE_M, NOISE_M**4)
    weight = area_m2
    for _ in range(limits.num_mapped_rounds):
        # level where nothing else determines a plane
        normal = (matrix.T * weight) @ matrix + NOISE_M**2 * np.eye(3 * num)
        plane = np.linalg.solve(normal, matrix.T @ (weight * target))
        weight = area_m2 / np.maximum(np.abs(matrix @ plane - target), noise_m)
    plane = plane.reshape(-1, 3)
    plane[:, 2] += origin_m[2] - plane[:, :2] @ origin_m[:2]
    return plane


def mapped_places(cells: Arrangement) -> tuple[np.ndarray, np.ndarray]:
    """(places (m, 2) in cells, the cell of each): the middle of each, and near its corners."""
    beside, side = cells.pair.T.ravel(), np.tile(cells.side[:, 0], 2)
    number, corner_m = beside[beside >= 0], cells.xy_m[side[beside >= 0]]
    near_m = corner_m + (cells.middle_m[number] - corner_m) / 10
    return np.vstack([cells.middle_m, near_m]), np.append(np.arange(len(cells.middle_m)), number)


def num_on(line_end_m: np.ndarray, end_m: np.ndarray, near_m: float) -> int:
    """How many of the lines (l, 2, 2) have edges of a roof along at least half of their length. end_m: (s, 2, 2), the
    ends of the edges."""
    num = 0
    for start_m, last_m in line_end_m:
        length_m = np.hypot(*(last_m - start_m))
        along = (last_m - start_m) / length_m
        at_m = np.sort((end_m - start_m) @ along, axis=1).clip(0.0, length_m)
        is_near = (np.abs((end_m - start_m) @ [-along[1], along[0]]) < near_m).all(axis=1)
        num += np.ptp(at_m[is_near], axis=1).sum() >= length_m / 2
    return int(num)
