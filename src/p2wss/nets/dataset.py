"""Buildings for training and evaluation: from the shards of ``crops`` to padded batches.

Points stay int16 centimetres in one flat array, as in the shards; a batch is cut out of it, thinned and
turned into metres when it is needed. The array is a file that is mapped into memory, decoded once from the
shards (:func:`load`), or a tensor in the memory of a GPU (:class:`ResidentBuildings`).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numba import njit
from torch import Tensor

from p2wss.data.seeds import generator
from p2wss.nets.augment import Batch

log = logging.getLogger("p2wss")

_CLOUD_COLUMNS = ["split", "num_points", "origin_z_m", "x_cm", "y_cm", "z_cm", "ground_z_m"]
_LABEL_COLUMNS = ["footprint_xy_m", "ring_offset", "eave_height_m", "label_ground_z_m", "angle_deg"]
# share of a cloud's points that lie below the ground where the cloud has no ground of its own
_GROUND_QUANTILE = 0.02
# batches are sorted by length within a window of so many, so that little of them is padding
_BUCKET_WINDOW = 8
# clouds whose patches are found together
_PATCH_BATCH = 128
_PROGRESS_EVERY_S = 10.0
# names the layout of the decoded files: other numbers are decoded anew
_CACHE_VERSION = 1
_MASK = (1 << 64) - 1


class Source(Protocol):
    """Where batches come from."""

    def __len__(self) -> int: ...

    @property
    def num_vertices(self) -> np.ndarray: ...

    def batch(self, index: np.ndarray, num_points: int, seed: int | None) -> Batch:
        """The buildings ``index`` as a padded batch; clouds of more than ``num_points`` are thinned.

        ``seed`` draws the points kept, for each building on its own; without one they depend on the size of
        the cloud alone.
        """


@dataclass(frozen=True)
class Limits:
    """What a building must satisfy to be trained on. Others are left out and counted.

    ``max_length_m`` bounds the gutter height and the distance of vertices from the middle of the cloud.
    """

    min_points: int
    max_vertices: int
    max_length_m: float


@dataclass(frozen=True)
class Buildings:
    """Many buildings, ragged.

    points_cm: int16 (num_points, 3), local. point_offset: int64 (n + 1,). ground_z_m: float32 (n,), local;
    where the crop has none, :func:`ground_from_points`. xy_m: float32 (num_vertices, 2), local exterior
    rings, counter-clockwise. vertex_offset: int64 (n + 1,). angle_deg: float32 (num_vertices,), edge i
    leaves vertex i. height_m: float32 (n,), gutter above ``ground_z_m``. num_left_out: per reason.
    folder: from which the arrays are mapped, if they are. patch_index: int16 (n, g, k), see
    :func:`with_patches`.

    Without labels (``labelled=False``) the rings are empty and the heights NaN.
    """

    points_cm: np.ndarray
    point_offset: np.ndarray
    ground_z_m: np.ndarray
    xy_m: np.ndarray
    vertex_offset: np.ndarray
    angle_deg: np.ndarray
    height_m: np.ndarray
    num_left_out: dict[str, int]
    folder: Path | None = None
    patch_index: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.point_offset) - 1

    @property
    def num_vertices(self) -> np.ndarray:
        return np.diff(self.vertex_offset)

    def batch(self, index: np.ndarray, num_points: int, seed: int | None) -> Batch:
        """See :class:`Source`. On the CPU."""
        index = np.asarray(index, np.int64)
        count = self.point_offset[index + 1] - self.point_offset[index]
        width = int(min(count.max(), num_points))
        points = np.empty((len(index), width, 3), np.float32)
        _gather(self.points_cm, self.point_offset, index, _states(index, count, seed), points)
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
        which = np.where(inside, first[:, None] + position, 0)
        if not len(self.xy_m):
            return np.zeros((*inside.shape, 2), np.float32), np.zeros(inside.shape, np.float32), num_vertices
        return self.xy_m[which] * inside[..., None], self.angle_deg[which] * inside, num_vertices


class ResidentBuildings:
    """The clouds of :class:`Buildings` in the memory of a device, where batches are cut too."""

    def __init__(self, buildings: Buildings, device: torch.device) -> None:
        self._buildings = buildings
        self._device = device
        self._points_cm = torch.from_numpy(np.array(buildings.points_cm)).to(device)
        self._patch_index: Tensor | None = None
        if buildings.patch_index is not None:
            self._patch_index = torch.from_numpy(np.array(buildings.patch_index)).to(device)

    def __len__(self) -> int:
        return len(self._buildings)

    @property
    def num_vertices(self) -> np.ndarray:
        return self._buildings.num_vertices

    def batch(self, index: np.ndarray, num_points: int, seed: int | None) -> Batch:
        """See :class:`Source`. With a seed other points are kept than on the CPU, from the same law."""
        if seed is None:
            return self._buildings.batch(index, num_points, None).to(self._device)
        own, device = self._buildings, self._device
        index = np.asarray(index, np.int64)
        first = torch.from_numpy(own.point_offset[index]).to(device)
        count = torch.from_numpy(own.point_offset[index + 1]).to(device) - first
        widest = int((own.point_offset[index + 1] - own.point_offset[index]).max())
        position = torch.arange(widest, device=device)
        valid = position < count[:, None]
        which = first[:, None] + position
        if widest > num_points:
            random = torch.Generator(device).manual_seed(seed)
            key = torch.rand(valid.shape, device=device, generator=random).masked_fill(~valid, 2)
            order = key.topk(num_points, largest=False, sorted=False)[1].sort(1)[0]
            which, valid = which.gather(1, order), valid.gather(1, order)
        points = self._points_cm[which.masked_fill(~valid, 0)] * 0.01
        xy, angle, num_vertices = map(torch.from_numpy, own.rings(index))
        return Batch(
            points=points * valid[..., None],
            valid=valid,
            ground_z=torch.from_numpy(own.ground_z_m[index]).to(device),
            height=torch.from_numpy(own.height_m[index]).to(device),
            xy=xy.to(device),
            angle=angle.to(device),
            num_vertices=num_vertices.to(device),
            patch_index=None
            if self._patch_index is None
            else self._patch_index[torch.from_numpy(index).to(device)],
        )


def thin(count: int, num_points: int) -> np.ndarray:
    """Indices of at most ``num_points`` of ``count`` points; the same for the same count."""
    chosen = np.empty(min(count, num_points), np.int64)
    _select(count, _states(np.zeros(1, np.int64), np.array([count]), None)[0], chosen)
    return chosen


def _states(index: np.ndarray, count: np.ndarray, seed: int | None) -> np.ndarray:
    """uint64 (b,): where the random numbers of each cloud begin."""
    if seed is None:
        return count.astype(np.uint64) * np.uint64(0xD1342543DE82EF95)
    return index.astype(np.uint64) * np.uint64(0xD1342543DE82EF95) + np.uint64(seed & _MASK)


@njit(cache=True, nogil=True)
def _select(count: int, state: Any, chosen: np.ndarray) -> None:
    """Every subset of ``len(chosen)`` of ``count`` alike (selection sampling, Knuth; random: splitmix64)."""
    wanted = len(chosen)
    taken = 0
    for i in range(count):
        if count - i > wanted - taken:
            state += np.uint64(0x9E3779B97F4A7C15)
            z = state
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z = z ^ (z >> np.uint64(31))
            if np.float64(z >> np.uint64(11)) * 2.0**-53 * (count - i) >= wanted - taken:
                continue
        chosen[taken] = i
        taken += 1
        if taken == wanted:
            return


@njit(cache=True, nogil=True)
def _gather(
    points_cm: np.ndarray, offset: np.ndarray, index: np.ndarray, state: np.ndarray, points: np.ndarray
) -> None:
    """Fill ``points`` (b, p, 3) with the chosen points in metres, and zeros."""
    width = points.shape[1]
    chosen = np.empty(width, np.int64)
    metre = np.float32(0.01)
    for row in range(len(index)):
        first = offset[index[row]]
        count = offset[index[row] + 1] - first
        if count > width:
            _select(count, state[row], chosen)
            for i in range(width):
                for axis in range(3):
                    points[row, i, axis] = metre * points_cm[first + chosen[i], axis]
        else:
            for i in range(count):
                for axis in range(3):
                    points[row, i, axis] = metre * points_cm[first + i, axis]
            points[row, count:] = 0


def ground_from_points(z: np.ndarray) -> float:
    """Ground under a cloud that tells none: a low quantile of its heights (n,)."""
    return float(np.quantile(z, _GROUND_QUANTILE))


def batches(num_vertices: np.ndarray, batch_size: int, rng: np.random.Generator) -> list[np.ndarray]:
    """One epoch: every building once (the remainder waits for the next epoch), similar lengths together."""
    order = rng.permutation(len(num_vertices))
    batch_size = min(batch_size, len(order))
    order = order[: len(order) // batch_size * batch_size]
    window = batch_size * _BUCKET_WINDOW
    cut = []
    for first in range(0, len(order), window):
        part = order[first : first + window]
        part = part[np.argsort(num_vertices[part], kind="stable")]
        # within a batch the order is random: the first rows are those of the auxiliary losses
        cut += [rng.permutation(batch) for batch in np.split(part, len(part) // batch_size)]
    return [cut[i] for i in rng.permutation(len(cut))]


class Order:
    """Which buildings the batch of each step holds: a function of (seed, step) alone."""

    def __init__(self, num_vertices: np.ndarray, batch_size: int, seed: int) -> None:
        self.num_vertices, self.batch_size, self.seed = num_vertices, batch_size, seed
        self._epoch = -1
        self._batches: list[np.ndarray] = []

    def batch(self, step: int) -> np.ndarray:
        epoch, within = divmod(step, max(len(self.num_vertices) // self.batch_size, 1))
        if epoch != self._epoch:
            rng = generator(self.seed, "order", epoch)
            self._epoch, self._batches = epoch, batches(self.num_vertices, self.batch_size, rng)
        return self._batches[within]


_FLAT = ("ground_z_m", "xy_m", "angle_deg", "height_m")


_OFFSETS = ("point_offset", "vertex_offset")
