"""Registration: footprints moved to where the cloud shows the buildings, block by block.

Each block of footprints that share walls has one shift (:mod:`p2wss.reconstruction.registration.shifts`). The shift is
used only where the evidence of the points is clear, and is combined with the shifts of the blocks around. A block
without clear evidence gets the shift of the blocks around if they agree. So a block's shift depends only on the blocks
around, on the points around, and on the blocks that compete for these points. Where a producer gave many roof points of
a block another class than building, such points do not count as outside.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely

from p2wss.clouds.cropping import crop_points
from p2wss.clouds.reading import Cloud
from p2wss.data import polygon_arrays, reasons
from p2wss.reconstruction.registration.blocks import Blocks, connected, find_blocks
from p2wss.reconstruction.registration.footprint_flags import contradictions, on_raised_ground
from p2wss.reconstruction.registration.shifts import (
    DATA_M,
    EXPECTED,
    MAX_SHIFT_M,
    NO_ESTIMATE,
    SEARCH,
    STEP,
    Estimate,
    edge_steps,
    point_weights,
    search_shift,
    solve_shift,
)
from p2wss.reconstruction.running.failures import note, surviving
from p2wss.skeleton.types import distinct, numbered
from p2wss.storage.features import Features

# footprints this near compete for roofs outside of both: twice the reach of the flags, plus twice the reach of shifts
_BESIDE_M = 20.0
# blocks this near to a block show its shift
_AROUND_M = 50.0
# points this far from a block matter to it: the largest shift, the strip beyond an edge, and a cell of the search
REACH_M = MAX_SHIFT_M + DATA_M + SEARCH.cell_m
EDGES, AROUND, NOTHING = "edges", "around", "none"
# int8: whether a footprint may be moved, and by which classes of points: none, p2wss's own for all points, p2wss's own
# for all but ground, or the producer's
STAYS, OWN_CLASSES, OWN_BUILDINGS, CLASSES = range(4)
# the least evidence with which a flag is set; :data:`CLASSES` for all others, because without the producer's classes,
# ground and roof are told apart by the footprints
_FLAGGED = {
    reasons.BEYOND_POINTS: OWN_CLASSES,
    reasons.RAISED_GROUND: OWN_CLASSES,
    reasons.NO_BUILDING: OWN_BUILDINGS,
}


def like_roofs(
    x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray, is_roof: np.ndarray, is_other: np.ndarray
) -> np.ndarray:
    """bool (n,): which of the points ``is_other`` are at the heights of the roof points in the same cell of 1 m."""
    column, row = np.floor(x_m).astype(np.int64), np.floor(y_m).astype(np.int64)
    cells, cell = numbered((row << 31) + column)
    low_m, high_m = np.full(len(cells), np.inf), np.full(len(cells), -np.inf)
    np.minimum.at(low_m, cell[is_roof], z_m[is_roof] - EVIDENCE.tolerance_m)
    np.maximum.at(high_m, cell[is_roof], z_m[is_roof] + EVIDENCE.tolerance_m)
    return np.asarray(is_other & (z_m >= low_m[cell]) & (z_m <= high_m[cell]))


def with_missed_roofs(
    blocks: Blocks, x_m: np.ndarray, y_m: np.ndarray, is_roof: np.ndarray, is_like: np.ndarray
) -> np.ndarray:
    """bool (blocks,): whether a block has many points like roofs (:func:`like_roofs`) well inside its outlines."""
    inner = shapely.buffer(polygon_arrays.to_geometries(blocks.outline), -EVIDENCE.inside_m)
    parts, of_part = shapely.get_parts(inner, return_index=True)
    point, _, offset = crop_points(x_m, y_m, polygon_arrays.to_polygons(parts), 0.0)
    block = blocks.of_outline[np.repeat(of_part, np.diff(offset))]
    num_like, num_roof = (
        np.bincount(block[mask[point]], minlength=len(blocks)) for mask in (is_like, is_roof)
    )
    return np.asarray(
        num_like >= np.fmax(EVIDENCE.min_like_points, EVIDENCE.min_like_share * (num_like + num_roof))
    )


@dataclass(frozen=True)
class Evidence:
    """Which evidence moves a block. Chosen on real places with all, half and a seventh of the points, and with blocks
    displaced by known vectors, so that a block in place stays there (``benchmarks/registration.py``).

    max_sd_m: evidence is clear if the standard deviation is at most this. min_shift_m, min_sigmas: a shift is used if
    it has at least this length, and at least this many standard deviations; one misleading edge shifts a block by less
    than one. max_sigmas_apart: the blocks around count if their shift differs from the block's by at most this many.

    inside_m: this far inside its outlines, a block has no walls, and no trees even if it is displaced by as much.
    tolerance_m: a roof may reach this far below and above its points in a cell of 1 m. min_like_points, min_like_share:
    the roofs of a block were missed if it has at least this number of points like roofs, and this share of all points
    inside that are roofs or like roofs. In eight places whose classes are good, blocks have at most 0.6 %, and 4.5 % if
    their footprints are moved by 1.5 m under trees.
    """

    max_sd_m: float = 0.5
    min_shift_m: float = 0.3
    min_sigmas: float = 1.25
    max_sigmas_apart: float = 2.0
    inside_m: float = 1.0
    tolerance_m: float = 0.3
    min_like_points: int = 5
    min_like_share: float = 0.1


EVIDENCE = Evidence()
# for points that p2wss itself classified, which takes trees and decks for roofs
OWN_EVIDENCE = Evidence(min_shift_m=0.7, min_sigmas=2.0)


@dataclass(frozen=True)
class Shifts:
    """The movement of n blocks.

    shift_m: (n, 2). sd_m: (n,), the larger standard deviation of the shift; NaN without evidence. source: object (n,),
    :data:`EDGES`, :data:`AROUND` or :data:`NOTHING`. overhang_m: (n,), how far roofs reach beyond the footprints, NaN
    without evidence of the edges.
    """

    shift_m: np.ndarray
    sd_m: np.ndarray
    source: np.ndarray
    overhang_m: np.ndarray


@dataclass(frozen=True)
class Registration:
    """What registration did to a footprint.

    input_polygon: the footprint before. shift_m: its movement. shift_sd_m: the standard deviation of the shift in its
    worse direction; None without evidence. source: :data:`EDGES`, :data:`AROUND` or :data:`NOTHING`. overhang_m: how
    far the roofs of the block reach beyond its edges, negative where they end inside; None without evidence of edges.
    flags, ground_inside_m2, roof_outside_m2: how the cloud contradicts the moved footprint
    (:mod:`p2wss.reconstruction.registration.footprint_flags`). block: the least id of the footprints of its block; ""
    for a footprint that was excluded.
    """

    input_polygon: shapely.Polygon
    shift_m: tuple[float, float]
    shift_sd_m: float | None
    source: str
    overhang_m: float | None = None
    flags: tuple[str, ...] = ()
    ground_inside_m2: float = 0.0
    roof_outside_m2: float = 0.0
    block: str = ""


def register(
    features: Features, cloud: Cloud, registers: np.ndarray | None = None
) -> tuple[Features, list[Registration]]:
    """(the footprints, moved to where the cloud shows the buildings; what was done to each).

    features: what :func:`p2wss.footprints.cleaning.clean_footprints` returns, with all footprints of
    :meth:`Surroundings.around`. registers: int8 (footprints,): :data:`OWN_CLASSES` or :data:`OWN_BUILDINGS` where p2wss
    itself classified points around, else :data:`CLASSES`, the default; the same for all footprints of a block.
    """
    shapes = features.geometry
    blocks = find_blocks(shapes)
    least_id: dict[int, str] = {}
    for block, name in zip(blocks.of_footprint.tolist(), features["building_id"].tolist(), strict=True):
        least_id[block] = min(name, least_id.get(block, name))
    registers = np.full(len(shapes), CLASSES) if registers is None else registers
    is_own = registers < CLASSES
    of_own = np.zeros(len(blocks), bool)
    of_own[blocks.of_footprint[is_own & (blocks.of_footprint >= 0)]] = True
    shifts = decide(_Near(blocks, cloud).estimates(least_id), blocks_around(blocks), of_own)
    polygons = polygon_arrays.to_polygons(shapes)
    of_vertex = np.repeat(blocks.of_footprint, np.diff(polygons.vertex_offset))
    moved_polygons = replace(polygons, xy_m=polygons.xy_m + shifts.shift_m[of_vertex])
    geometries = polygon_arrays.to_geometries(moved_polygons)
    evidence = contradictions(moved_polygons, cloud)
    own = np.flatnonzero(registers == OWN_CLASSES)
    if len(own):
        for k in own[on_raised_ground(polygon_arrays.take(moved_polygons, own), cloud)].tolist():
            evidence.flags[k] += (reasons.RAISED_GROUND,)
    rows = []
    for k, block in enumerate(blocks.of_footprint.tolist()):
        if block < 0:
            rows.append(Registration(shapes[k], (0.0, 0.0), None, NOTHING))
            continue
        shift_m, sd_m, overhang_m = shifts.shift_m[block], shifts.sd_m[block], shifts.overhang_m[block]
        rows.append(
            Registration(
                shapes[k],
                (float(shift_m[0]), float(shift_m[1])),
                float(sd_m) if np.isfinite(sd_m) else None,
                str(shifts.source[block]),
                float(overhang_m) if np.isfinite(overhang_m) else None,
                tuple(name for name in evidence.flags[k] if registers[k] >= _FLAGGED.get(name, CLASSES)),
                float(evidence.ground_inside_m2[k]),
                float(evidence.roof_outside_m2[k]),
                least_id[block],
            )
        )
    return replace(features, geometry=geometries), rows


def summary(registrations: Iterable[Registration | None]) -> str:
    """One line: how many footprints were moved, and how many the cloud contradicts, by flag. A registration that is
    None counts as without evidence.

    ``registration: 12 of 74 footprints moved, 0.26 to 1.62 m (columns shift_x_m, shift_y_m); 62 in place,
    0 without evidence; extended: 6``
    """
    length_m: list[float] = []
    flags: Counter[str] = Counter()
    num_rows = num_without = 0
    for row in registrations:
        num_rows += 1
        num_without += row is None or row.source == NOTHING
        if row is not None:
            flags.update(row.flags)
            if row.shift_m != (0.0, 0.0):
                length_m.append(float(np.hypot(*row.shift_m)))
    text = f"registration: {len(length_m)} of {num_rows} footprints moved"
    if length_m:
        text += f", {min(length_m):.2f} to {max(length_m):.2f} m (columns shift_x_m, shift_y_m)"
    num_others = num_rows - len(length_m) - num_without
    text += f"; {num_others} in place, {num_without} without evidence"
    return text + "".join(f"; {name}: {count}" for name, count in sorted(flags.items()))


class Surroundings:
    """The blocks of all footprints of a run; tells on which other blocks the registration of a block depends."""

    def __init__(self, footprints: np.ndarray) -> None:
        """footprints: object array of polygons."""
        self._present = np.flatnonzero(~shapely.is_empty(footprints))
        self._of_present = connected(footprints[self._present])
        count = int(self._of_present.max(initial=-1)) + 1
        bounds = np.full((count, 4), np.inf)
        corners = shapely.bounds(footprints[self._present]) * [1, 1, -1, -1]
        np.minimum.at(bounds, self._of_present, corners)
        self._box = shapely.box(*(bounds * [1, 1, -1, -1]).T)
        self._tree = shapely.STRtree(self._box)

    def around(
        self,
        is_chosen: np.ndarray,
        distances_m: Sequence[float] = (_BESIDE_M, _AROUND_M + 1, 2 * REACH_M),
    ) -> np.ndarray:
        """bool (footprints,): the chosen footprints, and all on which their registration depends.

        These are all footprints of their blocks; the blocks beside these, on which their flags depend; the blocks
        around all of these, whose shift they may get; and the blocks with which these compete for points.
        """
        blocks = np.unique(self._of_present[is_chosen[self._present]])
        for distance_m in distances_m:
            blocks = np.unique(
                self._tree.query(self._box[blocks], predicate="dwithin", distance=distance_m)[1]
            )
        result = is_chosen.copy()
        result[self._present[np.isin(self._of_present, blocks)]] = True
        return result

    def whole_blocks(self, is_chosen: np.ndarray) -> np.ndarray:
        """bool (footprints,): all footprints of the blocks that have a chosen footprint."""
        return self.around(is_chosen, ())


def blocks_around(blocks: Blocks) -> np.ndarray:
    """int64 (p, 2): pairs of blocks that are near each other, each pair in both orders, sorted."""
    corner = blocks.edge.reshape(-1, 2)
    low, high = np.full((len(blocks), 2), np.inf), np.full((len(blocks), 2), -np.inf)
    np.minimum.at(low, np.repeat(blocks.of_edge, 2), corner)
    np.maximum.at(high, np.repeat(blocks.of_edge, 2), corner)
    boxes = shapely.box(*low.T, *high.T)
    pairs = shapely.STRtree(boxes).query(boxes, predicate="dwithin", distance=_AROUND_M).T
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return np.asarray(pairs[np.lexsort(pairs.T[::-1])])


class _Near:
    """The points near each block, without the points inside other blocks, and the estimates of shifts from them."""

    def __init__(self, blocks: Blocks, cloud: Cloud) -> None:
        self.blocks = blocks
        point, _, offset = crop_points(cloud.x_m, cloud.y_m, blocks.outline, REACH_M)
        used = np.zeros(len(cloud), bool)
        used[point] = True
        number = np.cumsum(used) - 1
        self.x_m, self.y_m = cloud.x_m[used], cloud.y_m[used]
        weight = point_weights(cloud.classification[used])
        is_roof, is_other = weight == 1.0, weight == SEARCH.other_weight
        is_like = like_roofs(self.x_m, self.y_m, cloud.z_m[used], is_roof, is_other)
        # weights of points for blocks whose roofs have good classes, and for blocks with missed roofs
        self.weights = weight, np.where(is_like, 0.0, weight)
        self.is_missed = with_missed_roofs(blocks, self.x_m, self.y_m, is_roof, is_like)
        point = number[point]
        first = np.searchsorted(blocks.of_outline, np.arange(len(blocks) + 1))
        self.points = [distinct(point[offset[a] : offset[b]]) for a, b in pairwise(first)]
        inside = self.block_of_points()
        self.points = [
            each[(inside[each] == block) | (inside[each] < 0)] for block, each in enumerate(self.points)
        ]
        self.outlines = polygon_arrays.to_geometries(blocks.outline)
        self.edges = np.searchsorted(blocks.of_edge, np.arange(len(blocks) + 1))

    def block_of_points(self) -> np.ndarray:
        """int64 (n,): the block that contains each point, -1 for a point outside all blocks."""
        point, inside, offset = crop_points(self.x_m, self.y_m, self.blocks.outline, 0.0)
        of_pair = np.repeat(self.blocks.of_outline, np.diff(offset))
        result = np.full(len(self.x_m), -1, np.int64)
        # a point in an overlap belongs to the first block
        result[point[inside][::-1]] = of_pair[inside][::-1]
        return result

    def estimates(self, names: Mapping[int, str]) -> list[Estimate]:
        """The estimate of every block. Where errors are met, a block at which it fails gets no evidence. names: the
        name of each block, for the log."""
        blocks, rows = self.blocks, list(pairwise(self.edges))
        failed: set[int] = set()

        def search(block: int) -> np.ndarray:
            first, last = rows[block]
            point = self.points[block]
            xy_m = np.column_stack([self.x_m[point], self.y_m[point]])
            weight = self.weights[int(self.is_missed[block])]
            return search_shift(blocks.edge[first:last], xy_m, weight[point])

        def stays(block: int, trace: str) -> list[np.ndarray]:
            note(f"registration of the block of {names[block]}", trace, "it stays where it is")
            failed.add(block)
            return [np.zeros(2)]

        def solve(block: int) -> Estimate:
            first, last = rows[block]
            last = first if block in failed else last  # without an edge, there is no evidence
            return solve_shift(edge[first:last], step_m[first:last], step_sd_m[first:last], shift_m[block])

        def unknown(block: int, trace: str) -> list[Estimate]:
            stays(block, trace)
            return [NO_ESTIMATE]

        numbers = range(len(blocks))
        shift_m = np.array(surviving(lambda some: map(search, some), numbers, stays)).reshape(-1, 2)
        best = [NO_ESTIMATE] * len(blocks)
        is_missed = self.is_missed[blocks.of_edge]
        for _ in range(STEP.num_rounds):
            edge = blocks.edge + np.tile(shift_m[blocks.of_edge], 2)
            step_m, step_sd_m = np.full((2, len(edge)), np.nan)
            for weight, some in zip(self.weights, (~is_missed, is_missed), strict=True):
                step_m[some], step_sd_m[some] = edge_steps(edge[some], self.x_m, self.y_m, weight)
            found = surviving(lambda some: map(solve, some), numbers, unknown)
            found_m = np.array([each.shift_m for each in found]).reshape(-1, 2)
            shift_m = np.where(np.hypot(*found_m.T)[:, None] <= MAX_SHIFT_M, found_m, shift_m)
            best = [min(pair, key=lambda each: each.sd_m) for pair in zip(best, found, strict=True)]
        return [NO_ESTIMATE if self._is_worse(k, each) else each for k, each in enumerate(best)]

    def _is_worse(self, block: int, estimate: Estimate) -> bool:
        """Whether a block would contain less roof if it were moved by an estimate than where it is. Where points are
        sparse, the steps of many short edges can agree by chance. False for estimates that are not used anyway."""
        if not estimate.sd_m <= EVIDENCE.max_sd_m or np.hypot(*estimate.shift_m) < EVIDENCE.min_shift_m:
            return False
        point = self.points[block]
        weight = self.weights[int(self.is_missed[block])][point]
        first, last = np.searchsorted(self.blocks.of_outline, [block, block + 1])
        shape = shapely.union_all(self.outlines[first:last])
        here, there = (
            weight[shapely.contains_xy(shape, self.x_m[point] - dx_m, self.y_m[point] - dy_m)]
            for dx_m, dy_m in (np.zeros(2), estimate.shift_m)
        )
        # means are compared, as sums depend on the density of points
        least = float(here.sum()) - SEARCH.as_good_points
        return bool(len(there)) and float(there.mean()) * len(here) < least


def decide(estimates: list[Estimate], pairs: np.ndarray, is_own: np.ndarray) -> Shifts:
    """The movements that are applied to n blocks, decided by the evidence.

    pairs: (p, 2), pairs of near blocks, as :func:`blocks_around` returns them. is_own: bool (n,), whether p2wss itself
    classified the points around a block.
    """
    count = len(estimates)
    shift_m = np.array([each.shift_m for each in estimates]).reshape(-1, 2)
    sd_m, overhang_m = np.array([(each.sd_m, each.overhang_m) for each in estimates]).reshape(-1, 2).T
    is_clear = (np.hypot(*shift_m.T) <= MAX_SHIFT_M) & (sd_m <= EVIDENCE.max_sd_m)
    source = np.where(is_clear, EDGES, NOTHING).astype(object)
    shift_m[~is_clear], sd_m[~is_clear], overhang_m[~is_clear] = 0.0, np.nan, np.nan
    of_block = np.split(pairs[:, 1], np.searchsorted(pairs[:, 0], np.arange(1, count)))
    own_m, own_sd_m = shift_m.copy(), sd_m.copy()
    for block in range(count):
        near = of_block[block]
        around_m, around_sd_m = shift_around(own_m[near[is_clear[near]]])
        if not is_clear[block]:
            if around_sd_m <= EVIDENCE.max_sd_m:
                source[block], shift_m[block], sd_m[block] = AROUND, around_m, around_sd_m
            continue
        # the error of a map varies smoothly, so the shift of the blocks around is a further observation
        apart_m, joint_sd_m = around_m - own_m[block], np.hypot(own_sd_m[block], around_sd_m)
        if np.hypot(*apart_m) <= EVIDENCE.max_sigmas_apart * joint_sd_m < np.inf:
            shift_m[block] += apart_m * (own_sd_m[block] / joint_sd_m) ** 2
            sd_m[block] *= around_sd_m / joint_sd_m
    for rules, of_rules in ((EVIDENCE, ~is_own), (OWN_EVIDENCE, is_own)):
        least_m = np.fmax(rules.min_sigmas * sd_m, rules.min_shift_m)
        shift_m[of_rules & (np.hypot(*shift_m.T) < least_m)] = 0.0
    return Shifts(np.round(shift_m, 3), sd_m, source, overhang_m)


def shift_around(shift_m: np.ndarray) -> tuple[np.ndarray, float]:
    """(shift (2,), its standard deviation) of a block, predicted from the shifts (n, 2) of the blocks around.

    The block's own shift is within two deviations in 95 % of cases, also if there are few blocks around: the distance
    follows a Student distribution of two dimensions. The deviation is infinite for less than two blocks.
    """
    if len(shift_m) < 2:
        return np.zeros(2), float("inf")
    mean_m, num_degrees = np.mean(shift_m, axis=0), 2 * (len(shift_m) - 1)
    variance_m2 = ((shift_m - mean_m) ** 2).sum() / num_degrees * (1 + 1 / len(shift_m))
    within_m2 = variance_m2 * num_degrees * (0.05 ** (-2 / num_degrees) - 1)
    return mean_m, float(np.sqrt(within_m2 / 4 + EXPECTED.block_sd_m**2))
