"""Labels of the faces of a solid: one number for every plane of roof, cap, wall, flat piece and ground.

The labels 0..num_edges-1 are roof faces, by edge; then come the caps, the walls, by edge, all flat pieces at
the eave under one label, and the ground.
"""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import inner
from p2wss.skeleton.records import NUM_CAPS


@inner
def num_labels(num_edges: int, counts: np.ndarray) -> int:
    return 2 * num_edges + counts[NUM_CAPS] + 2


@inner
def wall_label(num_edges: int, counts: np.ndarray, e: int) -> int:
    return num_edges + counts[NUM_CAPS] + e


@inner
def flat_label(num_edges: int, counts: np.ndarray) -> int:
    return 2 * num_edges + counts[NUM_CAPS]


@inner
def ground_label(num_edges: int, counts: np.ndarray) -> int:
    return 2 * num_edges + counts[NUM_CAPS] + 1
