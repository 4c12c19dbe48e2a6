"""The cast: pulses in chunks through Embree, in the order of firing, on any number of threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from p2wss.scans.pulses import BLOCK_PULSES, Box, blocks_over, generate
from p2wss.scans.randomness import NORMAL_QUANTILE
from p2wss.scans.returns import OUTCOMES, SUB_BEAMS, Hits, Points, locate, near_edges, record, split
from p2wss.scans.surface import Surface
from p2wss.scans.survey import Strip

CHUNK_PULSES = 131_072  # arrays of a chunk stay in the cache; 128 k to 512 k are equally fast


class Caster:
    """The buildings of a surface inside Embree. ``hits`` may be called from several threads at once."""

    def __init__(self, surface: Surface):
        self._scene = None
        if len(surface.triangle):
            self._scene = EmbreeScene()
            self._mesh = TriangleMesh(self._scene, surface.vertex_m.astype(np.float32), surface.triangle)
            # the first call builds the tree, and only one thread may do so
            self.hits(np.zeros((1, 3), np.float32), np.array([[0, 0, -1]], np.float32))

    def hits(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """The triangle that each ray meets first, int32 (n,), -1 for none. Arguments: float32 (n, 3)."""
        if self._scene is None or not len(origin):
            return np.full(len(origin), -1, np.int32)
        return self._scene.run(origin, direction, query="INTERSECT")


def cast(
    surface: Surface,
    strips: list[Strip],
    box: Box,
    threads: int = 1,
    chunk_pulses: int = CHUNK_PULSES,
) -> tuple[Points, dict[str, int]]:
    """All points that a survey records over ``box``, ordered by strip and pulse, and the fate of the pulses.

    ``box`` bounds the points in x and y; its z range must hold the whole surface. The result does not depend
    on ``threads`` and ``chunk_pulses``. Counts: those of :data:`returns.OUTCOMES` and ``cast``, their sum.
    """
    caster = Caster(surface)
    counts = np.zeros(len(OUTCOMES), np.int64)
    chunks = list(_chunks(strips, box, chunk_pulses))
    work = iter(chunks)
    # fresh memory costs a fifth of the cast: each thread keeps its own, and the points are written into
    # arrays that are long enough, whose unused ends are never touched
    points, num_points = _empty_points(sum(len(blocks) for _, blocks in chunks) * BLOCK_PULSES), 0
    spaces = [_Workspace(max(BLOCK_PULSES, chunk_pulses)) for _ in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        running: deque[tuple[_Workspace, Future[tuple[int, np.ndarray]]]] = deque()

        def start(space: _Workspace) -> None:
            """Cast the next chunk, if there is one."""
            for index, blocks in islice(work, 1):
                arguments = (caster, surface, strips[index], index, blocks, box, space)
                running.append((space, pool.submit(_cast_chunk, *arguments)))

        for space in spaces:
            start(space)
        while running:  # the oldest first, in the order of firing
            space, future = running.popleft()
            kept, outcome = future.result()
            if num_points + kept > len(points.pulse):  # several returns
                points = _longer(points, num_points, 2 * (num_points + kept))
            for column, part in zip(points, space.points, strict=True):
                column[num_points : num_points + kept] = part[:kept]
            num_points += kept
            counts += outcome
            start(space)
    fate = {name: int(count) for name, count in zip(OUTCOMES, counts, strict=True)}
    return Points(*(column[:num_points] for column in points)), {"cast": int(counts.sum()), **fate}


class _Workspace:
    """Rays, hits and points of one chunk of at most ``room`` pulses."""

    def __init__(self, room: int):
        self.origin, self.direction = np.empty((room, 3), np.float32), np.empty((room, 3), np.float32)
        self.advance_m, self.pulse = np.empty(room), np.empty(room, np.int64)
        self.found = _empty_hits(room)
        self.points = _empty_points(room)

    def make_room(self, num_points: int) -> None:
        """Have room for so many points."""
        if num_points > len(self.points.pulse):
            self.points = _empty_points(num_points)


def _empty_hits(n: int) -> Hits:
    return Hits(np.empty(n, np.int32), np.empty(n), np.empty((n, 3)), np.empty(n))


def _chunks(strips: list[Strip], box: Box, chunk_pulses: int) -> Iterator[tuple[int, np.ndarray]]:
    step = max(1, chunk_pulses // BLOCK_PULSES)
    for index, strip in enumerate(strips):
        blocks = blocks_over(strip.path, strip.path.num_blocks, box)
        for start in range(0, len(blocks), step):
            yield index, blocks[start : start + step]


def _cast_chunk(
    caster: Caster,
    surface: Surface,
    strip: Strip,
    index: int,
    blocks: np.ndarray,
    box: Box,
    space: _Workspace,
) -> tuple[int, np.ndarray]:
    """Leave the points of some blocks in ``space``; returns how many, and the fate of the pulses."""
    n = generate(
        strip.path,
        blocks,
        box,
        NORMAL_QUANTILE,
        space.origin,
        space.direction,
        space.advance_m,
        space.pulse,
    )
    origin, direction, advance_m = space.origin[:n], space.direction[:n], space.advance_m[:n]
    pulse, found = space.pulse[:n], Hits(*(column[:n] for column in space.found))
    _hits(caster, surface, origin, direction, found)
    chosen = np.zeros(0, np.int64)
    if strip.errors.max_returns > 1 and strip.path.beam_sigma_rad > 0:
        chosen = near_edges(origin, direction, pulse, found, surface, strip.errors.separation_m)
    room = len(chosen) * (SUB_BEAMS - 1)
    sub_origin, sub_direction = np.empty((room, 3), np.float32), np.empty((room, 3), np.float32)
    sub_advance_m = np.empty(room)
    split(
        origin,
        direction,
        advance_m,
        pulse,
        chosen,
        strip.path,
        strip.errors.split_key,
        NORMAL_QUANTILE,
        sub_origin,
        sub_direction,
        sub_advance_m,
    )
    sub_found = _empty_hits(room)
    _hits(caster, surface, sub_origin, sub_direction, sub_found)
    space.make_room(n + room)
    outcome = np.zeros(len(OUTCOMES), np.int64)
    kept = record(
        origin,
        direction,
        advance_m,
        pulse,
        found,
        chosen,
        sub_direction,
        sub_advance_m,
        sub_found,
        surface,
        strip.path,
        strip.errors,
        index,
        box,
        NORMAL_QUANTILE,
        space.points,
        outcome,
    )
    return kept, outcome


def _hits(caster: Caster, surface: Surface, origin: np.ndarray, direction: np.ndarray, found: Hits) -> None:
    """Fill in ``found`` for rays, see :func:`returns.locate`."""
    locate(origin, direction, caster.hits(origin, direction), surface, found)


def _empty_points(n: int) -> Points:
    return Points(
        xyz_mm=np.empty((n, 3), np.int32),
        intensity=np.empty(n, np.uint16),
        scan_angle=np.empty(n, np.int16),
        pulse=np.empty(n, np.int64),
        strip=np.empty(n, np.uint16),
        return_number=np.empty(n, np.uint8),
        num_returns=np.empty(n, np.uint8),
        building=np.empty(n, np.int32),
        face=np.empty(n, np.int32),
    )


def _longer(points: Points, used: int, room: int) -> Points:
    """The first ``used`` points with room for ``room``."""
    longer = _empty_points(room)
    for column, old in zip(longer, points, strict=True):
        column[:used] = old[:used]
    return longer
