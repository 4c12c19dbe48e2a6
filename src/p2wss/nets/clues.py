"""What is known of a roof with few points, as numbers for the network that supposes the rest. Imports no torch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# what a building may have at most in training, and is thinned or simplified to: points on it, and around it, vertices
MAX_POINTS, MAX_AROUND, MAX_VERTICES = 64, 24, 24
# metres of a unit of the network, and of the longest building in training
SCALE_M, MAX_SIZE_M = 10.0, 90.0
NUM_FREQUENCIES = 6
# units: lowest frequency, and a distance that is none
_HALF_WAVE, _FAR, _TINY = 8.0, 9.0, 1e-8


class Clues(NamedTuple):
    """Of b buildings, in units of 10 m, in the frame of the longest edge, z above the mean of the building's points.

    point: (b, p, 3), on the building. around: (b, a, 3), on the roofs around. ring: (b, v, 2), the footprint. place:
    (b, q, 2), where the roof is asked for. is_point, is_around, is_vertex: false for padding.
    """

    point: np.ndarray
    is_point: np.ndarray
    around: np.ndarray
    is_around: np.ndarray
    ring: np.ndarray
    is_vertex: np.ndarray
    place: np.ndarray


class Features(NamedTuple):
    """What the layers read. A token is a point, a point around, or an edge: t = p + a + v.

    point: (b, p + a, 41). is_own: (b, p + a), 1 for points on the building. edge: (b, v, 56). place: (b, q, 26).
    is_token: bool (b, t). distance: (b, t, t), between tokens. offset: (b, q, t, 2) and place_distance: (b, q, t), from
    tokens to places. axis: (b, t, 2), the direction in which the slope of a token's planes is stated. z: (b, t).
    """

    point: np.ndarray
    is_own: np.ndarray
    edge: np.ndarray
    place: np.ndarray
    is_token: np.ndarray
    distance: np.ndarray
    offset: np.ndarray
    place_distance: np.ndarray
    axis: np.ndarray
    z: np.ndarray


def features_of(clues: Clues) -> Features:
    """The features of clues."""
    ring, is_vertex = clues.ring, clues.is_vertex
    following = (np.arange(ring.shape[1]) + 1) % np.maximum(is_vertex.sum(axis=1), 1)[:, None]
    end = np.take_along_axis(ring, following[..., None], axis=1)
    along = end - ring
    length = np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-4)
    doubled_area = ((ring[..., 0] * end[..., 1] - ring[..., 1] * end[..., 0]) * is_vertex).sum(axis=1)
    outwards = np.stack([along[..., 1], -along[..., 0]], axis=-1) / length
    outwards *= np.sign(doubled_area)[:, None, None]

    def from_edges(place: np.ndarray) -> np.ndarray:
        offset = place[:, :, None] - ring[:, None]
        share = np.clip((offset * along[:, None]).sum(axis=-1) / length[:, None, :, 0] ** 2, 0, 1)
        away = _length(offset - share[..., None] * along[:, None])
        return np.where(is_vertex[:, None], away, _FAR)

    point = np.concatenate([clues.point, clues.around], axis=1)
    num_own, num_points = clues.point.shape[1], point.shape[1]
    count = np.log(np.maximum(clues.is_point.sum(axis=1), 1)) / 4
    at_m = np.concatenate([point[..., :2], (ring + end) / 2], axis=1)
    to_edge = from_edges(at_m)
    distance = np.concatenate([_length(at_m[:, :, None] - point[:, None, :, :2]), to_edge], axis=2)
    offset = clues.place[:, :, None] - at_m[:, None]
    place_distance = np.concatenate([_length(offset[:, :, :num_points]), from_edges(clues.place)], axis=2)
    axis = np.concatenate([np.broadcast_to([1.0, 0.0], point[..., :2].shape), outwards], axis=1)
    counted = np.broadcast_to(count[:, None, None], (*at_m.shape[:2], 1))
    nearest = to_edge[:, :num_points].min(axis=2, keepdims=True)
    return Features(
        np.concatenate([_waves(point), nearest, counted[:, :num_points]], axis=-1),
        np.broadcast_to(np.arange(num_points) < num_own, point.shape[:2]).astype(int),
        np.concatenate(
            [_waves(np.concatenate([ring, end], -1)), outwards, length, counted[:, num_points:]], axis=-1
        ),
        _waves(clues.place),
        np.concatenate([clues.is_point, clues.is_around, is_vertex], axis=1),
        distance,
        offset,
        place_distance,
        axis,
        np.concatenate([point[..., 2], np.zeros(ring.shape[:2])], axis=1),
    )


def _length(vector: np.ndarray) -> np.ndarray:
    return np.sqrt((vector**2).sum(axis=-1) + _TINY)


def _waves(value: np.ndarray) -> np.ndarray:
    """Coordinates (.., c), and sines and cosines of them, (.., 13 c)."""
    angle = value[..., None] * (np.pi / _HALF_WAVE * 2.0 ** np.arange(NUM_FREQUENCIES))
    flat = (*value.shape[:-1], -1)
    return np.concatenate([value, np.sin(angle).reshape(flat), np.cos(angle).reshape(flat)], axis=-1)
