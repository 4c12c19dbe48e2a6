"""The buildings that clutter is for, and what all of it needs: random draws, edges, rectangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.scans.randomness import uniforms
from p2wss.skeleton.types import Polygons

_DRAWS = 64  # uniform draws per building and kind of thing


class Houses(NamedTuple):
    """The n buildings that clutter is for, in the local frame.

    polygons: their footprints, empty for one without a mesh. eave_z_m, ground_z_m, base_z_m: float64 (n,).
    key: uint64 (n,), of their random draws.
    """

    polygons: Polygons
    eave_z_m: np.ndarray
    ground_z_m: np.ndarray
    base_z_m: np.ndarray
    key: np.ndarray


def chosen(houses: Houses, thing: int, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Buildings that have such a thing, and uniform draws for each, float64 (n, _DRAWS)."""
    drawn = uniforms(houses.key, thing * 2**20, 1)[:, 0]
    rows = np.flatnonzero((drawn < share) & (np.diff(houses.polygons.polygon_offset) > 0))
    return rows, uniforms(houses.key[rows], thing * 2**20 + 1, _DRAWS)


def between(u: np.ndarray, low: float, high: float) -> np.ndarray:
    return low + u * (high - low)


def across(direction: np.ndarray) -> np.ndarray:
    return np.stack([-direction[..., 1], direction[..., 0]], axis=-1)


def rectangle(middle: np.ndarray, along: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    """Corners (k, 4, 2): middle (k, 2), unit direction (k, 2), half length and half width (k, 2)."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    a = signs[None, :, :1] * half_m[:, None, :1] * along[:, None]
    b = signs[None, :, 1:] * half_m[:, None, 1:] * across(along)[:, None]
    return middle[:, None] + a + b


def edges(polygons: Polygons) -> tuple[np.ndarray, np.ndarray]:
    """Start (n, 2) and end (n, 2) of every edge, aligned with the vertices."""
    following = np.arange(len(polygons.xy_m)) + 1
    ends = polygons.ring_offset[1:] - 1
    filled = np.diff(polygons.ring_offset) > 0
    following[ends[filled]] = polygons.ring_offset[:-1][filled]
    return polygons.xy_m, polygons.xy_m[following]


def beside(houses: Houses, rows: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index of a random edge of each of ``rows`` (longer ones are likelier), its length, its outwards
    normal."""
    start, end = edges(houses.polygons)
    length = np.linalg.norm(end - start, axis=1)
    before = np.concatenate([[0.0], np.cumsum(length)])
    offset = houses.polygons.vertex_offset
    target = before[offset[rows]] + u * (before[offset[rows + 1]] - before[offset[rows]])
    edge = np.clip(np.searchsorted(before, target, side="right") - 1, offset[rows], offset[rows + 1] - 1)
    along = (end - start)[edge] / np.maximum(length[edge], 1e-9)[:, None]
    return edge, length[edge], -across(along)
