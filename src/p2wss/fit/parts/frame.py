"""The frame in which a building is cut: its axes follow the walls or, where the footprint hides them, the roof."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss.fit.directions import turn_between
from p2wss.fit.parts.parts import main_frame

# Planes are fitted to the points of each cell of this size; they are roof where there are so many points, with at most
# this root mean square of the residuals, and a gradient between these.
_CELL_M, _MIN_POINTS, _MAX_RMS_M = 1.0, 5, 0.08
_MIN_GRADIENT, _MAX_GRADIENT = 0.12, 2.5
# at least this share of the points is on such planes, and their directions agree to this degree (1: exactly)
_MIN_SHARE, _MIN_AGREEMENT = 0.25, 0.8
# a smaller difference from the walls is noise
_MIN_DIFFERENCE_DEG = 6.0
# the frame is that of a wall of at least this length that runs within this angle of it
_WALL_DEG, _MIN_WALL_M = 4.0, 2.0


def roof_frame(rings: Sequence[np.ndarray], roof_point_m: np.ndarray) -> np.ndarray:
    """Rotation (2, 2) for which roofs slope along the axes of ``xy @ rotation``.

    That is the frame of the walls (:func:`p2wss.fit.parts.parts.main_frame`), unless the planes of the roof slope
    in other directions that agree with each other: a block may be cut off by the border of a map, or be drawn from
    a raster. roof_point_m: (m, 3), the points on the roof.
    """
    frame = main_frame(rings)
    roof_deg = _direction_of_slopes_deg(roof_point_m)
    if roof_deg is None or abs(turn_between(roof_deg, _degrees(*frame[:, 0]), 90.0)) < _MIN_DIFFERENCE_DEG:
        return frame
    wall = np.concatenate([np.roll(ring, -1, axis=0) - ring for ring in rings])
    length = np.hypot(wall[:, 0], wall[:, 1])
    off_deg = turn_between(_degrees(wall[:, 0], wall[:, 1]), roof_deg, 90.0)
    length[np.abs(off_deg) > _WALL_DEG] = 0.0
    longest = int(length.argmax())
    if length[longest] >= _MIN_WALL_M:
        roof_deg += float(off_deg[longest])
    turn = np.radians(roof_deg)
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


def _direction_of_slopes_deg(point_m: np.ndarray) -> float | None:
    """The direction in which planes of the roof rise, up to right angles, in half degrees; None if they do not agree or
    are too few."""
    if len(point_m) < _MIN_POINTS:
        return None
    offset = point_m - point_m.min(axis=0)
    cell = np.floor(offset[:, :2] / _CELL_M).astype(np.int64)
    _, cell = np.unique(cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1], return_inverse=True)
    count = np.bincount(cell)
    x, y, z = (values - (np.bincount(cell, values) / count)[cell] for values in offset.T)
    xx, xy, yy = np.bincount(cell, x * x), np.bincount(cell, x * y), np.bincount(cell, y * y)
    xz, yz, zz = np.bincount(cell, x * z), np.bincount(cell, y * z), np.bincount(cell, z * z)
    determinant = xx * yy - xy * xy
    usable = (count >= _MIN_POINTS) & (determinant > 1e-3 * (xx + yy) ** 2)
    determinant = np.where(usable, determinant, 1.0)
    slope_x, slope_y = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
    rms_m = np.sqrt(np.maximum(zz - slope_x * xz - slope_y * yz, 0.0) / count)
    gradient = np.hypot(slope_x, slope_y)
    usable &= (rms_m < _MAX_RMS_M) & (gradient > _MIN_GRADIENT) & (gradient < _MAX_GRADIENT)
    weight = count * usable
    if weight.sum() < _MIN_SHARE * len(point_m):
        return None
    # directions that differ by right angles are the same
    total = complex(np.sum(weight * np.exp(4j * np.arctan2(slope_y, slope_x))))
    if abs(total) < _MIN_AGREEMENT * weight.sum():
        return None
    return round(2 * float(np.degrees(np.angle(total))) / 4) / 2


def _degrees(x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
    return np.degrees(np.arctan2(y, x))
