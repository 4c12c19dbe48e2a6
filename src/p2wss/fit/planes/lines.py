"""Lines along which the planes of a roof may end: where two meet, where there is a step, edges of the footprint."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely

from p2wss.fit.directions import edge_ends
from p2wss.fit.planes.detection import heights, rows_of
from p2wss.fit.settings import Drawing
from p2wss.skeleton.angles import bearings
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import cross

# tangents: planes that differ less do not meet along a line; a plane that is steeper has a direction of its own
_PARALLEL, _SLOPED = 0.06, 0.05
# metres: a larger step between two planes is one
_STEP_M = 0.25
_MIN_BORDER = 3
# metres: what is so near to a line is on it
_ON_M = 1e-3
# metres: as they are, 39 of 6,000 grids in whole millimetres fail; moved by this, none
_SHAKE_M = 1e-3
# points whose neighbours are found together
_STRIP = 25_000


class Line(NamedTuple):
    """The places ``normal @ xy == offset_m`` from ``low_m`` to ``high_m`` along :attr:`direction`."""

    normal: np.ndarray
    offset_m: float
    low_m: float = -np.inf
    high_m: float = np.inf

    @classmethod
    def through(cls, one_m: np.ndarray, other_m: np.ndarray) -> Line:
        """The line through two places (2,)."""
        step = other_m - one_m
        normal = np.array([step[1], -step[0]]) / np.hypot(step[0], step[1])
        return cls(normal, float(normal @ one_m))

    @property
    def direction(self) -> np.ndarray:
        return np.array([-self.normal[1], self.normal[0]])

    def along(self, xy_m: np.ndarray, reach_m: float) -> Line:
        """The line as far as places (m, 2) beside it, and further."""
        place = xy_m @ self.direction
        low, high = (self.low_m, self.high_m) if self.low_m > -np.inf else (np.inf, -np.inf)
        return self._replace(low_m=min(low, place.min() - reach_m), high_m=max(high, place.max() + reach_m))


def as_arrays(lines: Sequence[Line]) -> tuple[np.ndarray, np.ndarray]:
    """(normals (l, 2), offsets (l,)) of lines."""
    return np.array([line.normal for line in lines]).reshape(-1, 2), np.array(
        [line.offset_m for line in lines]
    )


def ends_of(lines: Sequence[Line], far_m: float = np.inf) -> np.ndarray:
    """(l, 2, 2), the ends of lines, at most so far from the place of a line that is nearest to the origin."""
    normal, offset_m = as_arrays(lines)
    place = np.array([(line.low_m, line.high_m) for line in lines]).reshape(-1, 2).clip(-far_m, far_m)
    direction = np.column_stack([-normal[:, 1], normal[:, 0]])
    return np.asarray((normal * offset_m[:, None])[:, None] + place[:, :, None] * direction[:, None])


def lines_of(
    rings: Sequence[np.ndarray],
    plane: np.ndarray,
    label: np.ndarray,
    point_m: np.ndarray,
    along: Sequence[float],
    settings: Drawing,
) -> list[Line]:
    """All lines of a roof of planes (k, 3). label: (m,), the plane of each point (m, 3), -1 for none. along: directions
    of the footprint ``rings``, radians."""
    edges = edges_of(rings)
    meets, steps = [], []
    for (i, j), sides in _borders(label, point_m, settings.near_m).items():
        border = np.concatenate(sides)
        slope = plane[i] - plane[j]
        fold = np.hypot(slope[0], slope[1])
        if fold > _PARALLEL:
            meet = Line(slope[:2] / fold, -slope[2] / fold)
            off_m = np.abs(border @ meet.normal - meet.offset_m)
            near = off_m < settings.off_m
            if near.sum() >= _MIN_BORDER:
                meets.append(meet.along(border[near], settings.reach_m))
            sides = [side[np.abs(side @ meet.normal - meet.offset_m) > settings.off_m] for side in sides]
        if min(map(len, sides)) >= _MIN_BORDER:
            steps += _steps(sides, along, settings)
    is_sloped = np.hypot(plane[:, 0], plane[:, 1]) > _SLOPED
    own = np.where(is_sloped, bearings(plane[:, :2]), along[0])
    by_x = np.argsort(point_m[:, 0], kind="stable")
    x_m = point_m[by_x, 0]
    for number, (rows, angle) in enumerate(zip(rows_of(label, len(plane)), own.tolist(), strict=True)):
        # a rectangle along the plane around its points, and what is as far along both axes
        turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        place = point_m[rows, :2] @ turned.T
        corner_m = (
            np.array(np.meshgrid(*zip(place.min(axis=0), place.max(axis=0), strict=True))).reshape(2, -1).T
            @ turned
        )
        low_m, high_m = corner_m.min(axis=0), corner_m.max(axis=0)
        first, last = np.searchsorted(x_m, (low_m[0], high_m[0]))
        others = by_x[first:last]
        others = others[
            (point_m[others, 1] >= low_m[1]) & (point_m[others, 1] <= high_m[1]) & (label[others] != number)
        ]
        off_m = np.abs(heights(plane[number : number + 1], point_m[others, :2])[:, 0] - point_m[others, 2])
        others = np.sort(others[off_m > _STEP_M])
        steps += _extent(point_m[rows, :2], point_m[others, :2], angle, settings)
    snapped = _snapped(steps, [edge for edge, _ in edges], settings)
    steps = snapped + [edge for edge, is_reflex in edges if is_reflex]
    return meets + _through_corners(steps, np.concatenate(list(rings)), settings.corner_m)


def edges_of(rings: Sequence[np.ndarray]) -> list[tuple[Line, bool]]:
    """The lines of the edges of a footprint, and whether the line goes on inside it beyond a reflex corner."""
    result = []
    for ring in rings:
        edge = np.diff(edge_ends([ring]), axis=1)[:, 0]
        normal = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.hypot(edge[:, 0], edge[:, 1])[:, None]
        offset_m = (normal * ring).sum(axis=1).tolist()
        # the edge before each is at the same place of an array that begins with the last
        before = edge[np.arange(len(edge)) - 1]
        is_reflex = (cross(before, edge) < 0).tolist()
        goes_on = [
            here or there for here, there in zip(is_reflex, is_reflex[1:] + is_reflex[:1], strict=True)
        ]
        result += [(Line(*line), further) for *line, further in zip(normal, offset_m, goes_on, strict=True)]
    return result


def _borders(
    label: np.ndarray, point_m: np.ndarray, near_m: float
) -> dict[tuple[int, int], list[np.ndarray]]:
    """By pairs of planes, the places (m, 2) of points of each that are beside a point of the other."""
    rows = np.flatnonzero(label >= 0)
    # of points at one place the first
    rows = rows[np.unique(point_m[rows, 0] + 1j * point_m[rows, 1], return_index=True)[1]]
    if len(rows) < 4:
        return {}
    # GEOS fails on some regular grids, so that each point is moved a little
    site_m = point_m[rows, :2] + np.random.default_rng(0).uniform(-_SHAKE_M, _SHAKE_M, (len(rows), 2))
    links, x_m = [], point_m[rows, 0]
    for first in range(0, len(rows), _STRIP):
        # of many points in strips across, with what is beside: GEOS takes half a kilobyte for each
        last = min(first + _STRIP, len(rows))
        low, high = np.searchsorted(x_m, (x_m[first] - 2 * near_m, x_m[last - 1] + 2 * near_m))
        # edges keep heights: the numbers of their points
        sites = shapely.linestrings(np.column_stack([site_m, np.arange(len(rows))])[low:high])
        edges = shapely.delaunay_triangles(sites, only_edges=True)
        link = shapely.get_coordinates(edges, include_z=True)[:, 2].astype(int).reshape(-1, 2)
        begin = link.min(axis=1)
        links.append(rows[link[(begin >= first) & (begin < last)]])
    link = np.concatenate(links)
    link = link[label[link[:, 0]] != label[link[:, 1]]]
    apart = point_m[link[:, 0], :2] - point_m[link[:, 1], :2]
    link = link[np.hypot(apart[:, 0], apart[:, 1]) < near_m]
    link = np.where(label[link[:, :1]] < label[link[:, 1:]], link, link[:, ::-1])
    size = len(label)
    pair_of = label[link] @ [size, 1]
    pairs, sides = np.unique(pair_of), []
    for side in (0, 1):
        number, row = np.divmod(np.unique(pair_of * size + link[:, side]), size)
        sides.append(np.split(point_m[row, :2], np.searchsorted(number, pairs[1:])))
    return {divmod(pair, size): list(each) for pair, *each in zip(pairs.tolist(), *sides, strict=False)}


def _steps(sides: Sequence[np.ndarray], angles: Sequence[float], settings: Drawing) -> list[Line]:
    """Lines in the given directions that have the points of one side on one hand and the others on the other."""
    one, other = sides
    both = np.concatenate([one, other])
    turned = np.add.outer(angles, np.arange(4) * np.pi / 2).ravel()
    normal = np.column_stack([np.cos(turned), np.sin(turned)])
    place = both @ normal.T
    order = np.argsort(place, axis=0, kind="stable")
    place, is_other = np.take_along_axis(place, order, axis=0), order >= len(one)
    num_wrong = (np.cumsum(is_other, axis=0) + len(one) - np.cumsum(~is_other, axis=0))[:-1]
    best = num_wrong.argmin(axis=0)
    result = []
    for i in np.flatnonzero(num_wrong.min(axis=0) < settings.wrong_share * min(len(one), len(other))):
        line = Line(normal[i], float(place[best[i] : best[i] + 2, i].mean()))
        result.append(line.along(both, settings.reach_m))
    return result


def _extent(xy_m: np.ndarray, other_m: np.ndarray, angle: float, settings: Drawing) -> list[Line]:
    """The sides of the rectangle around the places (m, 2) of a plane, without the strips along them that have more of
    the places (n, 2) of points off the plane."""
    normal = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    # of so few values, numpy's own percentiles take ten times as long
    place, other = np.sort(xy_m @ normal.T, axis=0), other_m @ normal.T
    margin_m = (place[-1] - place[0]) / len(place) ** 0.5 / 2
    low, high = place[[round(share * (len(place) - 1)) for share in (0.01, 0.99)]]
    # the direction of the first axis is the second axis, that of the second is against the first
    (start, left), (end, right) = place[0] - settings.reach_m, place[-1] + settings.reach_m
    both = np.concatenate([place, other[((other >= low) & (other <= high)).all(axis=1)]])
    order = np.argsort(both, axis=0, kind="stable")
    # how many more of the plane than others are up to each of all places
    num_more = np.cumsum(np.where(order < len(place), 1, -1), axis=0)
    result = []
    for axis, span in enumerate([(left, right), (-end, -start)]):
        along, num = both[order[:, axis], axis], num_more[:, axis]
        first, last = int(num.argmin()), int(num.argmax())
        from_m, to_m = low[axis] - margin_m[axis], high[axis] + margin_m[axis]
        if num[first] < 0:
            from_m = along[first : first + 2].mean()
        if num[last] > num[-1]:
            to_m = along[last : last + 2].mean()
        result += [Line(normal[axis], float(offset_m), *span) for offset_m in (from_m, to_m)]
    return result


def _snapped(steps: Sequence[Line], edges: Sequence[Line], settings: Drawing) -> list[Line]:
    """Steps, those near to an edge of the footprint or to an earlier step as parts of its line; each line once."""
    targets, end_m = [*edges, *steps], ends_of(steps)
    result: dict[int, Line] = {}
    min_along = float(np.cos(np.radians(settings.same_deg / 2)))
    same = _first_same(*as_arrays(targets), end_m.mean(axis=1), min_along, settings.snap_m)
    for own, (number, ends) in enumerate(zip(same.tolist(), end_m, strict=True), len(edges)):
        line = result.get(number, targets[number])
        result[number] = line.along(ends, 0.0) if number < own else line
    return list(result.values())


@entry
def _first_same(
    normal: np.ndarray, offset_m: np.ndarray, middle_m: np.ndarray, min_along: float, snap_m: float
) -> np.ndarray:
    """int (s,): of each of the last lines, with these middles (s, 2), the first one along it that it is near to, of the
    lines before these and those that are near to no other: or else itself."""
    num_edges = len(normal) - len(middle_m)
    used, num_used, result = np.arange(len(normal)), num_edges, np.empty(len(middle_m), np.int64)
    for k in range(len(middle_m)):
        own, t = num_edges + k, 0
        while t < num_used:
            x, y = normal[used[t]]
            is_along = abs(normal[own, 0] * x + normal[own, 1] * y) > min_along
            if is_along and abs(middle_m[k, 0] * x + middle_m[k, 1] * y - offset_m[used[t]]) < snap_m:
                break
            t += 1
        if t == num_used:
            used[num_used], num_used = own, num_used + 1
        result[k] = used[t]
    return result


def _through_corners(lines: Sequence[Line], corner_m: np.ndarray, near_m: float) -> list[Line]:
    """The lines, those that pass by corners (n, 2) of the footprint as lines from one to the next: else, there would be
    a wall as narrow as what is between."""
    normal, offset_m = as_arrays(lines)
    direction = np.column_stack([-normal[:, 1], normal[:, 0]])
    off_m, place = np.abs(normal @ corner_m.T - offset_m[:, None]), direction @ corner_m.T
    result = []
    for line, off, at in zip(lines, off_m, place, strict=True):
        near = np.flatnonzero((off < near_m) & (at > line.low_m) & (at < line.high_m))
        if off[near].max(initial=0.0) < _ON_M:
            result.append(line)
            continue
        on = corner_m[near[np.argsort(at[near], kind="stable")]]
        first_m, last_m = (float(each @ line.normal) for each in on[[0, -1]])
        result.append(line._replace(offset_m=first_m, high_m=at[near].min()))
        result += [Line.through(*ends).along(np.array(ends), 0.0) for ends in pairwise(on)]
        result.append(line._replace(offset_m=last_m, low_m=at[near].max()))
    return result
