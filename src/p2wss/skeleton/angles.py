"""Angles and tangents that are the same on all processors. The last bit of numpy's ``arctan2``, ``arctan`` and ``tan``
depends on the instructions that a processor has, and may decide which way a coordinate is rounded."""

import math

import numpy as np


def bearings(vectors: np.ndarray) -> np.ndarray:
    """Angles of vectors (..., 2) from the first axis, radians."""
    angle = [math.atan2(y, x) for x, y in vectors.reshape(-1, 2).tolist()]
    return np.reshape(angle, vectors.shape[:-1])


def slope_angles(rise: np.ndarray) -> np.ndarray:
    """Angles of slopes, degrees. rise: metres per metre."""
    return np.degrees(bearings(np.stack([np.ones(rise.shape), rise], axis=-1)))


def tangents(angle_deg: np.ndarray) -> np.ndarray:
    """The rise of slopes, metres per metre. angle_deg: degrees."""
    angle = np.radians(angle_deg)
    return np.asarray(np.sin(angle) / np.cos(angle))
