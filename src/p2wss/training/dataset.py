"""Buildings for training and evaluation as ragged arrays, from which padded batches are cut.

Points stay int16 centimetres in one flat array, as in the shards of ``crops``; the points of a batch are cut out
of it, thinned and converted to metres on demand. When shards are read, the points go into a temporary file.
"""

import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import shapely
import torch

from p2wss.config import Dvae, Model
from p2wss.data import reasons
from p2wss.data.manifest import read_manifest
from p2wss.data.points import points_on_building
from p2wss.data.seeds import generator
from p2wss.nets.batch import SEED_STRIDE, Batch, cut
from p2wss.storage import files
from p2wss.storage.messages import InputError, writing
from p2wss.storage.schemas.crops import CROPS, SIMULATED

# buildings are sorted by length within a window of this many batches, so that little is padding
_WINDOW_BATCHES = 8
_CLOUD_COLUMNS = [
    "split",
    "tile",
    "building_id",
    "num_points",
    "origin_z_m",
    "x_cm",
    "y_cm",
    "z_cm",
    "classification",
    "ground_z_m",
]
_LABEL_COLUMNS = ["footprint_xy_m", "ring_offset", "eave_height_m", "label_terrain_z_m", "angle_deg"]


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


def load_dataset(
    manifest: Path,
    splits: Sequence[str],
    limits: TrainingLimits,
    labelled: bool,
    include_real: bool = False,
    folder: Path | None = None,
) -> BuildingDataset:
    """Buildings of the ``splits`` from the shards that ``manifest`` lists.

    ``include_real`` adds real LiDAR, which has no labels, to an unlabelled dataset. The points are mapped from a file
    without a name on the disk of ``folder``, or where the system keeps temporary files: no more than the points of one
    shard are ever in memory. Raises :class:`InputError` for a broken manifest or shard, a full disk, or when no
    building remains.
    """
    listing = read_manifest(manifest)
    excluded: Counter[str] = Counter()
    parts = []
    with writing(f"the points of {manifest}: temporary file"), tempfile.TemporaryFile(dir=folder) as file:
        for shard in listing.shards:
            purposes = splits if shard.dataset == SIMULATED else ["dvae"]
            if shard.dataset != SIMULATED and (labelled or not include_real):
                continue
            select = partial(listing.select, dataset=shard.dataset, purposes=purposes)
            part = _read_shard(shard.verified(), select, limits, labelled, excluded)
            file.write(part.points_cm.tobytes())
            parts.append(replace(part, points_cm=part.points_cm[:0]))
        if not any(map(len, parts)):
            raise InputError(
                f"{manifest}: no building of split {' or '.join(splits)} can be used"
                + (f" (excluded: {_counts(excluded)})" if excluded else "")
            )
        file.flush()
        points = np.memmap(file, np.int16, "r").view(np.ndarray).reshape(-1, 3)

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    return BuildingDataset(
        points_cm=points,
        point_offset=_offsets(np.concatenate([np.diff(part.point_offset) for part in parts])),
        ground_z_m=joined("ground_z_m"),
        xy_m=joined("xy_m"),
        vertex_offset=_offsets(joined("num_vertices")),
        angle_deg=joined("angle_deg"),
        height_m=joined("height_m"),
        num_on_building=joined("num_on_building"),
        num_excluded=dict(excluded),
    )


def describe(dataset: BuildingDataset) -> str:
    """Numbers of buildings, points and exclusions in one line for the log."""
    text = f"{len(dataset)} buildings, {len(dataset.points_cm)} points"
    return text + (f"; excluded: {_counts(dataset.num_excluded)}" if dataset.num_excluded else "")


def _read_shard(
    path: Path,
    select: Callable[[pa.Table], np.ndarray],
    limits: TrainingLimits,
    labelled: bool,
    excluded: Counter[str],
) -> BuildingDataset:
    """The usable buildings of one shard; the others are counted in ``excluded``."""
    table = files.read_table(path, CROPS, _CLOUD_COLUMNS + (_LABEL_COLUMNS if labelled else []))
    axes, offset = [], np.zeros(1, np.int64)
    for name in ("x_cm", "y_cm", "z_cm"):
        values, offset = files.list_column(table, name)
        axes.append(values.astype(np.int16, copy=False))
    points_cm, count = np.stack(axes, -1), np.diff(offset)
    usable = select(table)

    def require(condition: np.ndarray, reason: str) -> None:
        nonlocal usable
        num_failed = int((usable & ~condition).sum())
        if num_failed:
            excluded[reason] += num_failed
        usable = usable & condition

    require(count >= limits.min_points, reasons.TOO_FEW_POINTS)
    ground = table["ground_z_m"].to_numpy() - table["origin_z_m"].to_numpy()
    require(np.isfinite(ground), reasons.NO_GROUND)
    height = np.full(len(table), np.nan)
    xy = angle = np.zeros(0)
    num_vertices = np.zeros(len(table), np.int64)
    xy_offset = angle_offset = np.zeros(len(table) + 1, np.int64)
    if labelled:
        height = _floats(table, "eave_height_m") + _floats(table, "label_terrain_z_m")
        height = height - table["origin_z_m"].to_numpy() - ground
        xy, xy_offset = files.list_column(table, "footprint_xy_m")
        angle, angle_offset = files.list_column(table, "angle_deg")
        _, ring_offset = files.list_column(table, "ring_offset")
        num_vertices = np.diff(angle_offset)
        require(~np.isnan(height) & (2 * num_vertices == np.diff(xy_offset)), reasons.NO_LABELS)
        # a sequence has one ring (paper, section 4.3): courtyards cannot be represented
        require(np.diff(ring_offset) == 2, reasons.HAS_COURTYARDS)
        require(num_vertices <= limits.max_vertices, reasons.TOO_MANY_VERTICES)
        require((height > 0) & (height < limits.max_length_m), reasons.HEIGHT_OUT_OF_RANGE)
        reach = np.zeros(len(table))
        for i in np.flatnonzero(usable):
            ring = xy[xy_offset[i] : xy_offset[i + 1]].reshape(-1, 2)
            reach[i] = _reach_m(ring, points_cm[offset[i] : offset[i + 1]])
        require(reach < limits.max_length_m, reasons.FOOTPRINT_TOO_LARGE)
    rows = np.flatnonzero(usable)
    num_on_building = np.zeros(len(table), np.int64)
    if labelled:
        classes, _ = files.list_column(table, "classification")
        for i in rows:
            cloud = slice(offset[i], offset[i + 1])
            ring = xy[xy_offset[i] : xy_offset[i + 1]].reshape(-1, 2)
            above_m = 0.01 * points_cm[cloud] - [0.0, 0.0, ground[i]]
            is_on = points_on_building(shapely.Polygon(ring), above_m, classes[cloud])
            points_cm[cloud] = points_cm[cloud][np.argsort(~is_on, kind="stable")]
            # not if the centroid of these points alone is too far from a vertex, as with points at one end of a large
            # building
            if is_on.any() and _reach_m(ring, points_cm[cloud][: is_on.sum()]) < limits.max_length_m:
                num_on_building[i] = is_on.sum()
    return BuildingDataset(
        points_cm=points_cm[np.repeat(usable, count)],
        point_offset=_offsets(count[rows]),
        ground_z_m=ground[rows].astype(np.float32),
        xy_m=xy.reshape(-1, 2)[np.repeat(usable, np.diff(xy_offset) // 2)].astype(np.float32),
        vertex_offset=_offsets(num_vertices[rows]),
        angle_deg=angle[np.repeat(usable, num_vertices)].astype(np.float32),
        height_m=height[rows].astype(np.float32),
        num_on_building=num_on_building[rows],
        num_excluded={},
    )


def _reach_m(ring_m: np.ndarray, point_cm: np.ndarray) -> float:
    """How far the farthest vertex is from the centroid of points (n, 3)."""
    return float(np.hypot(*(ring_m - 0.01 * point_cm[:, :2].mean(axis=0)).T).max())


def _floats(table: Any, name: str) -> np.ndarray:
    return table[name].to_numpy(zero_copy_only=False).astype(float)


def _offsets(lengths: np.ndarray) -> np.ndarray:
    """int64 (n + 1,): the start of each row, from the lengths of the rows."""
    return np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
