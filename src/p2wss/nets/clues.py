"""The input features of the network that predicts a roof from few points. Imports no torch."""

from typing import Any, NamedTuple, TypeAlias

import numpy as np

# largest numbers in training of points on a building, of points around it, and of vertices; a building with more is
# thinned or simplified
MAX_POINTS, MAX_AROUND, MAX_VERTICES = 64, 24, 24
# metres of a unit of the network, and of the longest building in training
SCALE_M, MAX_SIZE_M = 10.0, 90.0
# half of the longest wave and the distance to padding, in units of the network; a term that keeps roots above 0
_HALF_WAVE, _FAR, _TINY = 8.0, 9.0, 1e-8
# buildings at a time, so that their pairs stay in the cache of a processor: all at once take twice as long, except on a
# GPU
_AT_ONCE = 64
_WAVES = (np.pi / _HALF_WAVE * 2.0 ** np.arange(6)).tolist()

# an array of numpy or, in training, a tensor of torch
Array: TypeAlias = Any


class Clues(NamedTuple):
    """What is known of b buildings, in units of 10 m, in the frame of the longest edge, z above the mean of the
    building's points.

    point: (b, p, 3), on the building. around: (b, a, 3), on the roofs around. ring: (b, v, 2), the footprint. place:
    (b, q, 2), where the roof is predicted. is_point, is_around, is_vertex: false for padding.
    """

    point: Array
    is_point: Array
    around: Array
    is_around: Array
    ring: Array
    is_vertex: Array
    place: Array


class Features(NamedTuple):
    """What the layers read. A token is a point, a point around, or an edge: t = p + a + v.

    point: (b, p + a, 41). is_own: (b, p + a), 1 for points on the building. edge: (b, v, 56). place: (b, q, 26).
    is_token: bool (b, t). distance: (b, t, t), between tokens. offset: (b, q, t, 2) and place_distance: (b, q, t), from
    tokens to places. axis: (b, t, 2), the direction along which a token states the slope of its planes. z: (b, t), the
    height of a token, 0 for an edge.
    """

    point: Array
    is_own: Array
    edge: Array
    place: Array
    is_token: Array
    distance: Array
    offset: Array
    place_distance: Array
    axis: Array
    z: Array


def features_of(clues: Clues, xp: Any = np) -> Features:
    """The features of clues, as arrays, or as tensors if the clues are tensors and ``xp`` is torch."""
    num = len(clues.ring)
    size = num if getattr(clues.ring, "is_cuda", False) else _AT_ONCE
    rows = [slice(first, first + size) for first in range(0, num, size)]
    parts = [_features_at_once(Clues(*(each[part] for each in clues)), xp) for part in rows]
    return Features(*map(xp.concatenate, zip(*parts, strict=True)))


def _features_at_once(clues: Clues, xp: Any) -> Features:
    ring, is_vertex = clues.ring, clues.is_vertex
    # from 0 and from 1, on the device of the ring
    row, position = (xp.cumsum(is_vertex | True, axis=axis) for axis in (0, 1))
    following = position % xp.clip(is_vertex.sum(axis=1), 1, None)[:, None]
    end = ring[row - 1, following]
    along = end - ring
    length = xp.clip(xp.linalg.norm(along, axis=-1, keepdims=True), 1e-4, None)
    doubled_area = ((ring[..., 0] * end[..., 1] - ring[..., 1] * end[..., 0]) * is_vertex).sum(axis=1)
    outwards = xp.stack([along[..., 1], -along[..., 0]], axis=-1) / length
    outwards = outwards * xp.sign(doubled_area)[:, None, None]

    def from_edges(place: Array) -> Array:
        x, y = (place[..., axis, None] - ring[:, None, :, axis] for axis in (0, 1))
        x_along, y_along = (along[:, None, :, axis] for axis in (0, 1))
        share = xp.clip((x * x_along + y * y_along) / length[:, None, :, 0] ** 2, 0, 1)
        away = _length(x - share * x_along, y - share * y_along, xp)
        return xp.where(is_vertex[:, None], away, _FAR)

    point = xp.concatenate([clues.point, clues.around], axis=1)
    num_points = point.shape[1]
    count = xp.log(xp.clip(clues.is_point.sum(axis=1), 1, None)) / 4
    at_m = xp.concatenate([point[..., :2], (ring + end) / 2], axis=1)
    to_edge = from_edges(at_m)
    x, y = (at_m[..., axis, None] - point[:, None, :, axis] for axis in (0, 1))
    distance = xp.concatenate([_length(x, y, xp), to_edge], axis=2)
    x, y = (clues.place[..., axis, None] - at_m[:, None, :, axis] for axis in (0, 1))
    offset = xp.stack([x, y], axis=-1)
    to_points = _length(x[..., :num_points], y[..., :num_points], xp)
    place_distance = xp.concatenate([to_points, from_edges(clues.place)], axis=2)
    ahead = xp.stack([xp.ones_like(point[..., 0]), xp.zeros_like(point[..., 0])], axis=-1)
    counted = xp.broadcast_to(count[:, None, None], (*at_m.shape[:2], 1))
    nearest = xp.amin(to_edge[:, :num_points], axis=2, keepdims=True)
    return Features(
        xp.concatenate([_waves(point, xp), nearest, counted[:, :num_points]], axis=-1),
        xp.concatenate([clues.is_point | True, clues.is_around & False], axis=1) * 1,
        xp.concatenate(
            [
                _waves(xp.concatenate([ring, end], axis=-1), xp),
                outwards,
                length,
                counted[:, num_points:],
            ],
            axis=-1,
        ),
        _waves(clues.place, xp),
        xp.concatenate([clues.is_point, clues.is_around, is_vertex], axis=1),
        distance,
        offset,
        place_distance,
        xp.concatenate([ahead, outwards], axis=1),
        xp.concatenate([point[..., 2], xp.zeros_like(ring[..., 0])], axis=1),
    )


def _length(x: Array, y: Array, xp: Any) -> Array:
    """Lengths of vectors. Changes ``x`` and ``y``: memory for new arrays would take longer than the sums."""
    x *= x
    y *= y
    x += y
    x += _TINY
    return xp.sqrt(x)


def _waves(value: Array, xp: Any) -> Array:
    """Coordinates (.., c), and sines and cosines of them, (.., 13 c)."""
    angle = xp.stack([value * each for each in _WAVES], axis=-1)
    flat = (*value.shape[:-1], -1)
    return xp.concatenate([value, xp.sin(angle).reshape(flat), xp.cos(angle).reshape(flat)], axis=-1)
