"""Buildings for training and evaluation as ragged arrays, from which padded batches are cut.

Points stay int16 centimetres in one flat array, as in the shards of ``crops``; the points of a batch are cut out
of it, thinned and converted to metres on demand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from p2wss.config import Dvae, Model
from p2wss.data.seeds import generator
from p2wss.nets.batch import SEED_STRIDE, Batch, cut

# buildings are sorted by length within a window of this many batches, so that little is padding
_WINDOW_BATCHES = 8


@dataclass(frozen=True)
class TrainingLimits:
    """What a building must satisfy to be trained on. Other buildings are excluded and counted.

    ``max_length_m`` bounds the eave height and the distance of vertices from the centroid of the cloud.
    """

    min_points: int
    max_vertices: int
    max_length_m: float


def training_limits(config: Model, dvae_config: Dvae) -> TrainingLimits:
    """The limits within which every augmentation keeps a building representable in tokens."""
    largest_m = 1000.0 if config.hundreds else 100.0
    # 0.9, because the centroid of a subsampled cloud is not that of the whole one
    length_m = 0.9 * (largest_m / max(config.augmentation.scale[1], 1.0)) - config.augmentation.lift_m
    return TrainingLimits(dvae_config.min_points, config.max_vertices, length_m)


@dataclass(frozen=True)
class BuildingDataset:
    """Many buildings, ragged.

    points_cm: int16 (num_points, 3), local. point_offset: int64 (n + 1,). ground_z_m: float32 (n,), local. xy_m:
    float32 (num_vertices, 2), local exterior rings, counter-clockwise. vertex_offset: int64 (n + 1,). angle_deg:
    float32 (num_vertices,), edge i leaves vertex i. height_m: float32 (n,), eave above ``ground_z_m``. num_excluded:
    buildings per reason. num_on_building: int64 (n,), how many points of each cloud are on the building; they are its
    first points. Without labels this is 0, the rings are empty and the heights NaN.
    """

    points_cm: np.ndarray
    point_offset: np.ndarray
    ground_z_m: np.ndarray
    xy_m: np.ndarray
    vertex_offset: np.ndarray
    angle_deg: np.ndarray
    height_m: np.ndarray
    num_on_building: np.ndarray
    num_excluded: dict[str, int]

    def __len__(self) -> int:
        return len(self.point_offset) - 1

    @property
    def num_vertices(self) -> np.ndarray:
        return np.diff(self.vertex_offset)

    def cloud_cm(self, building: np.integer) -> np.ndarray:
        """The points (n, 3) of a building."""
        return self.points_cm[self.point_offset[building] : self.point_offset[building + 1]]

    def ring_m(self, building: np.integer) -> np.ndarray:
        """The exterior ring (n, 2) of a building."""
        return self.xy_m[self.vertex_offset[building] : self.vertex_offset[building + 1]]

    def edge_angles_deg(self, building: np.integer) -> np.ndarray:
        """The angle (n,) of each edge of a building."""
        return self.angle_deg[self.vertex_offset[building] : self.vertex_offset[building + 1]]

    def sample(self, count: int) -> np.ndarray:
        """Indices of at most ``count`` buildings, evenly spaced, so that all regions of a data set are among them."""
        count = min(len(self), count)
        return np.arange(count) * len(self) // count

    def batch(
        self, index: np.ndarray, num_points: int, seed: int | None, on_building: np.ndarray | None = None
    ) -> Batch:
        """The buildings ``index`` as a padded batch on the CPU; clouds of more than ``num_points`` are thinned.

        ``seed`` selects the points to keep, for each building independently; without a seed the selection depends on
        the size of the cloud only. on_building: bool (b,), the buildings of which only points on the building are used.
        """
        num_all = np.diff(self.point_offset)[index]
        if on_building is not None:
            num_all = np.where(on_building, self.num_on_building[index], num_all)
        states = num_all if seed is None else index
        seeds = states.astype(np.uint64) * np.uint64(SEED_STRIDE) + np.uint64(seed or 0)
        points = cut(self.points_cm, self.point_offset[index], num_all, num_points, seeds)
        num_vertices = self.num_vertices[index]
        is_vertex = np.arange(max(num_vertices.max(), 1)) < num_vertices[:, None]
        vertex = (self.vertex_offset[index][:, None] + np.arange(is_vertex.shape[1]))[is_vertex]
        xy, angle = np.zeros((*is_vertex.shape, 2), np.float32), np.zeros(is_vertex.shape, np.float32)
        xy[is_vertex], angle[is_vertex] = self.xy_m[vertex], self.angle_deg[vertex]
        return Batch(
            points=torch.from_numpy(points),
            valid=torch.from_numpy(np.arange(points.shape[1]) < num_all[:, None]),
            ground_z=torch.from_numpy(self.ground_z_m[index]),
            height=torch.from_numpy(self.height_m[index]),
            xy=torch.from_numpy(xy),
            angle=torch.from_numpy(angle),
            num_vertices=torch.from_numpy(num_vertices),
        )


class BatchSampler:
    """Which buildings the batch of each step holds: a function of (seed, step) alone.

    An epoch visits every building once, except the remainder that fills no batch.
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
        # random within a batch, as the auxiliary losses use its first rows
        batches += [rng.permutation(batch) for batch in np.split(window, len(window) // batch_size)]
    return [batches[i] for i in rng.permutation(len(batches))]
