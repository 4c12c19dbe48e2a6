"""The cast: pulses in chunks through Embree, in the order of firing, on any number of threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from p2wss.scans.beams import empty_sub_beams, rays_to_split, split_rays
from p2wss.scans.hits import Hits, empty_hits, locate
from p2wss.scans.pulses import BLOCK_PULSES, Box, blocks_over, generate
from p2wss.scans.randomness import NORMAL_QUANTILE
from p2wss.scans.returns import OUTCOMES, Points, empty_points, grown, record
from p2wss.scans.surface import Surface
from p2wss.scans.survey import Strip

CHUNK_PULSES = 131_072  # arrays of a chunk stay in the cache; 128 k to 512 k are equally fast


class Caster:
    """A surface whose triangles are in Embree. Its methods may be called from several threads at once."""

    def __init__(self, surface: Surface):
        self.surface = surface
        self._scene = None
        if len(surface.triangle):
            self._scene = EmbreeScene()
            self._mesh = TriangleMesh(self._scene, surface.vertex_m.astype(np.float32), surface.triangle)
            # the first call builds the tree, and only one thread may do so
            self.first_triangles(np.zeros((1, 3), np.float32), np.array([[0, 0, -1]], np.float32))

    def first_triangles(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """The triangle that each ray meets first by Embree, int32 (n,), -1 for none; the terrain is ignored.

        origin, direction: float32 (n, 3).
        """
        if self._scene is None or not len(origin):
            return np.full(len(origin), -1, np.int32)
        return self._scene.run(origin, direction, query="INTERSECT")

    def first_hits(self, origin: np.ndarray, direction: np.ndarray, hits: Hits) -> None:
        """Fill in ``hits``: the exact first hit of each ray on a triangle or the terrain."""
        locate(origin, direction, self.first_triangles(origin, direction), self.surface, hits)


def cast(
    surface: Surface,
    strips: list[Strip],
    box: Box,
    threads: int = 1,
    chunk_pulses: int = CHUNK_PULSES,
) -> tuple[Points, dict[str, int]]:
    """All points that a survey records over ``box``, ordered by strip and pulse, and counts of the pulses.

    ``box`` bounds the points in x and y; its z range must contain the whole surface. The result does not
    depend on ``threads`` and ``chunk_pulses``. The counts have the names of :data:`returns.OUTCOMES`, and
    ``cast``, their sum.
    """
    caster = Caster(surface)
    counts = np.zeros(len(OUTCOMES), np.int64)
    chunks = list(_chunks(strips, box, chunk_pulses))
    pending = iter(chunks)
    # fresh memory costs a fifth of the cast: each thread keeps its own, and the points are written into
    # arrays that are long enough, whose unused ends are never touched
    points, num_points = empty_points(sum(len(blocks) for _, blocks in chunks) * BLOCK_PULSES), 0
    workspaces = [_Workspace(max(BLOCK_PULSES, chunk_pulses)) for _ in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        running: deque[tuple[_Workspace, Future[tuple[int, np.ndarray]]]] = deque()

        def start_next(workspace: _Workspace) -> None:
            """Cast the next chunk, if there is one."""
            for index, blocks in islice(pending, 1):
                arguments = (caster, strips[index], index, blocks, box, workspace)
                running.append((workspace, pool.submit(_cast_chunk, *arguments)))

        for workspace in workspaces:
            start_next(workspace)
        while running:  # the oldest first, in the order of firing
            workspace, future = running.popleft()
            num_new, outcome = future.result()
            if num_points + num_new > len(points.pulse):  # several returns
                points = grown(points, num_points, 2 * (num_points + num_new))
            for column, new in zip(points, workspace.points, strict=True):
                column[num_points : num_points + num_new] = new[:num_new]
            num_points += num_new
            counts += outcome
            start_next(workspace)
    by_outcome = {name: int(count) for name, count in zip(OUTCOMES, counts, strict=True)}
    return Points(*(column[:num_points] for column in points)), {"cast": int(counts.sum()), **by_outcome}


class _Workspace:
    """Arrays for the rays, hits and points of one chunk of at most ``room`` pulses."""

    def __init__(self, room: int):
        self.origin, self.direction = np.empty((room, 3), np.float32), np.empty((room, 3), np.float32)
        self.advance_m, self.pulse = np.empty(room), np.empty(room, np.int64)
        self.hits = empty_hits(room)
        self.points = empty_points(room)

    def ensure_points(self, num_points: int) -> None:
        """Make ``points`` long enough for ``num_points``; its contents are lost."""
        if num_points > len(self.points.pulse):
            self.points = empty_points(num_points)


def _chunks(strips: list[Strip], box: Box, chunk_pulses: int) -> Iterator[tuple[int, np.ndarray]]:
    """Number of the strip and blocks of pulses of each chunk."""
    step = max(1, chunk_pulses // BLOCK_PULSES)
    for index, strip in enumerate(strips):
        blocks = blocks_over(strip.path, strip.path.num_blocks, box)
        for start in range(0, len(blocks), step):
            yield index, blocks[start : start + step]


def _cast_chunk(
    caster: Caster, strip: Strip, index: int, blocks: np.ndarray, box: Box, workspace: _Workspace
) -> tuple[int, np.ndarray]:
    """Write the points of some blocks into ``workspace``; returns their number and the pulses by outcome."""
    n = generate(
        strip.path,
        blocks,
        box,
        NORMAL_QUANTILE,
        workspace.origin,
        workspace.direction,
        workspace.advance_m,
        workspace.pulse,
    )
    origin, direction = workspace.origin[:n], workspace.direction[:n]
    advance_m, pulse = workspace.advance_m[:n], workspace.pulse[:n]
    hits = Hits(*(column[:n] for column in workspace.hits))
    caster.first_hits(origin, direction, hits)
    split = np.zeros(0, np.int64)
    if strip.errors.max_returns > 1 and strip.path.beam_sigma_rad > 0:
        split = rays_to_split(origin, direction, pulse, hits, caster.surface, strip.errors.separation_m)
    sub_origin, sub_direction, sub_advance_m = empty_sub_beams(len(split))
    split_rays(
        origin,
        direction,
        advance_m,
        pulse,
        split,
        strip.path,
        strip.errors.split_key,
        NORMAL_QUANTILE,
        sub_origin,
        sub_direction,
        sub_advance_m,
    )
    sub_hits = empty_hits(len(sub_advance_m))
    caster.first_hits(sub_origin, sub_direction, sub_hits)
    workspace.ensure_points(n + len(sub_advance_m))
    outcome = np.zeros(len(OUTCOMES), np.int64)
    num_points = record(
        origin,
        direction,
        advance_m,
        pulse,
        hits,
        split,
        sub_direction,
        sub_advance_m,
        sub_hits,
        caster.surface,
        strip.path,
        strip.errors,
        index,
        box,
        NORMAL_QUANTILE,
        workspace.points,
        outcome,
    )
    return num_points, outcome
