"""Buildings for training and evaluation: from the shards of ``crops`` to padded batches.

Points stay int16 centimetres in one flat array, as in the shards; a batch is cut out of it, thinned and
turned into metres when it is needed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from p2wss import io
from p2wss.errors import InputError
from p2wss.nets.augment import Batch
from p2wss.seeds import generator

_CLOUD_COLUMNS = ["split", "num_points", "origin_z_m", "x_cm", "y_cm", "z_cm", "ground_z_m"]
_LABEL_COLUMNS = ["footprint_xy_m", "ring_offset", "eave_height_m", "label_ground_z_m", "angle_deg"]
# share of a cloud's points that lie below the ground where the cloud has no ground of its own
_GROUND_QUANTILE = 0.02
# batches are sorted by length within a window of so many, so that little of them is padding
_BUCKET_WINDOW = 8


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

    def __len__(self) -> int:
        return len(self.point_offset) - 1

    @property
    def num_vertices(self) -> np.ndarray:
        return np.diff(self.vertex_offset)

    def batch(self, index: np.ndarray, num_points: int, rng: np.random.Generator | None) -> Batch:
        """The buildings ``index`` as a padded batch; clouds of more than ``num_points`` are thinned.

        ``rng`` draws the points kept; without one they depend on the size of the cloud alone.
        """
        chosen = []
        for i in index:
            first, last = int(self.point_offset[i]), int(self.point_offset[i + 1])
            chosen.append(first + thin(last - first, num_points, rng))
        width = max(map(len, chosen))
        points = np.zeros((len(index), width, 3), np.float32)
        valid = np.zeros((len(index), width), bool)
        for row, which in enumerate(chosen):
            points[row, : len(which)] = self.points_cm[which]
            valid[row, : len(which)] = True
        points *= np.float32(0.01)
        num_vertices = self.num_vertices[index]
        xy = np.zeros((len(index), max(int(num_vertices.max()), 1), 2), np.float32)
        angle = np.zeros(xy.shape[:2], np.float32)
        for row, i in enumerate(index):
            ring = slice(self.vertex_offset[i], self.vertex_offset[i + 1])
            xy[row, : num_vertices[row]] = self.xy_m[ring]
            angle[row, : num_vertices[row]] = self.angle_deg[ring]
        return Batch(
            points=torch.from_numpy(points),
            valid=torch.from_numpy(valid),
            ground_z=torch.from_numpy(self.ground_z_m[index]),
            height=torch.from_numpy(self.height_m[index]),
            xy=torch.from_numpy(xy),
            angle=torch.from_numpy(angle),
            num_vertices=torch.from_numpy(num_vertices),
        )


def thin(count: int, num_points: int, rng: np.random.Generator | None) -> np.ndarray:
    """Indices of at most ``num_points`` of ``count`` points; the same for the same count without ``rng``."""
    if count <= num_points:
        return np.arange(count)
    rng = rng or np.random.Generator(np.random.Philox(key=count))
    return rng.choice(count, num_points, replace=False, shuffle=False)


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
        cut += np.split(part, len(part) // batch_size)
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


def load(manifest: Path, splits: Sequence[str], limits: Limits, labelled: bool, lidar: bool) -> Buildings:
    """Buildings of the ``splits`` from the shards that ``manifest`` lists; real LiDAR too if ``lidar``.

    Raises :class:`InputError` for a broken manifest or shard, or when nothing is left.
    """
    listed = io.read_json(manifest)
    try:
        shards = [
            (Path(manifest).parent / shard["path"], shard["dataset"])
            for shard in listed["shards"]
            if shard["dataset"] == "synthetic" or (lidar and not labelled)
        ]
    except (TypeError, KeyError) as error:
        raise InputError(f"{manifest}: not a manifest of crops: no {error}") from error
    left_out: Counter[str] = Counter()
    parts = [
        _read(path, splits if dataset == "synthetic" else ["none"], limits, labelled, left_out)
        for path, dataset in shards
    ]
    parts = [part for part in parts if len(part)]
    if not parts:
        raise InputError(
            f"{manifest}: no building of split {' or '.join(splits)} can be used"
            + (f" (left out: {_counts(left_out)})" if left_out else "")
        )
    joined = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("points_cm", "ground_z_m", "xy_m", "angle_deg", "height_m")
    }
    return Buildings(
        **joined,
        point_offset=_offsets([np.diff(part.point_offset) for part in parts]),
        vertex_offset=_offsets([np.diff(part.vertex_offset) for part in parts]),
        num_left_out=dict(left_out),
    )


def describe(buildings: Buildings) -> str:
    """One line for the log."""
    text = f"{len(buildings)} buildings, {len(buildings.points_cm)} points"
    return text + (f"; left out: {_counts(buildings.num_left_out)}" if buildings.num_left_out else "")


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))


def _offsets(lengths: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(np.concatenate(lengths))]).astype(np.int64)


def _read(
    path: Path, splits: Sequence[str], limits: Limits, labelled: bool, left_out: Counter[str]
) -> Buildings:
    table = io.read_table(path, io.CROPS, _CLOUD_COLUMNS + (_LABEL_COLUMNS if labelled else []))
    axes, offset = [], np.zeros(1, np.int64)
    for name in ("x_cm", "y_cm", "z_cm"):
        values, offset = io.list_column(table, name)
        axes.append(values.astype(np.int16, copy=False))
    count = np.diff(offset)
    keep = np.isin(table["split"].to_numpy(zero_copy_only=False).astype(str), list(splits))

    def require(good: np.ndarray, reason: str) -> None:
        nonlocal keep
        num = int((keep & ~good).sum())
        if num:
            left_out[reason] += num
        keep = keep & good

    require(count >= limits.min_points, f"with fewer than {limits.min_points} points")
    ground = table["ground_z_m"].to_numpy() - table["origin_z_m"].to_numpy()
    for i in np.flatnonzero(np.isnan(ground) & keep):
        ground[i] = ground_from_points(axes[2][offset[i] : offset[i + 1]]) * 0.01
    height = np.full(len(table), np.nan)
    xy = angle = np.zeros(0)
    ring_count = np.zeros(len(table), np.int64)
    xy_offset = angle_offset = np.zeros(len(table) + 1, np.int64)
    if labelled:
        height = _floats(table, "eave_height_m") + _floats(table, "label_ground_z_m")
        height = height - table["origin_z_m"].to_numpy() - ground
        xy, xy_offset = io.list_column(table, "footprint_xy_m")
        angle, angle_offset = io.list_column(table, "angle_deg")
        _, ring_offset = io.list_column(table, "ring_offset")
        ring_count = np.diff(angle_offset)
        require(~np.isnan(height) & (2 * ring_count == np.diff(xy_offset)), "without labels")
        # the sequence has one ring (paper, section 4.3): courtyards cannot be written
        require(np.diff(ring_offset) == 2, "with courtyards")
        require(ring_count <= limits.max_vertices, f"with more than {limits.max_vertices} vertices")
        require((height > 0) & (height < limits.max_length_m), "with a height that does not fit")
        reach = np.zeros(len(table))
        for i in np.flatnonzero(keep):
            cloud = slice(offset[i], offset[i + 1])
            middle = np.array([axes[0][cloud].mean(), axes[1][cloud].mean()]) * 0.01
            ring = xy[xy_offset[i] : xy_offset[i + 1]].reshape(-1, 2)
            reach[i] = np.hypot(*(ring - middle).T).max()
        require(reach < limits.max_length_m, "too large for the number format")
    rows = np.flatnonzero(keep)
    points = _take(offset, rows)
    vertices = _take(angle_offset, rows)
    return Buildings(
        points_cm=np.stack([axis[points] for axis in axes], -1),
        point_offset=_offsets([count[rows]]),
        ground_z_m=ground[rows].astype(np.float32),
        xy_m=xy.reshape(-1, 2)[vertices].astype(np.float32),
        vertex_offset=_offsets([ring_count[rows]]),
        angle_deg=angle[vertices].astype(np.float32),
        height_m=height[rows].astype(np.float32),
        num_left_out={},
    )


def _floats(table: object, name: str) -> np.ndarray:
    return table[name].to_numpy(zero_copy_only=False).astype(float)  # type: ignore[index]


def _take(offset: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Indices of the values of ``rows``, in order."""
    if not len(rows):
        return np.zeros(0, np.int64)
    return np.concatenate([np.arange(offset[i], offset[i + 1]) for i in rows])
