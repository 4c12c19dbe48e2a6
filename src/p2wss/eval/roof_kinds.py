"""The kind of a roof from the angles of its edges, for real buildings, which have no label."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SEVERAL_HEIGHTS = "several heights"
# slopes whose directions differ by at most this angle make a shed
_SHED_COSINE = np.cos(np.radians(30.0))


def roof_kind(rings: Sequence[np.ndarray], angle_deg: np.ndarray, num_parts: int = 1) -> str:
    """flat, shed, gable, hip, mixed, or :data:`SEVERAL_HEIGHTS`. rings: each (n, 2); angle_deg: one value per edge.

    flat: no slope at all. hip: a slope at every edge. gable: only slopes and gables (90 degrees). shed: the same, but
    all slopes face the same way. mixed: slopes and flat edges.

    >>> square = [np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]])]
    >>> [roof_kind(square, np.array(a)) for a in ([40, 90, 40, 90], [40, 90, 90, 90], [40, 40, 40, 40])]
    ['gable', 'shed', 'hip']
    """
    if num_parts > 1:
        return SEVERAL_HEIGHTS
    angle = np.asarray(angle_deg, float)
    slope = (angle > 0) & (angle < 90)
    if not slope.any():
        return "flat"
    if slope.all():
        return "hip"
    if (angle == 0).any():
        return "mixed"
    along = np.concatenate([np.roll(ring, -1, axis=0) - ring for ring in rings])[slope]
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return "shed" if (along @ along.T).min() >= _SHED_COSINE else "gable"
