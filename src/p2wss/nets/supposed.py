"""Predict the roof between few points with a small network, in numpy; ``benchmarks/completion.py`` trains it."""

import math
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import shapely

from p2wss.nets.clues import (
    MAX_AROUND,
    MAX_POINTS,
    MAX_SIZE_M,
    MAX_VERTICES,
    SCALE_M,
    Clues,
    Features,
    features_of,
)
from p2wss.nets.weights_file import read_metadata
from p2wss.skeleton.compiled import entry, inner

KIND = "completion"
# tolerances in metres with which footprints are simplified until they have few enough vertices
_SIMPLIFY_M = (0.3, 0.5, 1.0, 2.0)
# least and largest number of places at which the roof is predicted, and one per square metre in between; swept
_MIN_PLACES, _MAX_PLACES = 64, 200
_HIDDEN, _EPSILON, _SLACK = -1e4, 1e-5, 1e-6
# the table of GELU: its end, and its steps per unit
_GELU_END, _GELU_STEPS = 6.0, 512
_Weights = dict[str, np.ndarray]


def supposed_roof(polygon: shapely.Polygon, point_m: np.ndarray, around_m: np.ndarray) -> np.ndarray:
    """Places (k, 3) all over a roof, at the heights that the network predicts: medians of its distributions, in whole
    centimetres. (0, 3) for a footprint with too many vertices or larger than the footprints of the training.

    polygon: the footprint. point_m: (m, 3), on the roof, m > 0. around_m: (n, 3), on the roofs around. The longest edge
    of the footprint gives the frame, so that the result turns with the building.
    """
    ring_m = _simple_ring(polygon)
    if ring_m is None:
        return np.zeros((0, 3))
    edge_m = np.roll(ring_m, -1, axis=0) - ring_m
    # the first one of equally long edges, whatever the rounding
    along = edge_m[np.round(np.hypot(*edge_m.T), 2).argmax()]
    cos, sin = along / np.hypot(*along)
    in_frame_m = _turned(ring_m, cos, -sin)
    low_m, high_m = in_frame_m.min(axis=0), in_frame_m.max(axis=0)
    if (high_m - low_m).max() > MAX_SIZE_M:
        return np.zeros((0, 3))
    middle_m = (low_m + high_m) / 2
    place_m = _turned(_grid(low_m, high_m, polygon.area), cos, sin)
    place_m = place_m[shapely.contains_xy(polygon, *place_m.T)]
    away_m = shapely.distance(polygon, shapely.points(around_m[:, :2]))
    around_m = around_m[np.argsort(away_m, kind="stable")[:MAX_AROUND]]
    point_m = point_m[np.linspace(0, len(point_m) - 1, min(len(point_m), MAX_POINTS)).astype(int)]
    mean_z = point_m[:, 2].mean()

    def scaled(each_m: np.ndarray) -> np.ndarray:
        flat = (_turned(each_m, cos, -sin) - middle_m) / SCALE_M
        return np.column_stack([flat, (each_m[:, 2:] - mean_z) / SCALE_M])[None]

    every = [np.ones((1, len(each)), bool) for each in (point_m, around_m, ring_m)]
    clues = Clues(
        scaled(point_m), every[0], scaled(around_m), every[1], scaled(ring_m), every[2], scaled(place_m)
    )
    return np.column_stack([place_m, np.round(mean_z + SCALE_M * _median(features_of(clues)), 2)])


def _turned(place_m: np.ndarray, cos: float, sin: float) -> np.ndarray:
    """Places (k, 2) or (k, 3), turned in plan: (k, 2). No matrix product, whose rounding depends on the processor."""
    x, y = place_m[:, 0], place_m[:, 1]
    return np.column_stack([cos * x - sin * y, sin * x + cos * y])


def _simple_ring(polygon: shapely.Polygon) -> np.ndarray | None:
    for simplify_m in _SIMPLIFY_M:
        exterior = shapely.get_exterior_ring(shapely.orient_polygons(polygon.simplify(simplify_m)))
        ring_m = shapely.get_coordinates(exterior)[:-1]
        if len(ring_m) <= MAX_VERTICES:
            return ring_m
    return None


def _grid(low_m: np.ndarray, high_m: np.ndarray, area_m2: float) -> np.ndarray:
    """Places (k, 2) within a box: a random place in each cell of a grid, as GEOS fails on regular places."""
    gap_m = (area_m2 / np.clip(area_m2, _MIN_PLACES, _MAX_PLACES)) ** 0.5
    count = np.ceil(np.maximum((high_m - low_m) / gap_m - _SLACK, 1)).astype(int)
    step_m = (high_m - low_m) / count
    cell = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, 2)
    return low_m + (cell + np.random.default_rng(0).uniform(0.3, 0.7, cell.shape)) * step_m


@cache
def _weights() -> _Weights:
    """The weights that come with the package. Raises :class:`InputError` if the file is missing or broken."""
    from safetensors.numpy import load_file

    path = Path(str(files("p2wss"))) / "weights" / "completion.safetensors"
    read_metadata(path, KIND)
    return {name: value.astype(float) for name, value in load_file(path).items()}


def _median(features: Features) -> np.ndarray:
    """The medians (q,) of the heights at the places of one building."""
    z, _, logit = mixture_of(features, _weights())
    share = np.exp(logit - logit.max(axis=1, keepdims=True))
    order = np.argsort(z, axis=1, kind="stable")
    below = np.take_along_axis(share, order, axis=1).cumsum(axis=1)
    first = (below >= below[:, -1:] / 2).argmax(axis=1)
    place = np.arange(len(z))
    return np.asarray(z[place, order[place, first]])


def mixture_of(features: Features, weights: _Weights) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(z (q, k), slope (k, 2), logit (q, k)) of the k planes of all tokens at the q places, for the first building of
    ``features``; as ``RoofCompletion`` of ``benchmarks/completion_network.py`` computes them."""
    point, is_own, edge, place, is_token, distance, offset, place_distance, axis, z = (
        each[0] for each in features
    )

    def linear(name: str, x: np.ndarray) -> np.ndarray:
        y = x @ weights[f"{name}.weight"].T
        return y + weights[f"{name}.bias"] if f"{name}.bias" in weights else y

    def norm(name: str, x: np.ndarray) -> np.ndarray:
        x = x - x.mean(axis=-1, keepdims=True)
        x = x / np.sqrt((x**2).mean(axis=-1, keepdims=True) + _EPSILON)
        return x * weights[f"{name}.weight"] + weights[f"{name}.bias"]

    def block(name: str, x: np.ndarray, source: np.ndarray | None, away: np.ndarray) -> np.ndarray:
        normed = norm(f"{name}.norm", x)
        bias = np.where(is_token, -away * weights[f"{name}.decay"][:, None, None], _HIDDEN)
        heads = len(bias)
        query = linear(f"{name}.attention.query", normed).reshape(len(x), heads, -1).swapaxes(0, 1)
        pairs = linear(f"{name}.attention.key_value", normed if source is None else source)
        key, value = pairs.reshape(len(pairs), 2, heads, -1).transpose(1, 2, 0, 3)
        score = query @ key.swapaxes(1, 2) / np.sqrt(query.shape[2]) + bias
        score = np.exp(score - score.max(axis=2, keepdims=True))
        mixed = score / score.sum(axis=2, keepdims=True) @ value
        x = x + linear(f"{name}.attention.out", mixed.swapaxes(0, 1).reshape(x.shape))
        return x + linear(f"{name}.mlp.2", _gelu(linear(f"{name}.mlp.0", norm(f"{name}.mlp_norm", x))))

    kind = weights["kind"]
    x = np.vstack([linear("point", point) + kind[1 - is_own], linear("edge", edge) + kind[2]])
    for name in _blocks("blocks", weights):
        x = block(name, x, None, distance)
    x, y = norm("norm", x), linear("place", place)
    for name in _blocks("place_blocks", weights):
        y = block(name, y, x, place_distance)
    plane = linear("plane.2", _gelu(linear("plane.0", x))).reshape(len(x), 2, 4)
    beside = np.column_stack([-axis[:, 1], axis[:, 0]])
    slope = plane[..., 1:2] * axis[:, None] + plane[..., 2:3] * beside[:, None]
    at_place = z[:, None] + plane[..., 0] + (offset[:, :, None] * slope).sum(axis=-1)
    away = place_distance[..., None]
    of_plane = linear("of_plane", x).reshape(len(x), 2, -1)
    of_place = linear("of_place", norm("place_norm", y))
    pair = np.concatenate([np.abs(offset), away, np.log(away + 0.02), at_place], axis=-1)
    of_pair = np.ascontiguousarray(weights["of_pair.weight"].T)
    choice = _choices(of_plane, of_place, pair, of_pair, weights["choice.weight"][0], _gelu_table())
    choice += weights["choice.bias"]
    logit = np.where(is_token[:, None], choice - away * weights["decay"], _HIDDEN)
    return at_place.reshape(len(y), -1), slope.reshape(-1, 2), logit.reshape(len(y), -1)


def _blocks(name: str, weights: _Weights) -> list[str]:
    return sorted({".".join(each.split(".")[:2]) for each in weights if each.startswith(f"{name}.")})


def _gelu(x: np.ndarray) -> np.ndarray:
    """GELU: x times the share of a standard normal distribution below x. scipy would take a tenth of a second to
    load."""
    return np.asarray(_gelus(x.ravel(), _gelu_table())).reshape(x.shape)


@cache
def _gelu_table() -> np.ndarray:
    """Values of GELU from -6 to 6. Linear interpolation is exact to 4e-7; the error function takes ten times as
    long."""
    x = np.arange(-_GELU_END, _GELU_END + 2 / _GELU_STEPS, 1 / _GELU_STEPS).tolist()
    return np.array([each * (0.5 + 0.5 * math.erf(each / math.sqrt(2.0))) for each in x])


@inner
def _gelu_of(x: float, table: np.ndarray) -> float:
    if not abs(x) < _GELU_END:
        return max(x, 0.0)
    place = (x + _GELU_END) * _GELU_STEPS
    k = int(place)
    return table[k] + (place - k) * (table[k + 1] - table[k])


@entry
def _gelus(x: np.ndarray, table: np.ndarray) -> np.ndarray:
    result = np.empty(len(x))
    for k in range(len(x)):
        result[k] = _gelu_of(x[k], table)
    return result


@entry
def _choices(
    of_plane: np.ndarray,
    of_place: np.ndarray,
    pair: np.ndarray,
    of_pair: np.ndarray,
    choice: np.ndarray,
    table: np.ndarray,
) -> np.ndarray:
    """(q, k, 2): the logits, without bias, of both planes of each token at each place.

    of_plane: (k, 2, h), of_place: (q, h), pair: (q, k, 6), of_pair: (6, h), choice: (h,). Arrays (q, k, 2, h) would be
    20 MB each, and take three times as long.
    """
    num_hidden = len(choice)
    result, both = np.empty((len(of_place), len(of_plane), 2)), np.empty(num_hidden)
    for q in range(len(of_place)):
        for k in range(len(of_plane)):
            both[:] = of_place[q]
            for each in range(len(of_pair)):
                for h in range(num_hidden):
                    both[h] += pair[q, k, each] * of_pair[each, h]
            for plane in range(2):
                total = 0.0
                for h in range(num_hidden):
                    total += choice[h] * _gelu_of(both[h] + of_plane[k, plane, h], table)
                result[q, k, plane] = total
    return result
