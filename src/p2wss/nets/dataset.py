"""Buildings for training and evaluation as ragged arrays, from which padded batches are cut.

Points stay int16 centimetres in one flat array, as in the shards of ``crops``; the points of a batch are cut out
of it, thinned and converted to metres on demand. The array is either a file mapped into memory
(:func:`p2wss.nets.shards.load_dataset`) or a tensor in the memory of a GPU (:class:`ResidentDataset`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numba import njit
from torch import Tensor

from p2wss.data.seeds import generator
from p2wss.nets.batch import Batch

# batches are sorted by length within a window of so many batches, so that few positions are padding
_WINDOW_BATCHES = 8
_MASK_64 = (1 << 64) - 1


class BatchSource(Protocol):
    """Where batches come from."""

    def __len__(self) -> int: ...

    @property
    def num_vertices(self) -> np.ndarray: ...

    def batch(self, index: np.ndarray, num_points: int, seed: int | None) -> Batch:
        """The buildings ``index`` as a padded batch; clouds of more than ``num_points`` are thinned.

        ``seed`` selects the points to keep, for each building independently; without a seed the selection
        depends on the size of the cloud only.
        """


@dataclass(frozen=True)
class TrainingLimits:
    """What a building must satisfy to be trained on. Others are excluded and counted.

    ``max_length_m`` bounds the eave height and the distance of vertices from the centroid of the cloud.
    """

    min_points: int
    max_vertices: int
    max_length_m: float


@dataclass(frozen=True)
class BuildingDataset:
    """Many buildings, ragged, in the memory of the host.

    points_cm: int16 (num_points, 3), local. point_offset: int64 (n + 1,). ground_z_m: float32 (n,), local.
    xy_m: float32 (num_vertices, 2), local exterior
    rings, counter-clockwise. vertex_offset: int64 (n + 1,). angle_deg: float32 (num_vertices,), edge i
    leaves vertex i. height_m: float32 (n,), eave above ``ground_z_m``. num_excluded: buildings per reason.
    folder: the cache that the arrays are mapped from, if any. patch_index: int16 (n, g, k), see
    :func:`p2wss.nets.patch_cache.precompute_patches`.

    Without labels (``labelled=False``) the rings are empty and the heights NaN.
    """

    points_cm: np.ndarray
    point_offset: np.ndarray
    ground_z_m: np.ndarray
    xy_m: np.ndarray
    vertex_offset: np.ndarray
    angle_deg: np.ndarray
    height_m: np.ndarray
    num_excluded: dict[str, int]
    folder: Path | None = None
    patch_index: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.point_offset) - 1

    @property
    def num_vertices(self) -> np.ndarray:
        return np.diff(self.vertex_offset)

    def batch(self, index: np.ndarray, num_points: int, seed: int | None) -> Batch:
        """See :class:`BatchSource`. On the CPU."""
        index = np.asarray(index, np.int64)
        count = self.point_offset[index + 1] - self.point_offset[index]
        width = int(min(count.max(), num_points))
        points = np.empty((len(index), width, 3), np.float32)
        _gather(self.points_cm, self.point_offset, index, _random_states(index, count, seed), points)
        xy, angle, num_vertices = self.rings(index)
        return Batch(
            points=torch.from_numpy(points),
            valid=torch.from_numpy(np.arange(width) < count[:, None]),
            ground_z=torch.from_numpy(self.ground_z_m[index]),
            height=torch.from_numpy(self.height_m[index]),
            xy=torch.from_numpy(xy),
            angle=torch.from_numpy(angle),
            num_vertices=torch.from_numpy(num_vertices),
            patch_index=None if self.patch_index is None else torch.from_numpy(self.patch_index[index]),
        )

    def rings(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """xy (b, n, 2), angle (b, n), padded with 0, and num_vertices (b,) of the buildings ``index``."""
        first = self.vertex_offset[index]
        num_vertices = self.vertex_offset[index + 1] - first
        position = np.arange(max(int(num_vertices.max()), 1))
        inside = position < num_vertices[:, None]
        vertex = np.where(inside, first[:, None] + position, 0)
        if not len(self.xy_m):
            return np.zeros((*inside.shape, 2), np.float32), np.zeros(inside.shape, np.float32), num_vertices
        return self.xy_m[vertex] * inside[..., None], self.angle_deg[vertex] * inside, num_vertices


class ResidentDataset:
    """The clouds of a :class:`BuildingDataset` in the memory of a device, where batches are cut too."""

    def __init__(self, dataset: BuildingDataset, device: torch.device) -> None:
        self._dataset = dataset
        self._device = device
        self._points_cm = torch.from_numpy(np.array(dataset.points_cm)).to(device)
        self._patch_index: Tensor | None = None
        if dataset.patch_index is not None:
            self._patch_index = torch.from_numpy(np.array(dataset.patch_index)).to(device)

    def __len__(self) -> int:
        return len(self._dataset)

    @property
    def num_vertices(self) -> np.ndarray:
        return self._dataset.num_vertices

    def batch(self, index: np.ndarray, num_points: int, seed: int | None) -> Batch:
        """See :class:`BatchSource`. With a seed the points are drawn from the same distribution as on the CPU, but
        they are others."""
        if seed is None:
            return self._dataset.batch(index, num_points, None).to(self._device)
        dataset, device = self._dataset, self._device
        index = np.asarray(index, np.int64)
        first = torch.from_numpy(dataset.point_offset[index]).to(device)
        count = torch.from_numpy(dataset.point_offset[index + 1]).to(device) - first
        widest = int((dataset.point_offset[index + 1] - dataset.point_offset[index]).max())
        position = torch.arange(widest, device=device)
        valid = position < count[:, None]
        row = first[:, None] + position
        if widest > num_points:
            random = torch.Generator(device).manual_seed(seed)
            key = torch.rand(valid.shape, device=device, generator=random).masked_fill(~valid, 2)
            selected = key.topk(num_points, largest=False, sorted=False)[1].sort(1)[0]
            row, valid = row.gather(1, selected), valid.gather(1, selected)
        points = self._points_cm[row.masked_fill(~valid, 0)] * 0.01
        patch_index = self._patch_index
        if patch_index is not None:
            patch_index = patch_index[torch.from_numpy(index).to(device)]
        xy, angle, num_vertices = map(torch.from_numpy, dataset.rings(index))
        return Batch(
            points=points * valid[..., None],
            valid=valid,
            ground_z=torch.from_numpy(dataset.ground_z_m[index]).to(device),
            height=torch.from_numpy(dataset.height_m[index]).to(device),
            xy=xy.to(device),
            angle=angle.to(device),
            num_vertices=num_vertices.to(device),
            patch_index=patch_index,
        )


def thin(count: int, num_points: int) -> np.ndarray:
    """Indices of at most ``num_points`` of ``count`` points; the same for the same count."""
    selected = np.empty(min(count, num_points), np.int64)
    _select(count, _random_states(np.zeros(1, np.int64), np.array([count]), None)[0], selected)
    return selected


def _random_states(index: np.ndarray, count: np.ndarray, seed: int | None) -> np.ndarray:
    """uint64 (b,): the initial state of the random numbers of each cloud."""
    if seed is None:
        return count.astype(np.uint64) * np.uint64(0xD1342543DE82EF95)
    return index.astype(np.uint64) * np.uint64(0xD1342543DE82EF95) + np.uint64(seed & _MASK_64)


@njit(cache=True, nogil=True)
def _select(count: int, state: Any, selected: np.ndarray) -> None:
    """Fill ``selected`` with a random subset of ``range(count)``, each equally likely, in ascending order.

    Selection sampling (Knuth, The Art of Computer Programming, algorithm 3.4.2 S); random numbers: splitmix64.
    """
    size = len(selected)
    num_selected = 0
    for i in range(count):
        if count - i > size - num_selected:
            state += np.uint64(0x9E3779B97F4A7C15)
            z = state
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z = z ^ (z >> np.uint64(31))
            if np.float64(z >> np.uint64(11)) * 2.0**-53 * (count - i) >= size - num_selected:
                continue
        selected[num_selected] = i
        num_selected += 1
        if num_selected == size:
            return


@njit(cache=True, nogil=True)
def _gather(
    points_cm: np.ndarray, offset: np.ndarray, index: np.ndarray, state: np.ndarray, points: np.ndarray
) -> None:
    """Fill ``points`` (b, p, 3) with the selected points in metres, and padding with zeros."""
    width = points.shape[1]
    selected = np.empty(width, np.int64)
    metre = np.float32(0.01)
    for row in range(len(index)):
        first = offset[index[row]]
        count = offset[index[row] + 1] - first
        if count > width:
            _select(count, state[row], selected)
            for i in range(width):
                for axis in range(3):
                    points[row, i, axis] = metre * points_cm[first + selected[i], axis]
        else:
            for i in range(count):
                for axis in range(3):
                    points[row, i, axis] = metre * points_cm[first + i, axis]
            points[row, count:] = 0


class BatchSampler:
    """Which buildings the batch of each step holds: a function of (seed, step) alone.

    An epoch visits every building once; the remainder that fills no batch waits for the next epoch.
    """

    def __init__(self, num_vertices: np.ndarray, batch_size: int, seed: int) -> None:
        self.num_vertices, self.batch_size, self.seed = num_vertices, batch_size, seed
        self._epoch = -1
        self._batches: list[np.ndarray] = []

    def batch(self, step: int) -> np.ndarray:
        """Indices (b,) of the buildings of ``step``."""
        epoch, position = divmod(step, max(len(self.num_vertices) // self.batch_size, 1))
        if epoch != self._epoch:
            rng = generator(self.seed, "order", epoch)
            self._epoch = epoch
            self._batches = similar_length_batches(self.num_vertices, self.batch_size, rng)
        return self._batches[position]


def similar_length_batches(
    num_vertices: np.ndarray, batch_size: int, rng: np.random.Generator
) -> list[np.ndarray]:
    """The batches of one epoch, in random order, each of buildings with similar numbers of vertices."""
    order = rng.permutation(len(num_vertices))
    batch_size = min(batch_size, len(order))
    order = order[: len(order) // batch_size * batch_size]
    window_size = batch_size * _WINDOW_BATCHES
    batches = []
    for first in range(0, len(order), window_size):
        window = order[first : first + window_size]
        window = window[np.argsort(num_vertices[window], kind="stable")]
        # random within a batch: the auxiliary losses are those of its first rows
        batches += [rng.permutation(batch) for batch in np.split(window, len(window) // batch_size)]
    return [batches[i] for i in rng.permutation(len(batches))]
