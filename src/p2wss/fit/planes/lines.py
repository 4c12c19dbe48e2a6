"""Lines along which the planes of a roof may end: where two meet, where there is a step, edges of the footprint."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import compress, pairwise
from typing import NamedTuple

import numpy as np
import shapely

from p2wss.fit.directions import edge_ends
from p2wss.fit.planes.detection import height_over
from p2wss.fit.settings import Drawing
from p2wss.skeleton.angles import bearings
from p2wss.skeleton.compiled import allocating, entry
from p2wss.skeleton.nearest import nearest
from p2wss.skeleton.ordering import order_of
from p2wss.skeleton.rings import sides
from p2wss.skeleton.types import cross, differs, distinct, next_in_ring, numbered, writable

# tangents: planes that differ less do not meet along a line; a plane that is steeper has a direction of its own
_PARALLEL, _SLOPED = 0.06, 0.05
# metres: a smaller difference in height between two planes is no step
_STEP_M = 0.25
_MIN_BORDER = 3
# metres: places this near to a line are on it; with a millimetre, walls would be hundredths of a millimetre off their
# planes
_ON_M = 1e-6
# metres: the triangulation fails for 39 of 6,000 grids in whole millimetres, and for none if points are moved by this
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
        """The line, extended to ``reach_m`` beyond the places (m, 2) beside it. A line without ends is cut to that."""
        place = xy_m @ self.direction
        low, high = (self.low_m, self.high_m) if self.low_m > -np.inf else (np.inf, -np.inf)
        return self._replace(low_m=min(low, place.min() - reach_m), high_m=max(high, place.max() + reach_m))


def as_arrays(lines: Sequence[Line]) -> tuple[np.ndarray, np.ndarray]:
    """(normals (l, 2), offsets (l,)) of lines."""
    return np.array([line.normal for line in lines]).reshape(-1, 2), np.array(
        [line.offset_m for line in lines]
    )


def ends_of(lines: Sequence[Line], far_m: float = np.inf) -> np.ndarray:
    """(l, 2, 2), the ends of lines, each at most ``far_m`` from the place on its line that is nearest to the origin."""
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
    links = _links(label, point_m, settings.near_m)
    meets, steps = _between(plane, links, point_m, along, settings)
    is_sloped = np.hypot(plane[:, 0], plane[:, 1]) > _SLOPED
    own = np.where(is_sloped, bearings(plane[:, :2]), along[0])
    axes = np.column_stack([np.cos(own), np.sin(own), -np.sin(own), np.cos(own)]).reshape(-1, 2)
    by_x, by_label = (np.argsort(key, kind="stable") for key in (point_m[:, 0], label))
    begin = np.searchsorted(label[by_label], np.arange(len(plane) + 1))
    sides_m = _extents(point_m, label, plane, axes, by_x, by_label, begin, settings.reach_m)
    normals = axes.repeat(2, axis=0)
    steps += [Line(normal, *side) for normal, side in zip(normals, sides_m.tolist(), strict=True)]
    going_on = [
        edge.along(ends_m, settings.beyond_m)
        for (edge, goes_on), ends_m in zip(edges, edge_ends(rings), strict=True)
        if goes_on
    ]
    walls = [edge for edge, _ in edges]
    found = [*meets, *_snapped(steps, walls, settings), *going_on]
    steps += _parts_of_steps(plane, links, point_m, own, found, along, settings)
    meets, steps = (_into_shadow(each, point_m, settings) for each in (meets, steps))
    snapped = _snapped(steps, walls, settings)
    steps = snapped + going_on
    return meets + _through_corners(steps, np.concatenate(list(rings)), settings.corner_m)


def _into_shadow(lines: Sequence[Line], point_m: np.ndarray, settings: Drawing) -> list[Line]:
    """The lines, extended beyond their ends by up to ``hidden_m`` less ``reach_m``, as far as nothing is seen."""
    further_m = settings.hidden_m - settings.reach_m
    if further_m <= 0.0 or not lines:
        return list(lines)
    way_m = np.linspace(0.0, further_m, int(further_m / settings.reach_m) + 2)
    ahead = np.array([line.direction for line in lines])[:, None] * [[[-1.0], [1.0]]]
    place_m = ends_of(lines)[:, :, None] + ahead[:, :, None] * way_m[:, None]
    xy_m, reach_m = point_m[:, :2], settings.reach_m
    # far from all points, finding the nearest takes long
    is_seen = ((place_m > xy_m.min(axis=0) - reach_m) & (place_m < xy_m.max(axis=0) + reach_m)).all(axis=3)
    is_seen[is_seen] = nearest(xy_m, place_m[is_seen])[0][:, 0] < reach_m
    # up to the last place before the first one that is seen
    num = np.where(is_seen.any(axis=2), is_seen.argmax(axis=2), len(way_m))
    low_m, high_m = way_m[np.maximum(num - 1, 0)].T.tolist()
    return [
        line._replace(low_m=line.low_m - low, high_m=line.high_m + high)
        for line, low, high in zip(lines, low_m, high_m, strict=True)
    ]


class _Links(NamedTuple):
    """Links between neighbouring points of different planes. pair: (p, 2), the planes. of_pair: (l,), the pair of each
    link. row: (l, 2), its points, in the order of the planes."""

    pair: np.ndarray
    of_pair: np.ndarray
    row: np.ndarray


def _parts_of_steps(
    plane: np.ndarray,
    links: _Links,
    point_m: np.ndarray,
    own: np.ndarray,
    lines: Sequence[Line],
    along: Sequence[float],
    settings: Drawing,
) -> list[Line]:
    """Lines along the parts of steps that turn, as around a corner of the higher roof. Of the links across a step, some
    are divided by none of ``lines``. Each new line is the one that divides the most of these. own: (k,), the directions
    of the planes, radians. lines: all lines found before. Other arguments: see :func:`lines_of`."""
    pair, of_pair, row = links
    middle_m = point_m[row, :2].mean(axis=1)
    is_step = np.abs(height_over(plane[pair[:, 0]] - plane[pair[:, 1]], of_pair, middle_m)) > _STEP_M
    is_step &= (np.bincount(of_pair[is_step], minlength=len(pair)) >= settings.part_links)[of_pair]
    if not is_step.any():
        return []
    of_pair, link_m = of_pair[is_step], point_m[row[is_step], :2]
    is_open = ~_are_divided(link_m, lines)
    of_pair, link_m, result = of_pair[is_open], link_m[is_open], list[Line]()
    for number in np.flatnonzero(np.bincount(of_pair) >= settings.part_links).tolist():
        rest_m = link_m[of_pair == number]
        normals = _normals([*dict.fromkeys([*along, *own[pair[number]].tolist()])])
        while len(rest_m) >= settings.part_links:
            line, run = _longest(rest_m, normals, settings)
            if len(run) < settings.part_links:
                break
            if np.ptp(rest_m[run].mean(axis=1) @ line.direction) < settings.part_m:
                break
            result.append(line)
            rest_m = np.delete(rest_m, run, axis=0)
            rest_m = rest_m[~_are_divided(rest_m, [line])]
    return result


def _are_divided(link_m: np.ndarray, lines: Sequence[Line]) -> np.ndarray:
    """bool (l,), which links (l, 2, 2) a line divides."""
    return np.asarray(_crossed(writable(link_m, np.float64), ends_of(lines)))


@entry
def _crossed(link_m: np.ndarray, end_m: np.ndarray) -> np.ndarray:
    """bool (l,), which links (l, 2, 2) a segment (s, 2, 2) crosses or touches."""
    result, low_x = np.zeros(len(link_m), np.bool_), np.minimum(link_m[:, 0, 0], link_m[:, 1, 0])
    order = order_of(low_x)
    widest = np.abs(link_m[:, 1, 0] - link_m[:, 0, 0]).max() if len(link_m) else 0.0
    low_x = low_x[order]
    for one, other in end_m:
        first, last = (
            np.searchsorted(low_x, min(one[0], other[0]) - widest),
            np.searchsorted(low_x, max(one[0], other[0]), "right"),
        )
        start, end = (one[0], one[1]), (other[0], other[1])
        for k in order[first:last]:
            here, there = (link_m[k, 0, 0], link_m[k, 0, 1]), (link_m[k, 1, 0], link_m[k, 1, 1])
            if not result[k] and sides(start, end, here, there) <= 0.0:
                result[k] = sides(here, there, start, end) <= 0.0
    return result


def _longest(link_m: np.ndarray, normals: np.ndarray, settings: Drawing) -> tuple[Line, np.ndarray]:
    """(line, rows): the line across one of the ``normals`` (d, 2) that divides the longest row of links, and the rows
    of these links in ``link_m`` (l, 2, 2). They go along the normal and have no gap over ``near_m`` between them."""
    off_m = link_m @ normals.T
    goes_along = (off_m[:, 0] < off_m[:, 1]).astype(int)
    at_m, change = np.concatenate([off_m[:, 0], off_m[:, 1]]), np.concatenate([goes_along, -goes_along])
    order = np.argsort(at_m, axis=0, kind="stable")
    num = np.cumsum(np.take_along_axis(change, order, 0), axis=0)
    line, run, most = Line(normals[0], 0.0), np.zeros(0, int), num.max(axis=0)
    for k in np.argsort(-most, kind="stable").tolist():
        if most[k] <= len(run):
            break
        here = num[:, k].argmax()
        offset_m = float(at_m[order[here : here + 2, k], k].mean())
        low_m, high_m = off_m[:, :, k].T
        rows = np.flatnonzero((low_m < high_m) & (low_m <= offset_m) & (high_m >= offset_m))
        across = Line(normals[k], offset_m)
        place_m = link_m[rows].mean(axis=1) @ across.direction
        by_place = np.argsort(place_m, kind="stable")
        runs = np.split(rows[by_place], np.flatnonzero(np.diff(place_m[by_place]) > settings.near_m) + 1)
        longest = max(runs, key=len)
        if len(longest) > len(run):
            line, run = across.along(link_m[longest].reshape(-1, 2), settings.reach_m), longest
    return line, run


def _normals(directions: Sequence[float]) -> np.ndarray:
    """(4 d, 2), four unit vectors for each direction, radians: along it and across it, forwards and backwards."""
    turned = np.add.outer(directions, np.arange(4) * np.pi / 2).ravel()
    return np.column_stack([np.cos(turned), np.sin(turned)])


def _between(
    plane: np.ndarray, links: _Links, point_m: np.ndarray, along: Sequence[float], settings: Drawing
) -> tuple[list[Line], list[Line]]:
    """(lines on which planes side by side meet, lines of steps between them). Arguments: see :func:`lines_of`."""
    (side, border_m), pair = _borders(links, point_m), links.pair
    of_pair, (x, y) = side // 2, border_m.T
    slope = plane[pair[:, 0]] - plane[pair[:, 1]]
    fold = np.hypot(slope[:, 0], slope[:, 1])
    # planes meet where ``meet @ (x, y, 1)`` is 0
    meet = slope / np.maximum(fold, _PARALLEL)[:, None]
    normal_x, normal_y, height_m = meet[of_pair].T
    off_m = np.where((fold > _PARALLEL)[of_pair], np.abs(x * normal_x + y * normal_y + height_m), np.inf)
    is_near, is_off = off_m < settings.off_m, off_m > settings.off_m
    is_near &= (np.bincount(of_pair[is_near], minlength=len(pair)) >= _MIN_BORDER)[of_pair]
    first = np.flatnonzero(differs(of_pair[is_near]))
    place_m = (y * normal_x - x * normal_y)[is_near]
    low_m = (np.minimum.reduceat(place_m, first) - settings.reach_m).tolist()
    high_m = (np.maximum.reduceat(place_m, first) + settings.reach_m).tolist()
    shown = meet[of_pair[is_near][first]]
    ends = zip(shown[:, :2], (-shown[:, 2]).tolist(), low_m, high_m, strict=True)
    normal, shares = _normals(along), (settings.wrong_share, settings.turned_share)
    num_off = np.bincount(side[is_off], minlength=2 * len(pair)).reshape(-1, 2)
    across, line = _steps(border_m[is_off], num_off, normal, *shares, settings.reach_m)
    steps = [Line(each, *ends) for each, ends in zip(across, line.tolist(), strict=True)]
    return [Line(*each) for each in ends], steps


def edges_of(rings: Sequence[np.ndarray]) -> list[tuple[Line, bool]]:
    """(line, whether it goes on inside the footprint beyond a reflex corner) for each edge of a footprint."""
    end_m, after = edge_ends(rings), next_in_ring(np.cumsum([0, *map(len, rings)]))
    edge = end_m[:, 1] - end_m[:, 0]
    normal = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.hypot(edge[:, 0], edge[:, 1])[:, None]
    offset_m = (normal * end_m[:, 0]).sum(axis=1).tolist()
    # a reflex corner at the end of each edge, or at its start
    goes_on = cross(edge, edge[after]) < 0
    goes_on[after] |= goes_on.copy()
    return [(Line(*line), further) for *line, further in zip(normal, offset_m, goes_on.tolist(), strict=True)]


@cache
def _shake_m(size: int) -> np.ndarray:
    """Small random moves (size, 2). The moves of a smaller size are the first of a larger one."""
    return np.random.default_rng(0).uniform(-_SHAKE_M, _SHAKE_M, (size, 2))


def _borders(links: _Links, point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(side (m,), place (m, 2)) of the points of one plane with a link to a point of another. Sides ascend: ``2 k`` for
    points of the first plane of pair k, ``2 k + 1`` for points of the second."""
    size = len(point_m)
    side, row = np.divmod(distinct((2 * links.of_pair[:, None] + [0, 1]) * size + links.row), size)
    return side, point_m[row, :2]


def _links(label: np.ndarray, point_m: np.ndarray, near_m: float) -> _Links:
    """The edges between two planes in the Delaunay triangulation of all points that have a plane, if they are shorter
    than ``near_m`` in plan."""
    rows = np.flatnonzero(label >= 0)
    # the first of the points at the same place
    rows = rows[np.lexsort((point_m[rows, 1], point_m[rows, 0]))]
    rows = rows[np.append(True, (point_m[rows[1:], :2] != point_m[rows[:-1], :2]).any(axis=1))[: len(rows)]]
    if len(rows) < 4:
        return _Links(np.zeros((0, 2), int), np.zeros(0, int), np.zeros((0, 2), int))
    # GEOS fails on some regular grids, so that each point is moved a little
    site_m = point_m[rows, :2] + _shake_m(1 << len(rows).bit_length())[: len(rows)]
    links, x_m = [], point_m[rows, 0]
    # many points are divided into strips that overlap: GEOS takes half a kilobyte for each,
    # and fails for a single one
    cuts = np.linspace(0, len(rows), -(-len(rows) // _STRIP) + 1).astype(int).tolist()
    for first, last in pairwise(cuts):
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
    pairs, pair_of = numbered(label[link] @ [size, 1])
    return _Links(np.column_stack(np.divmod(pairs, size)), pair_of, link)


@entry
def _steps(
    border_m: np.ndarray,
    num_off: np.ndarray,
    normal: np.ndarray,
    wrong_share: float,
    turned_share: float,
    reach_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(normals (l, 2); offsets, low and high ends (l, 3)) of the lines that divide the places of two planes.

    The lines are across ``normal`` (d, 2). A step that turns from these has a line across its own normal, too. The
    places on the wrong side are fewer than ``wrong_share`` of the places of the plane that has fewer. A line across its
    own normal leaves fewer there than the others, by ``turned_share``. border_m: (m, 2), the places, pair by pair.
    num_off: (p, 2), how many places are of the first and of the second plane of each pair."""
    most, first, num = len(num_off) * (len(normal) + 1), 0, 0
    result, line = np.empty((most, 2)), np.empty((most, 3))
    for num_one, num_other in num_off:
        rows, first = border_m[first : first + num_one + num_other], first + num_one + num_other
        num_wrong_along = min(num_one, num_other)
        for d in range(len(normal) + 1 if min(num_one, num_other) >= _MIN_BORDER else 0):
            is_own = d == len(normal)
            across_x, across_y = _own_normal(rows, num_one) if is_own else (normal[d, 0], normal[d, 1])
            place_m = np.empty(len(rows))
            low_m, high_m = np.inf, -np.inf
            for k in range(len(rows)):
                place_m[k] = rows[k, 0] * across_x + rows[k, 1] * across_y
                along_m = rows[k, 1] * across_x - rows[k, 0] * across_y
                low_m, high_m = min(low_m, along_m), max(high_m, along_m)
            order = order_of(place_m)
            # wrong are places of the second plane before the line, and of the first behind it
            num_wrong, num_fewest, best = num_one, wrong_share * min(num_one, num_other), -1
            if is_own:
                num_fewest = min(num_fewest, num_wrong_along - turned_share * min(num_one, num_other))
            for k in range(len(rows) - 1):
                num_wrong += 1 if order[k] >= num_one else -1
                if num_wrong < num_fewest:
                    num_fewest, best = num_wrong, k
            if best >= 0:
                num_wrong_along = min(num_wrong_along, num_fewest)
                line[num, 0] = (place_m[order[best]] + place_m[order[best + 1]]) / 2
                line[num, 1], line[num, 2] = low_m - reach_m, high_m + reach_m
                result[num, 0], result[num, 1], num = across_x, across_y, num + 1
    return result[:num].copy(), line[:num].copy()


@allocating
def _own_normal(place_m: np.ndarray, num_one: int) -> tuple[float, float]:
    """The normal of the line between the first ``num_one`` places (n, 2) and the others, from the first to these: by
    linear discriminant analysis (Fisher 1936), with the spread of the places around the means of the two groups."""
    one_m = place_m[:num_one].sum(axis=0) / num_one
    other_m = place_m[num_one:].sum(axis=0) / (len(place_m) - num_one)
    xx, xy, yy = 0.0, 0.0, 0.0
    for k in range(len(place_m)):
        mean_m = one_m if k < num_one else other_m
        x, y = place_m[k, 0] - mean_m[0], place_m[k, 1] - mean_m[1]
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
    x, y = other_m[0] - one_m[0], other_m[1] - one_m[1]
    normal_x, normal_y = yy * x - xy * y, xx * y - xy * x
    length = np.hypot(normal_x, normal_y)
    return (normal_x / length, normal_y / length) if length > 0.0 else (1.0, 0.0)


@entry
def _extents(
    point_m: np.ndarray,
    label: np.ndarray,
    plane: np.ndarray,
    axes: np.ndarray,
    by_x: np.ndarray,
    by_label: np.ndarray,
    begin: np.ndarray,
    reach_m: float,
) -> np.ndarray:
    """(4 k, 3): offset, low and high end of four lines for each plane, the sides of the rectangle around its points.
    Strips along a side where more points are off the plane than on it are left out of the rectangle. axes: (2 k, 2),
    two unit vectors for each plane; two lines are across each. by_x, by_label: points by their first coordinate, and
    plane by plane. begin: (k + 1,), the first element of each plane in ``by_label``."""
    result, x_m = np.empty((4 * len(plane), 3)), point_m[by_x, 0]
    own_m, other_m = np.empty((2, len(label))), np.empty((2, len(label)))
    for number in range(len(plane)):
        (cosine, sine), (a, b, c) = axes[2 * number], plane[number]
        num, num_others = 0, 0
        for row in by_label[begin[number] : begin[number + 1]]:
            x, y = point_m[row, 0], point_m[row, 1]
            own_m[0, num], own_m[1, num], num = x * cosine + y * sine, y * cosine - x * sine, num + 1
        for k in range(2):
            own_m[k, :num] = own_m[k, :num][order_of(own_m[k, :num])]
        (left, bottom), (right, top) = own_m[:, 0], own_m[:, num - 1]
        # the bounds of the rectangle in x and y
        low_x = min(cosine * left, cosine * right) + min(-sine * bottom, -sine * top)
        high_x = max(cosine * left, cosine * right) + max(-sine * bottom, -sine * top)
        low_y = min(sine * left, sine * right) + min(cosine * bottom, cosine * top)
        high_y = max(sine * left, sine * right) + max(cosine * bottom, cosine * top)
        first, last = int(np.rint(0.01 * (num - 1))), int(np.rint(0.99 * (num - 1)))
        for row in by_x[np.searchsorted(x_m, low_x) : np.searchsorted(x_m, high_x)]:
            x, y, z = point_m[row]
            if label[row] != number and low_y <= y <= high_y and abs(a * x + b * y + c - z) > _STEP_M:
                u, v = x * cosine + y * sine, y * cosine - x * sine
                if own_m[0, first] <= u <= own_m[0, last] and own_m[1, first] <= v <= own_m[1, last]:
                    other_m[0, num_others], other_m[1, num_others], num_others = u, v, num_others + 1
        for k in range(2):
            other_m[k, :num_others] = other_m[k, :num_others][order_of(other_m[k, :num_others])]
            margin_m = (own_m[k, num - 1] - own_m[k, 0]) / num**0.5 / 2
            from_m, to_m = own_m[k, first] - margin_m, own_m[k, last] + margin_m
            # ``more``: how many more points on the plane than off it are up to each place; where it is least and most
            more, least, most, own, other, is_least, is_most = 0, 0, 0, 0, 0, False, False
            least_m = most_m = 0.0
            while own < num or other < num_others:
                is_own = other == num_others or (own < num and own_m[k, own] <= other_m[k, other])
                here_m = own_m[k, own] if is_own else other_m[k, other]
                # the line is halfway to the next place
                least_m = (least_m + here_m) / 2 if is_least else least_m
                most_m = (most_m + here_m) / 2 if is_most else most_m
                own, other, more = (own + 1, other, more + 1) if is_own else (own, other + 1, more - 1)
                is_least, is_most = more < least, more > most
                if is_least:
                    least, least_m = more, here_m
                if is_most:
                    most, most_m = more, here_m
            # a line across the first axis runs along the second axis, a line across the second against the first
            low_m, high_m = (
                (bottom - reach_m, top + reach_m) if k == 0 else (-right - reach_m, reach_m - left)
            )
            result[4 * number + 2 * k] = least_m if least < 0 else from_m, low_m, high_m
            result[4 * number + 2 * k + 1] = most_m if most > more else to_m, low_m, high_m
    return result


def _snapped(steps: Sequence[Line], edges: Sequence[Line], settings: Drawing) -> list[Line]:
    """The lines of steps, each once. A step near to an edge of the footprint, or to an earlier step, becomes a part of
    the line of that edge or step."""
    targets, end_m = [*edges, *steps], ends_of(steps)
    normal, offset_m = as_arrays(targets)
    min_along = float(np.cos(np.radians(settings.same_deg / 2)))
    same = _first_same(normal, offset_m, end_m.mean(axis=1), min_along, settings.snap_m)
    place_m = cross(normal[same][:, None], end_m)
    is_own = same == np.arange(len(edges), len(targets))
    own = [(line.low_m, line.high_m) for line in compress(steps, is_own)]
    place_m[is_own] = np.reshape(own, (-1, 2))
    _, first, number = np.unique(same, return_index=True, return_inverse=True)
    low_m, high_m = np.full(len(first), np.inf), np.full(len(first), -np.inf)
    np.minimum.at(low_m, number, place_m.min(axis=1))
    np.maximum.at(high_m, number, place_m.max(axis=1))
    order = np.argsort(first)
    return [
        targets[k]._replace(low_m=low, high_m=high)
        for k, low, high in zip(*(each[order].tolist() for each in (same[first], low_m, high_m)), strict=True)
    ]


@entry
def _first_same(
    normal: np.ndarray, offset_m: np.ndarray, middle_m: np.ndarray, min_along: float, snap_m: float
) -> np.ndarray:
    """int (s,): the line that each of the last s lines, with the middles ``middle_m`` (s, 2), is a part of. This is the
    first line in nearly the same direction that is near to its middle, out of the lines before these and of the earlier
    ones that are a part of no other; or else itself."""
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
    """The lines, bent so that a line that passes near to corners (n, 2) of the footprint goes through them: from one
    corner to the next, and parallel to itself beyond. Otherwise there would be a wall as narrow as the gap between."""
    normal, offset_m = as_arrays(lines)
    direction = np.column_stack([-normal[:, 1], normal[:, 0]])
    off_m, place = np.abs(normal @ corner_m.T - offset_m[:, None]), direction @ corner_m.T
    result = []
    low_m, high_m = (
        np.array([(line.low_m, line.high_m) for line in lines]).reshape(-1, 2, 1).transpose(1, 0, 2)
    )
    is_near = (off_m < near_m) & (place > low_m) & (place < high_m)
    passes = (is_near & (off_m >= _ON_M)).any(axis=1).tolist()
    for line, is_beside, at, by in zip(lines, is_near, place, passes, strict=True):
        if not by:
            result.append(line)
            continue
        near = np.flatnonzero(is_beside)
        on = corner_m[near[np.argsort(at[near], kind="stable")]]
        # rings may touch in a corner
        on = on[np.append(True, (on[1:] != on[:-1]).any(axis=1))]
        first_m, last_m = (float(each @ line.normal) for each in on[[0, -1]])
        result.append(line._replace(offset_m=first_m, high_m=at[near].min()))
        result += [Line.through(*ends).along(np.array(ends), 0.0) for ends in pairwise(on)]
        result.append(line._replace(offset_m=last_m, low_m=at[near].max()))
    return result
