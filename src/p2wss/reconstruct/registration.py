"""Registration: footprints moved to where the cloud shows the buildings, block by block.

Each block of footprints that share walls has one shift (:mod:`p2wss.reconstruct.shifts`). It is used only where the
evidence of the points is clear; else the block is not moved. A block's shift depends only on the points around it and
on the blocks that compete with it for them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely

from p2wss.clouds.cropping import crop_points
from p2wss.clouds.reading import Cloud
from p2wss.data import polygon_arrays
from p2wss.reconstruct.failures import note, surviving
from p2wss.reconstruct.footprint_flags import contradictions
from p2wss.reconstruct.registration_blocks import Blocks, connected, find_blocks
from p2wss.reconstruct.shifts import (
    MAX_SHIFT_M,
    SEARCH,
    WINDOW_M,
    Estimate,
    edge_steps,
    point_weights,
    search_shift,
    solve_shift,
)
from p2wss.skeleton.types import Polygons
from p2wss.storage.features import Features

# footprints this near compete with others for roofs outside of both: twice the reach of the flags, and of the shifts
_BESIDE_M = 20.0
# points this far from a block matter to it: the largest shift, the strip of an edge, and a cell of the search
REACH_M = MAX_SHIFT_M + WINDOW_M + SEARCH.cell_m

EDGES, NOTHING = "edges", "none"


@dataclass(frozen=True)
class Evidence:
    """Which evidence moves a block. Chosen on Delft, with blocks moved by known vectors, so that what is in place stays
    (``benchmarks/registration.py``, seeds 0 to 2).

    min_steps, max_sd_m: evidence is clear with as many edges with steps, and
    with a standard deviation of at most this. min_shift_m, min_sigmas: a shift is used from this length, and from this
    many standard deviations.
    """

    min_steps: int = 3
    max_sd_m: float = 0.25
    min_shift_m: float = 0.25
    min_sigmas: float = 3.0


EVIDENCE = Evidence()


@dataclass(frozen=True)
class Shifts:
    """The movement of n blocks.

    shift_m: (n, 2). sd_m: (n,), the larger standard deviation of the shift; NaN without evidence. source: object (n,),
    :data:`EDGES` or :data:`NOTHING`. overhang_m: (n,), how far roofs reach beyond the footprints, NaN without evidence.
    """

    shift_m: np.ndarray
    sd_m: np.ndarray
    source: np.ndarray
    overhang_m: np.ndarray


@dataclass(frozen=True)
class Registration:
    """What registration did to a footprint.

    input_polygon: the footprint before. shift_m: its movement. shift_sd_m: standard deviation of the
    shift in its worse direction; None without evidence.
    source: :data:`EDGES` or :data:`NOTHING`. overhang_m: how far the roofs of the block reach
    beyond its edges, negative where they end inside; None without evidence. flags, ground_inside_m2, roof_outside_m2:
    how the cloud contradicts the moved footprint (:mod:`p2wss.reconstruct.footprint_flags`). block: the least id of
    its footprints; empty for a footprint that was excluded.
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


def register(features: Features, cloud: Cloud) -> tuple[Features, list[Registration]]:
    """(the footprints where the cloud shows the buildings, what was done to each).

    features: what :func:`p2wss.footprints.cleaning.clean_footprints` returns, with all footprints of
    :meth:`Surroundings.around`.
    """
    shapes = features.geometry
    blocks = find_blocks(shapes)
    least_id: dict[int, str] = {}
    for block, name in zip(blocks.of_footprint.tolist(), features["building_id"].tolist(), strict=True):
        least_id[block] = min(name, least_id.get(block, name))
    shifts = block_shifts(blocks, cloud, least_id)
    polygons = polygon_arrays.to_polygons(shapes)
    of_vertex = np.repeat(blocks.of_footprint, np.diff(polygons.vertex_offset))
    xy_m = moved(polygons.xy_m, of_vertex, shifts.shift_m)
    moved_polygons = Polygons(xy_m, polygons.ring_offset, polygons.polygon_offset)
    geometries = polygon_arrays.to_geometries(moved_polygons)
    evidence = contradictions(moved_polygons, cloud)
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
                evidence.flags[k],
                float(evidence.ground_inside_m2[k]),
                float(evidence.roof_outside_m2[k]),
                least_id[block],
            )
        )
    return replace(features, geometry=geometries), rows


def summary(registrations: Iterable[Registration | None]) -> str:
    """One line: how many footprints were moved, and which the cloud contradicts; None counts as without evidence.

    ``registration: 12 of 74 footprints moved, 0.26 to 1.62 m; 62 in place, 0 without evidence;
    extended: 6``
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
        text += f", {min(length_m):.2f} to {max(length_m):.2f} m"
    num_others = num_rows - len(length_m) - num_without
    text += f"; {num_others} in place, {num_without} without evidence"
    return text + "".join(f"; {name}: {count}" for name, count in sorted(flags.items()))


class Surroundings:
    """The blocks of all footprints of a run, and which of them the registration of others depends on."""

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

    def around(self, is_chosen: np.ndarray) -> np.ndarray:
        """The footprints on which the registration of the chosen ones depends, themselves included: bool (footprints,).

        These are all footprints of their blocks, those beside them, which their flags depend on, and those around
        all these with which they compete for points.
        """
        blocks = np.unique(self._of_present[is_chosen[self._present]])
        for distance_m in (_BESIDE_M, 2 * REACH_M):
            blocks = np.unique(
                self._tree.query(self._box[blocks], predicate="dwithin", distance=distance_m)[1]
            )
        result = is_chosen.copy()
        result[self._present[np.isin(self._of_present, blocks)]] = True
        return result

    def whole_blocks(self, is_chosen: np.ndarray) -> np.ndarray:
        """All footprints of the blocks of the chosen ones, bool (footprints,)."""
        blocks = self._of_present[is_chosen[self._present]]
        result = is_chosen.copy()
        result[self._present[np.isin(self._of_present, blocks)]] = True
        return result


def moved(xy_m: np.ndarray, block: np.ndarray, shift_m: np.ndarray) -> np.ndarray:
    """Vertices (v, 2) of blocks, moved by the shifts of these, (n, 2)."""
    return xy_m + shift_m[block] if len(shift_m) else xy_m


def block_shifts(blocks: Blocks, cloud: Cloud, names: Mapping[int, str] | None = None) -> Shifts:
    """The movement of every block. names: of blocks, for messages."""
    near = _Near(blocks, cloud)
    return decide(near.estimates(names or {}))


class _Near:
    """The points near blocks, and the blocks where they are assumed to be."""

    def __init__(self, blocks: Blocks, cloud: Cloud) -> None:
        self.blocks = blocks
        point, _, offset = crop_points(cloud.x_m, cloud.y_m, blocks.outline, REACH_M)
        used = np.zeros(len(cloud), bool)
        used[point] = True
        number = np.cumsum(used) - 1
        self.x_m, self.y_m = cloud.x_m[used], cloud.y_m[used]
        self.weight = point_weights(cloud.classification[used])
        point = number[point]
        first = np.searchsorted(blocks.of_outline, np.arange(len(blocks) + 1))
        self.points = [point[offset[a] : offset[b]] for a, b in pairwise(first)]
        for block in np.flatnonzero(np.diff(first) > 1).tolist():
            self.points[block] = np.unique(self.points[block])
        self.edges = np.searchsorted(blocks.of_edge, np.arange(len(blocks) + 1))

    def block_of_points(self) -> np.ndarray:
        """The block in whose outline each point is, -1 for none."""
        point, inside, offset = crop_points(self.x_m, self.y_m, self.blocks.outline, 0.0)
        of_pair = np.repeat(self.blocks.of_outline, np.diff(offset))
        result = np.full(len(self.x_m), -1, np.int64)
        # in an overlap, a point is of the first block
        result[point[inside][::-1]] = of_pair[inside][::-1]
        return result

    def estimates(self, names: Mapping[int, str]) -> list[Estimate]:
        """The estimate of every block; where errors are met, none of a block at which it fails."""
        blocks, rows = self.blocks, list(pairwise(self.edges))
        inside = self.block_of_points()
        failed: set[int] = set()

        def search(block: int) -> np.ndarray:
            first, last = rows[block]
            point = self.points[block]
            point = point[(inside[point] == block) | (inside[point] < 0)]
            xy_m = np.column_stack([self.x_m[point], self.y_m[point]])
            return search_shift(blocks.edge[first:last], xy_m, self.weight[point])

        def stays(block: int, trace: str) -> list[np.ndarray]:
            note(
                f"registration of the block of {names.get(block, str(block))}", trace, "it stays where it is"
            )
            failed.add(block)
            return [np.zeros(2)]

        def solve(block: int) -> Estimate:
            first, last = rows[block]
            last = first if block in failed else last  # without an edge, there is no evidence
            return solve_shift(edge[first:last], step_m[first:last], shift_m[block])

        def unknown(block: int, trace: str) -> list[Estimate]:
            return [Estimate(stays(block, trace)[0], np.zeros((2, 2)), float("nan"), 0)]

        numbers = range(len(blocks))
        found_m = surviving(lambda some: map(search, some), numbers, stays)
        shift_m = np.array(found_m).reshape(-1, 2)
        edge = moved(blocks.edge.reshape(-1, 2), np.repeat(blocks.of_edge, 2), shift_m).reshape(-1, 4)
        step_m = edge_steps(edge, self.x_m, self.y_m, self.weight)
        return surviving(lambda some: map(solve, some), numbers, unknown)


def decide(estimates: list[Estimate]) -> Shifts:
    """The movements that are applied, decided by the evidence."""
    count = len(estimates)
    shift_m, sd_m, overhang_m = np.zeros((count, 2)), np.full(count, np.nan), np.full(count, np.nan)
    source = np.full(count, NOTHING, dtype=object)
    for block, each in enumerate(estimates):
        if each.num_steps < EVIDENCE.min_steps:
            continue
        block_sd_m = 1 / np.sqrt(max(np.linalg.eigvalsh(each.information)[0], 1e-12))
        length_m = np.linalg.norm(each.shift_m)
        if not length_m <= MAX_SHIFT_M or block_sd_m > EVIDENCE.max_sd_m:
            continue
        source[block], sd_m[block], overhang_m[block] = EDGES, block_sd_m, each.overhang_m
        if length_m >= max(EVIDENCE.min_sigmas * block_sd_m, EVIDENCE.min_shift_m):
            shift_m[block] = np.round(each.shift_m, 3)
    return Shifts(shift_m, sd_m, source, overhang_m)
