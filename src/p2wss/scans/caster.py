"""The cast: pulses in chunks through Embree, in the order of firing, on any number of threads."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import local

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from p2wss.scans.hits import Hits, empty_hits, locate
from p2wss.scans.pulses import BLOCK_PULSES, Box, Rays, blocks_over, empty_rays, generate
from p2wss.scans.returns import OUTCOMES, Points, empty_points, record
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
    # fresh memory costs a fifth of the cast: each thread keeps its own, and the points are written into
    # arrays with room for all pulses, whose unused ends are never touched
    points, num_points = empty_points(sum(len(blocks) for _, blocks in chunks) * BLOCK_PULSES), 0
    of_thread = local()

    def allocate() -> None:
        room = max(BLOCK_PULSES, chunk_pulses)
        of_thread.workspace = empty_rays(room), empty_hits(room), empty_points(room)

    def cast_chunk(chunk: tuple[Strip, np.ndarray]) -> tuple[Points, np.ndarray]:
        (strip, blocks), (rays, hits, found) = chunk, of_thread.workspace
        n = generate(strip.path, blocks, box, rays)
        rays, hits = Rays(*(column[:n] for column in rays)), Hits(*(column[:n] for column in hits))
        caster.first_hits(rays.origin, rays.direction, hits)
        n, outcome = record(rays, hits, surface, strip.path, strip.errors, box, found)
        return Points(*(column[:n].copy() for column in found)), outcome

    with ThreadPoolExecutor(threads, initializer=allocate) as pool:
        for new, outcome in pool.map(cast_chunk, chunks):  # in the order of firing
            for column, values in zip(points, new, strict=True):
                column[num_points : num_points + len(values)] = values
            num_points += len(new.pulse)
            counts += outcome
    by_outcome = {name: int(count) for name, count in zip(OUTCOMES, counts, strict=True)}
    return Points(*(column[:num_points] for column in points)), {"cast": int(counts.sum()), **by_outcome}


def _chunks(strips: list[Strip], box: Box, chunk_pulses: int) -> Iterator[tuple[Strip, np.ndarray]]:
    """Strip and blocks of pulses of each chunk."""
    step = max(1, chunk_pulses // BLOCK_PULSES)
    for strip in strips:
        blocks = blocks_over(strip.path, strip.path.num_blocks, box)
        for start in range(0, len(blocks), step):
            yield strip, blocks[start : start + step]
