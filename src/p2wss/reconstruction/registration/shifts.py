"""Where a block of footprints lies in the cloud.

Points of class building should be inside a block, all others outside. A search over a grid of shifts finds the place
where this holds best (:func:`search_shift`). Around it, each free edge has a step along its normal from building to
ground (:func:`edge_steps`). The shift follows from all steps of the block (:func:`solve_shift`).
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import count
from typing import NamedTuple

import numpy as np

from p2wss.clouds.cropping import crop_points
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS, WATER_CLASS, has_class
from p2wss.skeleton.compiled import allocating, entry
from p2wss.skeleton.types import Polygons

# the largest shift, and the depth of the strip on either side of an edge
MAX_SHIFT_M, WINDOW_M = 3.0, 1.25
# distance from the edge within which points beyond a step show that the data do not end there
DATA_M = 4.0
# weights are halves, so sums of them that differ by less are equal
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Search:
    """The search over a grid of shifts. Numbers of points are chosen so that single points on chimneys, on hedges and
    beside walls decide nothing.

    other_weight: the weight of a point that is neither on a building (1) nor on the ground (-1). cell_m, max_cells: the
    step between shifts; it grows where there would be more cells than this. as_good_points, as_good_share: shifts count
    as the best if their sum of weights is less than the largest by at most this, or by this share of all weights.
    """

    other_weight: float = -0.5
    cell_m: float = 0.25
    max_cells: int = 1 << 18
    as_good_points: float = 2.0
    as_good_share: float = 0.005


@dataclass(frozen=True)
class StepRules:
    """The step of an edge. Chosen on real places with blocks moved by known vectors (``benchmarks/registration.py``).

    end_m: part at either end of the edge that is not used, because the points there may belong to the next wall.
    min_edge_m: shorter edges have no step. min_gain_points, min_gain_share: a step is clear if the weights inside it
    exceed the weights of the whole strip, and those of an empty strip, by at least so many points, and by this share of
    the smaller one of the sums of positive and negative weights, as a tree may hide where the roof ends. sd_m: standard
    deviation of a step, from the accuracy of footprints and points. as_good_points: places count as the step if the
    weights inside are less than the largest by at most this; the extent of these places adds to the deviation.
    min_beyond_share: the data do not end at a step if the points beyond it are more than this share of the points in
    the strip. num_rounds: rounds in which edges are moved by the shift found before, as further steps may then be in
    reach.
    """

    end_m: float = 0.3
    min_edge_m: float = 1.0
    min_gain_points: float = 2.0
    min_gain_share: float = 0.5
    sd_m: float = 0.1
    as_good_points: float = 1.0
    min_beyond_share: float = 0.2
    num_rounds: int = 2


class Expected(NamedTuple):
    """What is expected before the steps are used, and how far they are trusted.

    shift_sd_m: of the shift, expected as 0. overhang_m, overhang_sd_m: roofs overhang walls by some decimetres.
    block_sd_m: the error that all steps of a block share, since maps are inaccurate and roofs overhang one side more
    than the other. half_weight_m: a step with this residual has half its weight (Cauchy); the weights settle in
    ``num_rounds``. rest_of_prior: information (1/m2) on the shift that is left when its prior is taken out of the
    covariance, as the matrix would be singular if no edge determined a direction. max_left_out: at most this many edges
    of a block are left out one by one.
    """

    shift_sd_m: float = 1.0
    overhang_m: float = 0.1
    overhang_sd_m: float = 0.3
    block_sd_m: float = 0.1
    half_weight_m: float = 0.25
    num_rounds: int = 8
    rest_of_prior: float = 1e-6
    max_left_out: int = 64


SEARCH, STEP, EXPECTED = Search(), StepRules(), Expected()
# where eaves may be far wider than expected
_ANY_OVERHANG = EXPECTED._replace(overhang_sd_m=1.0)


@dataclass(frozen=True)
class Estimate:
    """The shift of a block as its own edges show it.

    shift_m: (2,). sd_m: its standard deviation in the less certain direction, in the worst case that one edge, or the
    expected overhang, misleads; infinite without steps. overhang_m: how far the roof reaches beyond the edges.
    """

    shift_m: np.ndarray
    sd_m: float
    overhang_m: float


# the estimate of a block whose edges show nothing
NO_ESTIMATE = Estimate(np.zeros(2), float("inf"), float("nan"))


def point_weights(classification: np.ndarray) -> np.ndarray:
    """float64 (n,): how much each point speaks for a building: 1 on a building, -1 on the ground, -0.5 elsewhere."""
    weight = np.full(len(classification), SEARCH.other_weight)
    weight[has_class(classification, (GROUND_CLASS, WATER_CLASS))] = -1.0
    weight[classification == BUILDING_CLASS] = 1.0
    return weight


def search_shift(edge: np.ndarray, xy_m: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The shift of a polygon under which the weights inside it have the largest sum.

    edge: (e, 4), ends of all edges of the polygon. xy_m: (n, 2), points up to ``MAX_SHIFT_M`` around it. weight: (n,).
    Returns the mean (2,) of the shifts whose sum is nearly the largest; without points, no shift.
    """
    if not len(xy_m):
        return np.zeros(2)  # a map of a country has many buildings beyond the cloud
    low = edge.reshape(-1, 2).min(axis=0) - MAX_SHIFT_M
    extent = edge.reshape(-1, 2).max(axis=0) + MAX_SHIFT_M - low
    cell_m = max(SEARCH.cell_m, float(np.sqrt(extent.prod() / SEARCH.max_cells)))
    reach = int(MAX_SHIFT_M / cell_m)
    columns, rows = (np.ceil(extent / cell_m).astype(int) + 1).tolist()
    cell = np.floor((xy_m - low) / cell_m).astype(np.int64)
    keep = ((cell >= 0) & (cell < [columns, rows])).all(axis=1)
    index = cell[keep, 1] * columns + cell[keep, 0]
    weights = np.bincount(index, weight[keep], rows * columns).reshape(rows, columns)
    inside = _rasterised((edge - np.tile(low, 2)) / cell_m, rows, columns)
    # transforms are fast where the length has no prime factors but 2, 3 and 5
    shape = [next(n for n in count(each + reach) if pow(30, 20, n) == 0) for each in (rows, columns)]
    spectrum = np.fft.rfft2(weights, shape) * np.conj(np.fft.rfft2(inside, shape))
    total = np.fft.irfft2(spectrum, shape)
    steps = np.arange(-reach, reach + 1)
    dx, dy, is_far = _shifts_m(reach, cell_m)
    # the weights are halves; the transform is not exact
    total = np.round(2 * total[steps[:, None], steps]) / 2
    total[is_far] = -np.inf
    # with an overhang, all shifts up to its length are as good
    as_good = total >= total.max() - max(
        SEARCH.as_good_points, SEARCH.as_good_share * float(np.abs(weight[keep]).sum())
    )
    return np.array([dx[as_good].mean(), dy[as_good].mean()])


@lru_cache(8)
def _shifts_m(reach: int, cell_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, whether it is longer than ``MAX_SHIFT_M``) of all shifts by up to ``reach`` whole cells, as square
    matrices with y growing by rows."""
    steps = np.arange(-reach, reach + 1) * cell_m
    dy, dx = np.meshgrid(steps, steps, indexing="ij")
    return dx, dy, dx**2 + dy**2 > MAX_SHIFT_M**2


def _rasterised(edge: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """float64 (rows, columns): 1 for cells with the centre inside the polygon of edges (even-odd rule), else 0."""
    x0, y0, x1, y1 = edge.T - 0.5
    first = np.ceil(np.minimum(y0, y1)).astype(np.int64)
    count = np.ceil(np.maximum(y0, y1)).astype(np.int64) - first
    of_edge = np.repeat(np.arange(len(edge)), count)
    row = np.arange(len(of_edge)) - np.repeat(np.cumsum(count) - count, count) + first[of_edge]
    slope = (x1 - x0) / np.where(y1 == y0, 1.0, y1 - y0)
    column = np.ceil(x0[of_edge] + (row - y0[of_edge]) * slope[of_edge]).astype(np.int64)
    crossings = np.bincount(row * (columns + 1) + np.clip(column, 0, columns), minlength=rows * (columns + 1))
    return (np.cumsum(crossings.reshape(rows, columns + 1), axis=1)[:, :columns] & 1).astype(float)


def strips(edge: np.ndarray) -> Polygons:
    """A rectangle over each edge (e, 4), from ``WINDOW_M`` inside to ``DATA_M`` outside; empty for short edges."""
    start, end = edge[:, :2], edge[:, 2:]
    length = np.linalg.norm(end - start, axis=1)
    is_long = np.flatnonzero(length >= STEP.min_edge_m)
    along = (end - start)[is_long] / length[is_long, None]
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    first, last = start[is_long] + STEP.end_m * along, end[is_long] - STEP.end_m * along
    outside, inside = DATA_M * normal, WINDOW_M * normal
    corner = np.stack([first + outside, last + outside, last - inside, first - inside], axis=1)
    num_rings = np.zeros(len(edge) + 1, np.int64)
    num_rings[is_long + 1] = 1
    return Polygons(corner.reshape(-1, 2), np.arange(len(is_long) + 1) * 4, np.cumsum(num_rings))


def edge_steps(
    edge: np.ndarray, x_m: np.ndarray, y_m: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(the step of each edge, (e,), its standard deviation, (e,)): where the building ends, measured from the edge
    along its outward normal, by the points in the strip over the edge. NaN where the points do not show a step.

    edge: (e, 4), counter-clockwise around the block, so that the outside is on the right. weight: (n,), 1 for a point
    on a building, negative outside, 0 for a point that says nothing.
    """
    point, _, offset = crop_points(x_m, y_m, strips(edge), 0.0)
    of_edge = np.repeat(np.arange(len(edge)), np.diff(offset))
    along = edge[:, 2:] - edge[:, :2]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    distance = (x_m[point] - edge[of_edge, 0]) * along[of_edge, 1]
    distance -= (y_m[point] - edge[of_edge, 1]) * along[of_edge, 0]
    near = np.flatnonzero(distance <= WINDOW_M)
    strip = near[np.lexsort([weight[point[near]], distance[near], of_edge[near]])]
    offset_m, sd_m = _steps(of_edge[strip], distance[strip], weight[point[strip]], len(edge))
    # where the data end, nothing shows that the building ends
    num_in_strip = np.bincount(of_edge[strip], minlength=len(edge))
    num_beyond = np.bincount(of_edge[distance > offset_m[of_edge]], minlength=len(edge))
    return np.where(num_beyond > num_in_strip * STEP.min_beyond_share, offset_m, np.nan), sd_m


def _steps(
    of_edge: np.ndarray, distance: np.ndarray, value: np.ndarray, num_edges: int
) -> tuple[np.ndarray, np.ndarray]:
    """The steps from points sorted by edge and distance, and their deviations."""
    offset_m, sd_m = np.full((2, num_edges), np.nan)
    # from here on, arrays are of the edges with points only
    edges, start, of_point, count = np.unique(
        of_edge, return_index=True, return_inverse=True, return_counts=True
    )
    running = np.cumsum(value)
    before = np.concatenate([[0.0], running])[start]
    score = running - before[of_point]  # the weights inside a step just behind each point
    best = np.maximum.reduceat(score, start)
    total = score[start + count - 1]
    at_best = np.where(score >= best[of_point] - _ROUNDING, np.arange(len(score)), len(score))
    last = np.minimum.reduceat(at_best, start)
    positive = np.bincount(of_point, np.maximum(value, 0))
    negative = np.bincount(of_point, np.maximum(-value, 0))
    least = np.maximum(STEP.min_gain_points, STEP.min_gain_share * np.minimum(positive, negative))
    is_clear = np.minimum(best, best - total) >= least
    rows, last = edges[is_clear], last[is_clear]
    lower = distance[last]
    beyond = np.minimum(last + 1, len(distance) - 1)
    upper = np.where(of_edge[beyond] == rows, distance[beyond], WINDOW_M)
    spacing = 1.0 / np.maximum(count[is_clear] / (2 * WINDOW_M), 1.0)
    offset_m[rows] = lower + np.minimum((upper - lower) / 2, spacing)
    # a step just behind a point may be anywhere up to the next one
    is_good = score >= best[of_point] - STEP.as_good_points
    lowest = np.minimum.reduceat(np.where(is_good, distance, np.inf), start)
    nearest = np.where(np.append(of_edge[1:] == of_edge[:-1], False), np.append(distance[1:], 0.0), WINDOW_M)
    highest = np.maximum.reduceat(np.where(is_good, nearest, -np.inf), start)
    sd_m[edges] = np.sqrt(STEP.sd_m**2 + (highest - lowest) ** 2 / 12)
    return offset_m, sd_m


def solve_shift(edge: np.ndarray, step_m: np.ndarray, step_sd_m: np.ndarray, start_m: np.ndarray) -> Estimate:
    """The shift of one block from the steps of its edges, by robust least squares.

    The step of an edge is the shift along its normal, plus an overhang that all edges share.

    edge: ends of the edges, (e, 4), metres, already with the shift ``start_m``, (2,), which is part of the result.
    step_m, step_sd_m: (e,), the steps of these edges; NaN for an edge without a step.
    """
    rows = np.flatnonzero(np.isfinite(step_m))
    if not len(rows):
        return NO_ESTIMATE
    along = edge[rows, 2:] - edge[rows, :2]
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    design = np.column_stack([normal, np.ones(len(rows))])
    observed = (design, step_m[rows], step_sd_m[rows])
    (value,), (covariance,) = _solved(*observed, np.array([-1]), EXPECTED)
    # the edges that the others can replace least
    least = np.argsort(-(design @ covariance * design).sum(axis=1), kind="stable")[: EXPECTED.max_left_out]
    without_edge = _solved(*observed, least, EXPECTED)
    # the expected overhang must not decide either, where only one side of the block is seen
    without_overhang = _solved(*observed, np.array([-1]), _ANY_OVERHANG)
    values, covariances = (np.concatenate(each) for each in zip(without_edge, without_overhang, strict=True))
    change_m = (values - value)[:, :2]
    # steps that disagree more than expected make the whole estimate less certain
    off_m = step_m[rows] - design @ value
    weighted = (off_m / step_sd_m[rows]) ** 2 / (1 + (off_m / EXPECTED.half_weight_m) ** 2)
    excess = max(1.0, float(weighted.sum()) / max(len(rows) - 2, 1))
    worst = excess * covariances[:, :2, :2] + change_m[:, :, None] * change_m[:, None, :]
    variance_m2 = np.linalg.eigvalsh(worst)[:, -1].max() + EXPECTED.block_sd_m**2
    # roofs do not end inside walls: a negative overhang is from decks along two sides, which look like a shift
    variance_m2 += min(value[2], 0.0) ** 2
    return Estimate(start_m + value[:2], float(np.sqrt(variance_m2)), float(value[2]))


@entry
def _solved(
    design: np.ndarray, step_m: np.ndarray, sd_m: np.ndarray, left_out: np.ndarray, expected: Expected
) -> tuple[np.ndarray, np.ndarray]:
    """(shift and overhang (m, 3), their covariance without the prior of the shift (m, 3, 3)): m solutions, each without
    one of n edges. design: (n, 3). step_m, sd_m: (n,), of the steps. left_out: (m,), the edge left out, -1 for none."""
    value, covariance = np.zeros((len(left_out), 3)), np.empty((len(left_out), 3, 3))
    prior, matrix, right = np.zeros(3), np.empty((3, 3)), np.empty(3)
    prior[:2], prior[2] = 1 / expected.shift_sd_m**2, 1 / expected.overhang_sd_m**2
    for k in range(len(left_out)):
        for turn in range(expected.num_rounds):
            matrix[:], right[:] = np.diag(prior), 0.0
            right[2] = prior[2] * expected.overhang_m
            for edge in range(len(step_m)):
                off_m = step_m[edge]
                for a in range(3):
                    off_m -= design[edge, a] * value[k, a]
                robust = 1 / (1 + (off_m / expected.half_weight_m) ** 2) if turn else 1.0
                weight = robust / sd_m[edge] ** 2 if edge != left_out[k] else 0.0
                for a in range(3):
                    right[a] += weight * design[edge, a] * step_m[edge]
                    for b in range(3):
                        matrix[a, b] += weight * design[edge, a] * design[edge, b]
            inverse = _inverse(matrix)
            for a in range(3):
                value[k, a] = (inverse[a] * right).sum()
        for a in range(2):
            matrix[a, a] -= prior[a] - expected.rest_of_prior
        covariance[k] = _inverse(matrix)
    return value, covariance


@allocating
def _inverse(matrix: np.ndarray) -> np.ndarray:
    """The inverse of a symmetric matrix (3, 3)."""
    (a, b, c), (_, d, e), (_, _, f) = matrix
    result = np.empty((3, 3))
    result[0] = d * f - e * e, c * e - b * f, b * e - c * d
    result[1] = c * e - b * f, a * f - c * c, b * c - a * e
    result[2] = b * e - c * d, b * c - a * e, a * d - b * b
    return result / (a * result[0, 0] + b * result[0, 1] + c * result[0, 2])
