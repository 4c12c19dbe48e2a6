"""A roof of any shape: the planes that its points show, each over the part of the footprint that it covers."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.fit.directions import directions, edge_ends
from p2wss.fit.planes.arrangement import Arrangement, TooManyPlacesError, arrange, by_member
from p2wss.fit.planes.costs import Costs, candidates_of, costs_of
from p2wss.fit.planes.detection import detect, height_over, payable
from p2wss.fit.planes.known import (
    between_lines,
    known_lines,
    known_places,
    known_planes,
    mapped_places,
    mapped_planes,
    num_on,
)
from p2wss.fit.planes.labelling import least_cost
from p2wss.fit.planes.lines import Line, lines_of
from p2wss.fit.planes.regularity import regular
from p2wss.fit.planes.solid import OUTSIDE, at_pinch, solid_below
from p2wss.fit.points import even_order, every_kth
from p2wss.fit.settings import Drawing, Limits, Planes
from p2wss.mesh import Mesh
from p2wss.skeleton.angles import slope_angles
from p2wss.skeleton.groups import groups
from p2wss.skeleton.nearest import nearest
from p2wss.skeleton.types import distinct, numbered

# cubic metres: the price, beyond all others, of each upright edge of four walls
_PINCH_M3 = 1e6
# smaller savings are rounding
_GAIN_M3 = 1e-6
# directions of a footprint along which steps are sought, and planes where points are few
_NUM_DIRECTIONS = 2
# metres: the roof at an edge is looked up this far within the footprint; tangent of the slope of a level roof
_INSIDE_M, _LEVEL = 0.1, 0.02
# metres: a lower roof may be open ground
_LOW_M = 2.0


@dataclass(frozen=True)
class PlanesFit:
    """The fitted roof. plane: (k, 3). label: int (c,), the plane over each of the ``cells``. built: like ``label``, but
    :data:`OUTSIDE` over open ground, where there is no solid. body: int (c,), the number of the body of each cell; the
    roofs of different bodies have steps between them. num_bodies: how many bodies are built. mesh: the solid from
    height 0 to the roof. is_simplified: whether the points show more planes than :class:`p2wss.fit.settings.Limits`
    allow. costs: the costs that were compared. point_m, at_plane: the points, and the plane of each, -1 for none.
    num_known: how many planes, the last ones, are of a known roof or between lines of a map. num_lines_used: how many
    lines of the map have planes ending along them."""

    plane: np.ndarray
    cells: Arrangement
    label: np.ndarray
    built: np.ndarray
    body: np.ndarray
    num_bodies: int
    mesh: Mesh
    is_simplified: bool
    costs: Costs
    point_m: np.ndarray
    at_plane: np.ndarray
    num_known: int
    num_lines_used: int

    def parameters(self, rings: Sequence[np.ndarray]) -> tuple[float, np.ndarray]:
        """(eave height of the largest body, angle of the roof at every edge, degrees).

        The angle is the slope of the plane at the edge if it rises from the edge, 0 for a level roof, and 90 otherwise,
        as along a gable. The eave is the lowest height at the edges from which the roof rises or where it is level.
        Bodies below 2 m, which may be open ground, count only if there is no other.
        """
        ends = edge_ends(rings)
        edge = ends[:, 1] - ends[:, 0]
        length_m = np.hypot(edge[:, 0], edge[:, 1])
        inwards = np.column_stack([-edge[:, 1], edge[:, 0]]) / length_m[:, None]
        middle_m = ends.mean(axis=1)
        cell = self.cells.cells_at(middle_m + _INSIDE_M * inwards)
        # behind a short edge at a sharp corner, this place is outside
        cell[cell < 0] = self.cells.cells_at((middle_m + _INSIDE_M / 20 * inwards)[cell < 0])
        number = self.label[cell]
        slope = self.plane[number, :2]
        steep = np.hypot(slope[:, 0], slope[:, 1])
        rises = (slope * inwards).sum(axis=1) > steep * np.sqrt(0.5)
        is_level = steep < _LEVEL
        angle_deg = np.where(is_level, 0.0, np.where(rises, slope_angles(steep), 90.0))
        over_cell_m = height_over(self.plane, self.label, self.cells.middle_m)
        is_high = over_cell_m > _LOW_M
        weight = self.cells.area_m2 * (is_high | (not is_high.any()))
        largest = int(np.bincount(self.body, weights=weight).argmax())
        height_m = height_over(self.plane, number, middle_m)
        at_eave = (self.body[cell] == largest) & (cell >= 0) & (rises | is_level)
        if at_eave.any():
            return float(height_m[at_eave].min()), angle_deg
        return float(over_cell_m[self.body == largest].min()), angle_deg


def fit_planes(
    rings: Sequence[np.ndarray],
    point_m: np.ndarray,
    settings: Planes,
    num_open: int = 0,
    around_m: np.ndarray | None = None,
    known: Mesh | None = None,
    supposed_m: np.ndarray | None = None,
    line_m: np.ndarray | None = None,
) -> PlanesFit | None:
    """The planes over a footprint that cost least; None if the points (m, 3) show no plane, or if no solid is closed.

    num_open: how many points, the last ones, are of open ground. Where they show it, there is no solid, if the rest is
    closed and in one piece. around_m: (k, 3), points on the roofs around, which may share planes and lines with this
    one, as in a row of houses. known: a roof with which the search begins, and whose planes and lines are candidates.
    supposed_m: (s, 3), places all over the roof at supposed heights, which count as little as a few points. line_m:
    (l, 2, 2), lines of a map. With a known roof, planes may end there, and the planes that meet there are candidates.
    """
    area_m2, order = shapely.Polygon(rings[0], rings[1:]).area, even_order(point_m)
    max_num = min(int(settings.detection.max_per_m2 * area_m2) + 1, settings.limits.num_points)
    order = order[every_kth(len(order), max_num)]
    point_m, is_open = point_m[order], order >= len(point_m) - num_open
    density = len(point_m) / area_m2
    if around_m is not None:
        point_m = np.vstack([point_m, around_m])
        is_open = np.append(is_open, np.zeros(len(around_m), bool))
    along = directions(rings, settings.drawing.same_deg)
    main = along[:_NUM_DIRECTIONS]
    found = detect(point_m, density, main, settings.detection)
    if len(found.plane):
        plane = regular(found, point_m, along)
        found = payable(point_m, found, plane, 1 / density, settings.prices)
    # perhaps no plane is worth its price
    if not len(plane := found.plane):
        return None
    corner_m = np.concatenate(rings)
    top = np.where(found.label >= 0, point_m[:, 2], -np.inf).argmax()
    slope = plane[found.label[top], :2]
    rise_m = settings.drawing.reach_m * np.hypot(*slope)
    is_hidden = (corner_m @ slope).max() > (point_m[:, :2] @ slope).max() + rise_m
    if is_hidden and known is None and (found.label == found.label[top]).sum() > 1:
        # where nothing is seen behind the highest point, the other side of a ridge may be as steep
        behind = np.append(-slope, point_m[top, 2] + slope @ point_m[top, :2])
        found.label[top], plane = len(plane), np.vstack([plane, behind])
    # what is hidden is at a corner, as shadows come from beyond the footprint
    hidden_m = float(nearest(point_m[:, :2], corner_m)[0].max())
    drawing = settings.drawing.for_density(density)._replace(hidden_m=hidden_m)
    # where points are many, they show these lines more exactly than a map
    line_m = np.zeros((0, 2, 2)) if line_m is None else line_m
    of_map = None if known is None else between_lines(rings, line_m, drawing, settings.limits)
    further = [] if known is None else known_lines(known)
    if of_map is not None:
        further += of_map.lines[of_map.num_edges :]
    drawn = _drawn(rings, plane, found.label, point_m, main, further, drawing, settings.limits)
    if drawn is None:
        return None
    num_shown, (plane, at_plane, cells) = len(plane), drawn
    is_simplified = len(plane) < num_shown
    # separate parts of a roof have lines of their own, but may be in the same plane
    first = dict[tuple[float, ...], int]()
    of_plane = [first.setdefault((*each,), len(first)) for each in plane.tolist()]
    # -1, for points without a plane, is the last element
    plane, at_plane, num_found = np.array([*first]), np.array([*of_plane, -1])[at_plane], len(first)
    cell = cells.cells_at(point_m[:, :2])
    seen_m, of_cell, stands_m2 = point_m, cell, np.full(len(point_m), 1 / density)
    if supposed_m is not None and len(supposed_m):
        seen_m = np.vstack([seen_m, supposed_m])
        of_cell = np.append(of_cell, cells.cells_at(supposed_m[:, :2]))
        supposed_m2 = area_m2 * min(settings.prices.supposed_per_m2 / density, 1.0)
        stands_m2 = np.append(stands_m2, np.full(len(supposed_m), supposed_m2 / len(supposed_m)))
    at_m, number = point_m[at_plane >= 0, :2], at_plane[at_plane >= 0]
    if of_map is not None:
        mapped_m, mapped_number = mapped_places(of_map)
        at_m, number = np.vstack([at_m, mapped_m]), np.append(number, len(plane) + mapped_number)
        plane = np.vstack([plane, mapped_planes(of_map, seen_m, stands_m2, settings.limits)])
    num_known = 0
    if known is not None:
        known_m, known_number = known_places(known)
        at_m, number = np.vstack([at_m, known_m]), np.append(number, len(plane) + known_number)
        plane = np.vstack([plane, known_planes(known)])
        # planes between lines of a map count as well
        num_known = len(plane) - num_found
    candidates = candidates_of(cells, at_m, number, seen_m[:, :2], of_cell, drawing.near_m)
    prices = settings.prices.for_density(density)
    costs = costs_of(cells, plane, seen_m, of_cell, stands_m2, prices, candidates, num_known)
    built = label = _without_pinches(cells, costs, least_cost(costs, num_known), plane)
    if num_open:
        built = _without_open_ground(cells, costs, label, plane, np.where(is_open, cell, -1), cell)
    mesh = solid_below(cells, built, plane, corner_m)
    if mesh is None:
        return None
    body = costs.bodies(label)
    num_bodies = len(distinct(body[built != OUTSIDE]))
    is_border = (cells.pair >= 0).all(axis=1) & (np.diff(built[cells.pair], axis=1)[:, 0] != 0)
    num_used = num_on(line_m, cells.xy_m[cells.side[is_border]], drawing.mapped_on_m)
    return PlanesFit(
        plane,
        cells,
        label,
        built,
        body,
        num_bodies,
        mesh,
        is_simplified,
        costs,
        point_m,
        at_plane,
        num_known,
        num_used,
    )


def _drawn(
    rings: Sequence[np.ndarray],
    plane: np.ndarray,
    label: np.ndarray,
    point_m: np.ndarray,
    along: Sequence[float],
    further: Sequence[Line],
    drawing: Drawing,
    limits: Limits,
) -> tuple[np.ndarray, np.ndarray, Arrangement] | None:
    """(planes, the plane of each point, -1 for none, the cells between the lines of the planes and the lines
    ``further``). If all planes exceed the limits, only the largest are used; None if even one plane exceeds them."""
    num = limits.num_planes
    while num:
        if len(plane) > num:
            kept = np.sort(
                np.argsort(-np.bincount(label[label >= 0], minlength=len(plane)), kind="stable")[:num]
            )
            number = np.full(len(plane) + 1, -1)
            number[kept] = np.arange(num)
            # -1, for points without a plane, is the last element
            plane, label = plane[kept], number[label]
        lines = [*lines_of(rings, plane, label, point_m, along, drawing), *further]
        if len(lines) <= limits.num_lines:
            with suppress(TooManyPlacesError):
                return plane, label, arrange(rings, lines, limits.num_places)
        num = min(num, len(plane)) // 2
    return None


def _without_pinches(cells: Arrangement, costs: Costs, label: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """The labels (c,) without upright edges that four walls share, where possible: all cells of a plane side by side
    at such an edge get the plane of a cell beside them, as cheaply as possible."""
    pending = at_pinch(cells, label, plane, np.arange(len(cells.side))).tolist()
    if not pending:
        return label
    label, sides_at, sides_of = label.copy(), by_member(cells.side), by_member(cells.pair)
    while pending:
        place = pending.pop()
        sides = sides_at(np.array([place]))
        pair = cells.pair[sides]
        cell, pair = numbered(pair[(pair >= 0).all(axis=1)].ravel())
        pair = pair.reshape(-1, 2)
        is_border = label[cell[pair[:, 0]]] != label[cell[pair[:, 1]]]
        sector = groups(len(cell), pair[~is_border])
        pair = np.vstack([pair[is_border], pair[is_border, ::-1]])
        moves = zip(sector[pair[:, 0]].tolist(), label[cell[pair[:, 1]]].tolist(), strict=True)
        best_m3, best = -_GAIN_M3, None
        for each, number in dict.fromkeys(moves):
            moved, changed, saved_m3 = cell[sector == each], label.copy(), 0.0
            for one in moved:
                saved_m3 += costs.change_m3(changed, one, number)
                changed[one] = number
            corner = distinct(cells.side[sides_of(moved)])
            around = sides_at(corner)
            before, after = (
                np.intersect1d(at_pinch(cells, x, plane, around), corner) for x in (label, changed)
            )
            saved_m3 += _PINCH_M3 * (len(after) - len(before))
            if saved_m3 < best_m3:
                best_m3, best, still = saved_m3, changed, after
        if best is not None:
            label = best
            pending += sorted({*still.tolist()} - {*pending})
    return label


def _without_open_ground(
    cells: Arrangement,
    costs: Costs,
    label: np.ndarray,
    plane: np.ndarray,
    open_cell: np.ndarray,
    cell: np.ndarray,
) -> np.ndarray:
    """The labels (c,) with :data:`OUTSIDE` for faces of open ground, if the rest is in one piece without them. Such a
    face is level, at most 2 m high, and more than half of its points are of open ground. open_cell, cell: (m,), the
    cell of each point of open ground, and of each of all points; -1 for none."""
    count, num_open = (np.bincount(each + 1, minlength=len(label) + 1)[1:] for each in (cell, open_cell))
    face = costs.faces(label)
    is_low = (height_over(plane, label, cells.middle_m) <= _LOW_M) & (np.hypot(*plane[label, :2].T) < _LEVEL)
    is_open = is_low & (2 * np.bincount(face, num_open) > np.bincount(face, count))[face]
    for number in np.unique(face[is_open]).tolist():
        rest = np.where(face == number, OUTSIDE, label)
        beside = costs.problem.pair[(rest[costs.problem.pair] != OUTSIDE).all(axis=1)]
        is_one = len(np.unique(groups(len(rest), beside)[rest != OUTSIDE])) == 1
        if is_one and not len(at_pinch(cells, rest, plane, np.arange(len(cells.side)))):
            label = rest
    return label
