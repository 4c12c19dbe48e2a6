"""Training data: from the shards of a manifest to arrays in memory, or mapped from a cache."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import torch

from p2wss.data import files
from p2wss.data.schemas.crops import CROPS, SIMULATED
from p2wss.errors import InputError
from p2wss.nets import parallel
from p2wss.nets.augment import UNKNOWN
from p2wss.nets.dataset import (
    _CACHE_VERSION,
    _CLOUD_COLUMNS,
    _FLAT,
    _LABEL_COLUMNS,
    _OFFSETS,
    _PATCH_BATCH,
    _PROGRESS_EVERY_S,
    Buildings,
    Limits,
    ground_from_points,
    log,
)
from p2wss.nets.patches import patch_index


def load_buildings(
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
    listed = files.read_json(manifest)
    try:
        shards = [
            (Path(manifest).parent / shard["path"], shard["dataset"], shard.get("sha256"))
            for shard in listed["shards"]
            if shard["dataset"] == SIMULATED or (lidar and not labelled)
        ]
    except (TypeError, KeyError) as error:
        raise InputError(f"{manifest}: not a manifest of crops: no {error}") from error
    left_out: Counter[str] = Counter()

    def parts() -> Iterator[Buildings]:
        for path, name, _ in shards:
            part = _read(path, splits if name == SIMULATED else ["none"], limits, labelled, left_out)
            if len(part):
                yield part

    if cache is None:
        found = _join(list(parts()), None)
    else:
        content = [(name, sha256 or files.sha256(path)) for path, name, sha256 in shards]
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
        with files.atomic(path) as temporary:
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
    table = files.read_table(path, CROPS, _CLOUD_COLUMNS + (_LABEL_COLUMNS if labelled else []))
    axes, offset = [], np.zeros(1, np.int64)
    for name in ("x_cm", "y_cm", "z_cm"):
        values, offset = files.list_column(table, name)
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
        xy, xy_offset = files.list_column(table, "footprint_xy_m")
        angle, angle_offset = files.list_column(table, "angle_deg")
        _, ring_offset = files.list_column(table, "ring_offset")
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
