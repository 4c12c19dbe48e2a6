"""The planes of a roof, grown from its points.

A plane is (a, b, c): its height is ``a x + b y + c``, in the frame of the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from p2wss.fit.points import every_kth, quantile
from p2wss.fit.settings import Detection, PlanePrices
from p2wss.skeleton.compiled import ZERO, allocating, entry, inner
from p2wss.skeleton.nearest import nearest
from p2wss.skeleton.ordering import ascending, order_of, sorted_by

# sums of the same scores in different order differ by less
_ROUNDING = 1e-6
# the roughness at this quantile of the points is of a surface without edges; it is so many standard deviations of a
# point
_EVEN_SHARE, _EVEN_ROUGHNESS = 0.25, 0.62
# the unit normal of a steep plane has less height than the first figure, and none has less than the second. The plane
# has so many points or more, and they are less than so many times as far from it as noise
_STEEP_NZ, _LEAST_NZ, _MANY, _ROUGH = 0.5, 1e-3, 8, 3.0
# mark of points that have a plane; larger than the mark of any search
_TAKEN = np.iinfo(np.int64).max


@dataclass(frozen=True)
class RoofPlanes:
    """plane: (k, 3). label: int (m,), the plane of each point, -1 for none. neighbour: int (m, n), the nearest points
    of each point, by which planes are beside each other. settings: the settings for the noise of these points."""

    plane: np.ndarray
    label: np.ndarray
    neighbour: np.ndarray
    settings: Detection


def heights(plane: np.ndarray, xy_m: np.ndarray) -> np.ndarray:
    """Heights (m, k) of planes (k, 3) at places (m, 2)."""
    return np.asarray(xy_m @ plane[:, :2].T + plane[:, 2])


def height_over(plane: np.ndarray, label: np.ndarray, xy_m: np.ndarray) -> np.ndarray:
    """Height (m,) of plane ``label`` (m,) at each place (m, 2)."""
    a, b, c = plane.take(label, 0).T
    return np.asarray(a * xy_m[:, 0] + b * xy_m[:, 1] + c)


def distances(plane: np.ndarray, point_m: np.ndarray) -> np.ndarray:
    """Distances (m, k) of points (m, 3) from planes (k, 3), metres."""
    off_m = np.abs(heights(plane, point_m[:, :2]) - point_m[:, 2:])
    return np.asarray(off_m / np.sqrt(1 + (plane[:, :2] ** 2).sum(axis=1)))


@inner
def mean_distance(plane: np.ndarray, point_m: np.ndarray, rows: np.ndarray) -> float:
    """The mean distance of the points (m, 3) in ``rows``, int64 (k,), from a plane (3,); 0 for no points."""
    total_m = 0.0
    for row in rows:
        total_m += _distance(plane, point_m[row])
    return total_m / max(len(rows), 1)


def detect(point_m: np.ndarray, density: float, along: Sequence[float], settings: Detection) -> RoofPlanes:
    """The planes that the points (m, 3) of a roof show, ``density`` of them per square metre. along: directions of the
    footprint, radians; without any, small planes are not sought. Where noise is larger than usual, the points of a
    plane may be further from it.

    Planes grow from the points where the surface is most even. Then the largest plane of the remaining points is taken,
    again and again: a plane that is level, that rises along a direction of the footprint, or that fits the points
    around a point. Where points are sparse, they show no surface around a point: no plane grows, and all planes come
    from this second search. Elsewhere, it takes place only if small planes may have fewer points than a grown plane
    needs. In the end, each point goes to the best plane around it, and each plane is fitted to its points. Two planes
    become one where a single plane is hardly further from the points.
    """
    is_sparse = density < settings.sparse_per_m2
    count = min(settings.num_sparse_neighbours if is_sparse else settings.num_neighbours, len(point_m))
    is_enough = density >= settings.single_per_m2 and len(point_m) <= settings.num_few_points
    min_points = max(1 if is_enough else settings.min_sparse_points, int(settings.min_area_m2 * density))
    point_m = np.ascontiguousarray(point_m, float)
    _, neighbour = nearest(point_m, point_m, count)
    if not is_sparse and _on_lines(point_m, neighbour, settings):
        _, neighbour = nearest(point_m, point_m, min(2 * count, len(point_m)))
    plane, label = np.zeros((0, 3)), np.full(len(point_m), -1)
    normal, rough_m = _surfaces(point_m, neighbour)
    usual, settings = settings, settings.for_noise(_noise_m(rough_m, settings))
    if not is_sparse:
        if settings != usual:
            # noise turns the surface around few points
            _, neighbour = nearest(point_m, point_m, min(2 * neighbour.shape[1], len(point_m)))
            normal, rough_m = _surfaces(point_m, neighbour)
        order = np.argsort(rough_m, kind="stable")
        fewest = max(min_points, settings.min_points)
        plane, label = _grown(point_m, neighbour, normal, rough_m, order, fewest, settings)
    # scattered points, which show no surface, show no small one
    if len(along) and (is_sparse or (len(plane) and min_points < settings.min_points)):
        bearing = np.concatenate([along, np.add(along, np.pi / 2)])
        axis = np.column_stack([np.cos(bearing), np.sin(bearing)])
        near = np.ascontiguousarray(neighbour[:, : settings.num_sparse_neighbours])
        rest, label = _largest(point_m, near, label, axis, min_points, settings)
        plane = np.vstack([plane, rest])
    if len(plane):
        plane, label = _settled(point_m, plane, label, neighbour, settings)
        plane, label = _merged(point_m, plane, label, neighbour, min_points, settings)
    return RoofPlanes(plane, label, neighbour, settings)


def payable(
    point_m: np.ndarray, found: RoofPlanes, plane: np.ndarray, stands_m2: float, prices: PlanePrices
) -> RoofPlanes:
    """``found`` with the planes (k, 3) in place of its own, without the planes that save less than ``least_m3``.

    A plane saves what its points (m, 3) are nearer to it, upright, than to the nearest of the planes of their
    neighbours; distances count up to ``cap_m``. The points of a plane that is left out go to that nearest plane, or to
    none if it is left out as well or further than ``cap_m``. stands_m2: the area that a point stands for."""
    is_kept, label = _paid(point_m, found.neighbour, plane, found.label, stands_m2, prices)
    number = np.append(np.cumsum(is_kept) - 1, -1)
    return RoofPlanes(plane[is_kept], number[label], found.neighbour, found.settings)


@entry
def _paid(
    point_m: np.ndarray,
    neighbour: np.ndarray,
    plane: np.ndarray,
    label: np.ndarray,
    stands_m2: float,
    prices: PlanePrices,
) -> tuple[np.ndarray, np.ndarray]:
    """(whether each plane is kept, labels). Each round drops planes, the one that saves least first, but no two planes
    that are side by side."""
    label, is_kept = label.copy(), np.ones(len(plane), np.bool_)
    saved_m3, is_beside = np.empty(len(plane)), np.empty(len(plane), np.bool_)
    other = np.empty(len(label), np.int64)
    while True:
        saved_m3[:], other[:] = 0.0, -1
        for row in np.flatnonzero(label >= 0):
            best_m = prices.cap_m
            for near in label[neighbour[row]]:
                if near >= 0 and near != label[row]:
                    off_m = abs(_rise(plane[near], point_m[row]))
                    if off_m < best_m:
                        best_m, other[row] = off_m, near
            own_m = min(abs(_rise(plane[label[row]], point_m[row])), prices.cap_m)
            saved_m3[label[row]] += stands_m2 * (best_m - own_m)
        begin, rows = sorted_by(label + 1, len(plane) + 1)
        is_beside[:], num_gone = ~is_kept, 0
        for p in order_of(saved_m3):
            if is_beside[p] or saved_m3[p] >= prices.least_m3:
                continue
            is_kept[p], num_gone = False, num_gone + 1
            for row in rows[begin[p + 1] : begin[p + 2]]:
                for near in label[neighbour[row]]:
                    if near >= 0:
                        is_beside[near] = True
                label[row] = other[row] if other[row] >= 0 and is_kept[other[row]] else -1
        if not num_gone:
            return is_kept, label


@inner
def _rise(plane: np.ndarray, point_m: np.ndarray) -> float:
    """How far a plane (3,) is above a point."""
    return plane[0] * point_m[0] + plane[1] * point_m[1] + plane[2] - point_m[2]


def _on_lines(point_m: np.ndarray, neighbour: np.ndarray, settings: Detection) -> bool:
    """Whether the neighbours (m, k) of many points lie on a single line of the scanner, as the next line is further
    away. Such neighbours show no plane: every plane through the line fits them."""
    rows = every_kth(len(point_m), settings.num_line_samples)
    # neighbour by neighbour, as sums along rows take several times as long
    x, y = (each - each.mean(axis=0) for each in point_m.T[:2, neighbour[rows].T])
    xx, xy, yy = (x * x).sum(axis=0), (x * y).sum(axis=0), (y * y).sum(axis=0)
    across, along = (xx + yy) / 2 + [[-1.0], [1.0]] * np.hypot((xx - yy) / 2, xy)
    return bool(np.mean(across < settings.line_width**2 * along) > settings.line_share)


@allocating
def fit(point_m: np.ndarray, rows: np.ndarray, num: int, noise_m: float) -> np.ndarray:
    """The plane (3,) of the points (m, 3) in the first ``num`` of ``rows``, int64 (k,), by reweighted least squares of
    upright distances, which approximate least absolute residuals. It is level for one or two points. A steep plane is
    that of least distances, as noise in plan would make it less steep: a wall is found to be one, and points along a
    line, which lie on planes of any slope, mostly are no roof."""
    centre = np.zeros(3)
    for t in range(num):
        for k in range(3):
            centre[k] += point_m[rows[t], k] / num
    a = b = c = 0.0
    is_steep, scale = False, 1.0
    for step in range(4 if num > 2 else 0):
        xx = xy = yy = sx = sy = one = xz = yz = sz = zz = 0.0
        for t in range(num):
            x, y = point_m[rows[t], 0] - centre[0], point_m[rows[t], 1] - centre[1]
            z = point_m[rows[t], 2] - centre[2]
            w = 1.0 if step == 0 else 1.0 / max(scale * abs(a * x + b * y + c - z), noise_m)
            xx, xy, yy = xx + w * x * x, xy + w * x * y, yy + w * y * y
            sx, sy, one = sx + w * x, sy + w * y, one + w
            xz, yz, sz, zz = xz + w * x * z, yz + w * y * z, sz + w * z, zz + w * z * z
        xx, yy, zz = xx - sx * sx / one, yy - sy * sy / one, zz - sz * sz / one
        xy, xz, yz = xy - sx * sy / one, xz - sx * sz / one, yz - sy * sz / one
        if step == 0 or is_steep:
            x, y, z, least = _least_axis(xx, xy, xz, yy, yz, zz)
        if step == 0:
            is_steep = num >= _MANY and z < _STEEP_NZ and least < num * (_ROUGH * noise_m) ** 2
        if is_steep:
            scale = max(z, _LEAST_NZ)
            a, b = -x / scale, -y / scale
        else:
            ridge = 1e-9 * num
            determinant = (xx + ridge) * (yy + ridge) - xy * xy
            a, b = (xz * (yy + ridge) - yz * xy) / determinant, (yz * (xx + ridge) - xz * xy) / determinant
        c = (sz - a * sx - b * sy) / one
    return np.array([a, b, c + centre[2] - a * centre[0] - b * centre[1]])


def _noise_m(rough_m: np.ndarray, settings: Detection) -> float:
    """The standard deviation of points about surfaces of roughness ``rough_m`` (m,); 0 for too few points, and where it
    is so large that there is no surface."""
    if len(rough_m) < settings.min_noise_points:
        return 0.0
    noise_m = quantile(rough_m, _EVEN_SHARE) / _EVEN_ROUGHNESS
    return noise_m if noise_m < settings.max_noise_m else 0.0


@inner
def _distance(plane: np.ndarray, point: np.ndarray) -> float:
    """The distance of a point from a plane."""
    return abs(_rise(plane, point)) / np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2)


@inner
def _fewest(plane: np.ndarray, min_points: int, settings: Detection) -> int:
    """The least number of points of a plane. As the smallest area is measured on the slope, a steep plane needs fewer
    than ``min_points``, but no fewer than the lesser of ``min_points`` and ``settings.min_points``."""
    on_slope = int(min_points / np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2))
    return max(min(min_points, settings.min_points), on_slope)


@entry
def _surfaces(point_m: np.ndarray, neighbour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(normals (m, 3), roughness (m,)) of the surface around each point. A normal points upwards. Roughness is the
    standard deviation of the points ``neighbour`` (m, k) along the normal, in metres."""
    normal, rough_m = np.empty(point_m.shape), np.empty(len(point_m))
    count = neighbour.shape[1]
    for row in range(len(point_m)):
        centre = np.zeros(3)
        for other in neighbour[row]:
            for k in range(3):
                centre[k] += point_m[other, k] / count
        xx = xy = xz = yy = yz = zz = 0.0
        for other in neighbour[row]:
            x, y, z = (
                point_m[other, 0] - centre[0],
                point_m[other, 1] - centre[1],
                point_m[other, 2] - centre[2],
            )
            xx, xy, xz = xx + x * x / count, xy + x * y / count, xz + x * z / count
            yy, yz, zz = yy + y * y / count, yz + y * z / count, zz + z * z / count
        normal[row, 0], normal[row, 1], normal[row, 2], least = _least_axis(xx, xy, xz, yy, yz, zz)
        rough_m[row] = np.sqrt(max(least, 0.0))
    return normal, rough_m


@inner
def _least_axis(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float]:
    """(x, y, z, least): the unit vector, upwards, along which points of this covariance matrix vary least, and the
    least eigenvalue, a root of a cubic (Smith, Eigenvalues of a symmetric 3 x 3 matrix, 1961)."""
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    size = max(np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6), 1e-12)
    half = (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) / (2 * size**3)
    turn = np.arccos(min(max(half, -1.0), 1.0)) / 3
    least = mean + 2 * size * np.cos(turn + 2 * np.pi / 3)
    a, b, c = xx - least, yy - least, zz - least
    best, along = -1.0, (0.0, 0.0, 1.0)
    # cross products of two rows are all along the eigenvector; the longest one is the most exact
    for x, y, z in (
        (xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy),
        (xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz),
        (b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz),
    ):
        length = np.sqrt(x * x + y * y + z * z)
        if length > best:
            best, sign = length, -1.0 if z < 0 else 1.0
            along = (sign * x, sign * y, sign * z)
    best = max(best, 1e-300)
    return along[0] / best, along[1] / best, along[2] / best, least


@entry
def _grown(
    point_m: np.ndarray,
    neighbour: np.ndarray,
    normal: np.ndarray,
    rough_m: np.ndarray,
    order: np.ndarray,
    min_points: int,
    settings: Detection,
) -> tuple[np.ndarray, np.ndarray]:
    """(planes (k, 3), label (m,)): from each point without a plane, in ``order``, a plane grows as far as it goes."""
    num = len(point_m)
    label, seen = np.full(num, -1), np.full(num, -1)
    plane, num_planes = np.empty((num // min(min_points, settings.min_points) + 1, 3)), 0
    rows = np.empty(num + neighbour.shape[1], np.int64)
    min_along = np.cos(np.radians(settings.angle_deg))
    least_z = 1 / np.sqrt(1 + settings.steepest**2)
    for seed in order:
        if label[seed] >= 0 or normal[seed, 2] < least_z:
            continue
        count = _free(neighbour[seed], label, rows)
        if count < neighbour.shape[1] // 2:
            continue
        current = fit(point_m, rows, count, settings.noise_m)
        rows[0], count, seen[seed], reached, next_fit = seed, ZERO + 1, seed, 0, min_points
        while reached < count:
            row, reached = rows[reached], reached + 1
            length = np.sqrt(1 + current[0] ** 2 + current[1] ** 2)
            for other in neighbour[row]:
                if seen[other] == seed or label[other] >= 0:
                    continue
                along = normal[other, 2] - current[0] * normal[other, 0] - current[1] * normal[other, 1]
                is_along = along > min_along * length or rough_m[other] > settings.rough_m
                if is_along and _distance(current, point_m[other]) < settings.distance_m:
                    seen[other], rows[count], count = seed, other, count + 1
            if count >= next_fit:
                current, next_fit = fit(point_m, rows, count, settings.noise_m), count + count // 2
        least = _fewest(current, min_points, settings)
        if count < least:
            continue
        current, near = fit(point_m, rows, count, settings.noise_m), ZERO
        for t in range(count):
            if _distance(current, point_m[rows[t]]) < settings.distance_m:
                rows[near], near = rows[t], near + 1
        if near >= least:
            for t in range(near):
                label[rows[t]] = num_planes
            plane[num_planes] = fit(point_m, rows, near, settings.noise_m)
            num_planes += 1
    return plane[:num_planes].copy(), label


@entry
def _largest(
    point_m: np.ndarray,
    neighbour: np.ndarray,
    label: np.ndarray,
    axis: np.ndarray,
    min_points: int,
    settings: Detection,
) -> tuple[np.ndarray, np.ndarray]:
    """(further planes (k, 3), label (m,)). Only points without a plane count. Of the planes at these points
    (:func:`_planes_at`), the one with the best score of connected points is taken, then the best one for the points
    that remain, and so on."""
    num, num_near = neighbour.shape
    label, first = label.copy(), label.max() + 1
    seen = np.full(num, _TAKEN)
    seen[label < 0] = -1
    plane, num_planes = np.empty((num // min_points + 1, 3)), 0
    rows, best_rows = np.empty(num, np.int64), np.empty(num, np.int64)
    num_trials, min_slope_points = 0, max(min_points, settings.min_slope_points)
    # points with too few free points around them; of very many points, also those from which no plane was found
    is_tried = np.zeros(num, np.bool_)
    for row in range(num):
        is_tried[row] = _free(neighbour[row], label, rows) < min(min_points, num_near)
    while True:
        left = np.flatnonzero(label < 0)
        free = left[~is_tried[left]]
        num_seeds = max(1, min(settings.num_seeds, settings.max_seed_points // max(len(free), 1)))
        best_score, best_count = 0.0, ZERO
        seeds = free[:: len(free) // num_seeds + 1]
        for seed in seeds:
            trials = _planes_at(seed, point_m, neighbour[seed], label, axis, settings)
            for t in range(len(trials)):
                a, b, c = trials[t]
                # a bound that is quick to compute: the score of all points near to the plane, connected or not
                k, score, scale = 0, _ROUNDING, 1 / ((1 + a**2 + b**2) * settings.distance_m**2)
                while k < len(left) and score <= best_score:
                    off_m = a * point_m[left[k], 0] + b * point_m[left[k], 1] + c - point_m[left[k], 2]
                    k, score = k + 1, score + max(1.0 - off_m * off_m * scale, 0.0)
                if score <= best_score:
                    continue
                rows[0], num_trials = seed, num_trials + 1
                count, score = _connected(trials[t], point_m, neighbour, rows, seen, num_trials, settings)
                least = min_points if a == 0 and b == 0 else min_slope_points
                if score > best_score and count >= least:
                    best_score, best_count = score, count
                    best_rows[:count] = rows[:count]
        if best_count == 0:
            if len(free) <= settings.max_seed_points // settings.num_seeds:
                return plane[:num_planes].copy(), label
            is_tried[seeds] = True
            continue
        # a roof that rises a little beside the axis, or bends, goes on along the plane of its points
        current = fit(point_m, best_rows, best_count, settings.noise_m)
        while best_count >= settings.min_points:
            rows[0], num_trials = best_rows[0], num_trials + 1
            count, _ = _connected(current, point_m, neighbour, rows, seen, num_trials, settings)
            if count <= best_count:
                break
            best_count = count
            best_rows[:count] = rows[:count]
            current = fit(point_m, best_rows, best_count, settings.noise_m)
        label[best_rows[:best_count]], seen[best_rows[:best_count]] = first + num_planes, _TAKEN
        plane[num_planes], num_planes = current, num_planes + 1


@inner
def _free(beside: np.ndarray, label: np.ndarray, rows: np.ndarray) -> int:
    """The number of the points in ``beside`` that have no plane. They are the first of ``rows`` afterwards."""
    count = ZERO
    for other in beside:
        if label[other] < 0:
            rows[count], count = other, count + 1
    return count


@allocating
def _planes_at(
    seed: int,
    point_m: np.ndarray,
    beside: np.ndarray,
    label: np.ndarray,
    axis: np.ndarray,
    settings: Detection,
) -> np.ndarray:
    """Trial planes (k, 3) at the point ``seed``: the level plane through it; the planes through it that rise along an
    ``axis`` (a, 2) to a point ``beside`` it; and the plane of the points beside it that have no plane, which may rise
    in any direction."""
    plane, num, rows = np.empty((len(beside) * len(axis) + 2, 3)), ZERO + 1, np.empty(len(beside), np.int64)
    plane[0, 0], plane[0, 1], plane[0, 2] = 0.0, 0.0, point_m[seed, 2]
    for other in beside:
        x, y = point_m[other, 0] - point_m[seed, 0], point_m[other, 1] - point_m[seed, 1]
        rise_m = point_m[other, 2] - point_m[seed, 2]
        for along in axis:
            run_m = along[0] * x + along[1] * y
            if abs(run_m) >= settings.min_run_m and abs(rise_m) <= settings.steepest * abs(run_m):
                a, b = rise_m / run_m * along[0], rise_m / run_m * along[1]
                plane[num, 0], plane[num, 1] = a, b
                plane[num, 2], num = point_m[seed, 2] - a * point_m[seed, 0] - b * point_m[seed, 1], num + 1
    count = _free(beside, label, rows)
    if count >= settings.min_slope_points:
        around = fit(point_m, rows, count, settings.noise_m)
        if np.hypot(around[0], around[1]) <= settings.steepest:
            plane[num], num = around, num + 1
    return plane[:num].copy()


@inner
def _connected(
    plane: np.ndarray,
    point_m: np.ndarray,
    neighbour: np.ndarray,
    rows: np.ndarray,
    seen: np.ndarray,
    mark: int,
    settings: Detection,
) -> tuple[int, float]:
    """(number, score) of the points near to a plane (3,) that are connected to the first of ``rows``. They are the
    first of ``rows`` afterwards. Points whose ``seen`` is ``mark`` or more are skipped; visited points get ``mark``."""
    length = np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2)
    count, seen[rows[0]], reached, score = ZERO + 1, mark, 0, 1.0
    while reached < count:
        row, reached = rows[reached], reached + 1
        for near in neighbour[row]:
            if seen[near] >= mark:
                continue
            # near to the plane or not, once is enough
            seen[near] = mark
            off_m = abs(_rise(plane, point_m[near])) / length
            if off_m < settings.distance_m:
                score += 1.0 - (off_m / settings.distance_m) ** 2
                rows[count], count = near, count + 1
    return count, score


@entry
def _settled(
    point_m: np.ndarray, plane: np.ndarray, label: np.ndarray, neighbour: np.ndarray, settings: Detection
) -> tuple[np.ndarray, np.ndarray]:
    """(planes, label) after points and planes have settled in turns: each point goes to the nearest of its own plane
    and the planes of its neighbours, then each plane is fitted to its points. This separates the planes of two low
    slopes that grew over the ridge between them."""
    plane = plane.copy()
    for turn in range(settings.num_turns):
        before, label = label, label.copy()
        for row, number in enumerate(before):
            least_m = _distance(plane[number], point_m[row]) if number >= 0 else settings.distance_m
            for other in before[neighbour[row]]:
                if other != number:
                    near_m = _distance(plane[other], point_m[row]) if other >= 0 else settings.distance_m
                    if near_m < least_m:
                        least_m, label[row] = near_m, other
        begin, order = sorted_by(label + 1, len(plane) + 1)
        for number in range(len(plane) if turn < settings.num_turns - 1 else 0):
            rows = order[begin[number + 1] : begin[number + 2]]
            if len(rows) > 2:
                plane[number] = fit(point_m, rows, len(rows), settings.noise_m)
    return plane, label


@entry
def _merged(
    point_m: np.ndarray,
    plane: np.ndarray,
    label: np.ndarray,
    neighbour: np.ndarray,
    min_points: int,
    settings: Detection,
) -> tuple[np.ndarray, np.ndarray]:
    """(planes, label) after similar planes side by side have become one, the most similar pair first. Planes of too few
    points and planes that are too steep are left out."""
    num, label = len(plane), label.copy()
    # the points of each plane; none for a plane that has become a part of another
    begin, order = sorted_by(label + 1, num + 1)
    rows_of = [order[begin[i + 1] : begin[i + 2]] for i in range(num)]
    residual_m = np.array([mean_distance(plane[i], point_m, rows_of[i]) for i in range(num)])
    link, num_links = np.empty(neighbour.size, np.int64), 0
    for row, number in enumerate(label):
        for other in label[neighbour[row]]:
            if min(number, other) >= 0 and number != other:
                link[num_links] = min(number, other) * num + max(number, other)
                num_links += 1
    link = ascending(link[:num_links])
    # pairs of planes that touch in three pairs of points or more; ``worse_m``: how much further the points are from the
    # joint plane than from their own
    is_pair = np.zeros(num_links, np.bool_)
    is_pair[: max(num_links - 2, 0)] = link[: max(num_links - 2, 0)] == link[2:]
    is_pair[1:] &= link[1:] != link[:-1]
    pair = link[is_pair]
    worse_m, joint, is_new = (
        np.full(len(pair), np.inf),
        np.zeros((len(pair), 3)),
        np.ones(len(pair), np.bool_),
    )
    while len(pair):
        for new in np.flatnonzero(is_new):
            i, j = pair[new] // num, pair[new] % num
            rows = np.concatenate((rows_of[i], rows_of[j]))
            joint[new], is_new[new] = fit(point_m, rows, len(rows), settings.noise_m), False
            worse_m[new] = max(
                mean_distance(joint[new], point_m, rows_of[i]) - residual_m[i],
                mean_distance(joint[new], point_m, rows_of[j]) - residual_m[j],
            )
        best = worse_m.argmin()
        if not worse_m[best] <= settings.simpler_m:
            break
        one, other = pair[best] // num, pair[best] % num
        label[rows_of[other]], worse_m[best] = one, np.inf
        rows_of[one], rows_of[other] = (
            ascending(np.concatenate((rows_of[one], rows_of[other]))),
            rows_of[other][:0],
        )
        residual_m[one] = mean_distance(joint[best], point_m, rows_of[one])
        for k in range(len(pair)):
            i, j = pair[k] // num, pair[k] % num
            if k != best and worse_m[k] < np.inf and (i in (one, other) or j in (one, other)):
                ends = (one if i == other else i), (one if j == other else j)
                moved = min(ends) * num + max(ends)
                # if both planes touched a third one, keep a single pair with it
                is_new[k] = not (pair[:k][worse_m[:k] < np.inf] == moved).any()
                pair[k], worse_m[k] = moved, 0.0 if is_new[k] else np.inf
    result, num_roofs, new_label = np.empty((num, 3)), 0, np.full(len(label), -1)
    for rows in rows_of:
        if len(rows):
            result[num_roofs] = fit(point_m, rows, len(rows), settings.noise_m)
            is_large = len(rows) >= _fewest(result[num_roofs], min_points, settings)
            if is_large and np.hypot(result[num_roofs, 0], result[num_roofs, 1]) < settings.steepest:
                new_label[rows], num_roofs = num_roofs, num_roofs + 1
    return result[:num_roofs].copy(), new_label
