"""Buildings for training and evaluation: from the shards of ``crops`` to padded batches.

Points stay int16 centimetres in one flat array, as in the shards; a batch is cut out of it, thinned and
turned into metres when it is needed. The array is a file that is mapped into memory, decoded once from the
shards (:func:`load`), or a tensor in the memory of a GPU (:class:`ResidentBuildings`).
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numba import njit
from torch import Tensor

from p2wss import io, parallel
from p2wss.errors import InputError
from p2wss.nets.augment import UNKNOWN, Batch
from p2wss.nets.patches import patch_index
from p2wss.seeds import generator

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


def load(
    manifest: Path,
    splits: Sequence[str],
    limits: Limits,
    labelled: bool,
    lidar: bool,
    cache: Path | None = None,
) -> Buildings:
    """Buildings of the ``splits`` from the shards that ``manifest`` lists; real LiDAR too if ``lidar``.

    They are decoded into a new folder within ``cache``, whole or not at all, and mapped into memory; the next
    call with shards of the same content and the same arguments finds them there. Without ``cache`` they are
    held in memory. Raises :class:`InputError` for a broken manifest or shard, or when nothing is left.
    """
    listed = io.read_json(manifest)
    try:
        shards = [
            (Path(manifest).parent / shard["path"], shard["dataset"], shard.get("sha256"))
            for shard in listed["shards"]
            if shard["dataset"] == "synthetic" or (lidar and not labelled)
        ]
    except (TypeError, KeyError) as error:
        raise InputError(f"{manifest}: not a manifest of crops: no {error}") from error
    left_out: Counter[str] = Counter()

    def parts() -> Iterator[Buildings]:
        for path, name, _ in shards:
            part = _read(path, splits if name == "synthetic" else ["none"], limits, labelled, left_out)
            if len(part):
                yield part

    if cache is None:
        found = _join(list(parts()), None)
    else:
        content = [(name, sha256 or io.sha256(path)) for path, name, sha256 in shards]
        asked = [_CACHE_VERSION, content, list(splits), vars(limits), labelled, lidar]
        folder = cache / blake2b(json.dumps(asked).encode(), digest_size=12).hexdigest()
        if parallel.rank() == 0 and not folder.is_dir():
            _write_cache(parts(), folder, left_out)
        parallel.barrier()
        found = _open_cache(folder)
        left_out = Counter(found.num_left_out)
    if not len(found):
        raise InputError(
            f"{manifest}: no building of split {' or '.join(splits)} can be used"
            + (f" (left out: {_counts(left_out)})" if left_out else "")
        )
    return replace(found, num_left_out=dict(left_out))


_FLAT = ("ground_z_m", "xy_m", "angle_deg", "height_m")


def _join(parts: list[Buildings], points_cm: np.ndarray | None) -> Buildings:
    """Parts one after the other; ``points_cm`` if their points are joined already."""
    if points_cm is None:
        points_cm = np.concatenate([np.zeros((0, 3), np.int16), *(part.points_cm for part in parts)])
    empty = {"xy_m": np.zeros((0, 2), np.float32)}
    flat: dict[str, Any] = {
        name: np.concatenate(
            [empty.get(name, np.zeros(0, np.float32)), *(getattr(part, name) for part in parts)]
        )
        for name in _FLAT
    }
    return Buildings(
        points_cm=points_cm,
        **flat,
        point_offset=_offsets([np.diff(part.point_offset) for part in parts]),
        vertex_offset=_offsets([np.diff(part.vertex_offset) for part in parts]),
        num_left_out={},
    )


def _write_cache(parts: Iterator[Buildings], folder: Path, left_out: Counter[str]) -> None:
    """Decode one shard at a time: of the points no more than that is ever in memory."""
    made: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=".decoding-", dir=folder.parent))
        slim = []
        with open(made / "points_cm.i16", "wb") as file:
            for part in parts:
                file.write(part.points_cm.tobytes())
                slim.append(replace(part, points_cm=part.points_cm[:0]))
        joined = _join(slim, np.zeros((0, 3), np.int16))
        np.savez(made / "buildings.npz", **{name: getattr(joined, name) for name in (*_FLAT, *_OFFSETS)})
        (made / "left_out.json").write_text(json.dumps(left_out))
        os.replace(made, folder)
    except OSError as error:
        raise InputError(f"{folder}: not written: {error.strerror or error}") from error
    finally:
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)


_OFFSETS = ("point_offset", "vertex_offset")


def _open_cache(folder: Path) -> Buildings:
    try:
        with np.load(folder / "buildings.npz") as file:
            arrays: dict[str, Any] = dict(file)
        num_points = int(arrays["point_offset"][-1])
        points = np.zeros((0, 3), np.int16)
        if num_points:
            points = np.memmap(folder / "points_cm.i16", np.int16, "r", shape=(num_points, 3)).view(
                np.ndarray
            )
        left_out = json.loads((folder / "left_out.json").read_text())
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder}: not readable ({error}); delete it") from error
    return Buildings(points_cm=points, **arrays, num_left_out=left_out, folder=folder)


@dataclass(frozen=True)
class Cut:
    """How clouds become patches."""

    num_points: int
    num_patches: int
    patch_size: int


def with_patches(buildings: Buildings, cut: Cut, device: torch.device) -> Buildings:
    """The same buildings with the patches of every cloud that no batch thins (``cut.num_points``).

    They are found once and kept in one file beside the decoded clouds, whole or not at all; several processes
    wait for the first one to write it. Buildings without a folder keep them in memory. Raises
    :class:`InputError` for a file that cannot be written or read.
    """
    shape = (len(buildings), cut.num_patches, cut.patch_size)
    if buildings.folder is None:
        found = np.empty(shape, np.int16)
        _find_patches(buildings, cut, device, found)
        return replace(buildings, patch_index=found)
    path = buildings.folder / f"patches-{cut.num_points}-{cut.num_patches}x{cut.patch_size}.i16"
    if parallel.rank() == 0 and not path.is_file():
        with io.atomic(path) as temporary:
            mapped = np.memmap(temporary, np.int16, "w+", shape=shape)
            _find_patches(buildings, cut, device, mapped)
            mapped.flush()
    parallel.barrier()
    try:
        mapped = np.memmap(path, np.int16, "r", shape=shape)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not readable ({error}); delete it") from error
    return replace(buildings, patch_index=mapped.view(np.ndarray))


def _find_patches(buildings: Buildings, cut: Cut, device: torch.device, found: np.ndarray) -> None:
    """Fill ``found`` (n, g, k), ``UNKNOWN`` for clouds that are thinned."""
    count = np.diff(buildings.point_offset)
    # clouds of like size together, little of a batch is padding
    order = np.argsort(count, kind="stable")
    whole = order[count[order] <= min(cut.num_points, np.iinfo(np.int16).max)]
    found[order[len(whole) :]] = UNKNOWN
    shown = time.monotonic()
    for first in range(0, len(whole), _PATCH_BATCH):
        index = whole[first : first + _PATCH_BATCH]
        batch = buildings.batch(index, cut.num_points, None).to(device)
        found[index] = patch_index(batch.points, batch.valid, cut.num_patches, cut.patch_size).cpu().numpy()
        if time.monotonic() - shown > _PROGRESS_EVERY_S:
            shown = time.monotonic()
            log.info("patches: %d of %d clouds", first + len(index), len(whole))


def describe(buildings: Buildings) -> str:
    """One line for the log."""
    text = f"{len(buildings)} buildings, {len(buildings.points_cm)} points"
    return text + (f"; left out: {_counts(buildings.num_left_out)}" if buildings.num_left_out else "")


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))


def _offsets(lengths: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(np.concatenate([np.zeros(0, np.int64), *lengths]))]).astype(
        np.int64
    )


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
