"""From the shards that a manifest of crops lists to a dataset in memory, or mapped from a cache."""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from p2wss.data import reasons
from p2wss.errors import InputError, reading
from p2wss.nets import distributed
from p2wss.nets.dataset import BuildingDataset, TrainingLimits
from p2wss.storage import files, integrity
from p2wss.storage.schemas.crops import CROPS, SIMULATED
from p2wss.storage.schemas.manifest import read_manifest
from p2wss.storage.temporary import remove_leftovers, temporary_prefix

log = logging.getLogger("p2wss")

_CLOUD_COLUMNS = [
    "split",
    "tile",
    "building_id",
    "num_points",
    "origin_z_m",
    "x_cm",
    "y_cm",
    "z_cm",
    "ground_z_m",
]
_LABEL_COLUMNS = ["footprint_xy_m", "ring_offset", "eave_height_m", "label_terrain_z_m", "angle_deg"]
_FLAT_ARRAYS = ("ground_z_m", "xy_m", "angle_deg", "height_m")
_OFFSETS = ("point_offset", "vertex_offset")
# version of the layout of the cache: another number decodes the shards again
_CACHE_VERSION = 3


def load_dataset(
    manifest: Path,
    splits: Sequence[str],
    limits: TrainingLimits,
    labelled: bool,
    include_real: bool,
    cache: Path | None = None,
) -> BuildingDataset:
    """Buildings of the ``splits`` from the shards that ``manifest`` lists.

    ``include_real`` adds real LiDAR, which has no labels, to an unlabelled dataset. The shards are decoded into a
    new folder within ``cache``, completely or not at all, and mapped into memory; the next call with shards of the
    same content and the same arguments uses that folder. Without ``cache`` the arrays are held in memory. Raises
    :class:`InputError` for a broken manifest or shard, or when no building remains.
    """
    listing = read_manifest(manifest)
    shards = [
        shard for shard in listing.shards if shard.dataset == SIMULATED or (include_real and not labelled)
    ]
    excluded: Counter[str] = Counter()

    def parts() -> Iterator[BuildingDataset]:
        for shard in shards:
            name = shard.dataset
            select = partial(listing.select, dataset=name, purposes=splits if name == SIMULATED else ["dvae"])
            part = _read_shard(shard.verified(), select, limits, labelled, excluded)
            if len(part):
                yield part

    if cache is None:
        dataset = _concatenate(list(parts()))
    else:
        content = [(name, sha256 or files.sha256(path)) for path, name, sha256 in shards]
        key = [
            _CACHE_VERSION,
            content,
            listing.seed,
            dict(listing.selection),
            list(splits),
            vars(limits),
            labelled,
            include_real,
        ]
        folder = cache / blake2b(json.dumps(key).encode(), digest_size=12).hexdigest()
        if distributed.rank() == 0 and not (folder.is_dir() and _is_usable(folder)):
            _write_cache(parts(), folder, excluded)
        distributed.barrier()
        dataset = _open_cache(folder)
        excluded = Counter(dataset.num_excluded)
    if not len(dataset):
        raise InputError(
            f"{manifest}: no building of split {' or '.join(splits)} can be used"
            + (f" (excluded: {_counts(excluded)})" if excluded else "")
        )
    return replace(dataset, num_excluded=dict(excluded))


def describe(dataset: BuildingDataset) -> str:
    """One line for the log."""
    text = f"{len(dataset)} buildings, {len(dataset.points_cm)} points"
    return text + (f"; excluded: {_counts(dataset.num_excluded)}" if dataset.num_excluded else "")


def _concatenate(parts: Sequence[BuildingDataset]) -> BuildingDataset:
    flat: dict[str, Any] = {
        name: np.concatenate(
            [np.zeros((0, 2) if name == "xy_m" else 0, np.float32), *(getattr(part, name) for part in parts)]
        )
        for name in _FLAT_ARRAYS
    }
    return BuildingDataset(
        points_cm=np.concatenate([np.zeros((0, 3), np.int16), *(part.points_cm for part in parts)]),
        **flat,
        point_offset=_offsets([np.diff(part.point_offset) for part in parts]),
        vertex_offset=_offsets([np.diff(part.vertex_offset) for part in parts]),
        num_excluded={},
    )


def _write_cache(parts: Iterator[BuildingDataset], folder: Path, excluded: Counter[str]) -> None:
    """Decode one shard at a time: the points of no more than one are ever in memory."""
    temporary: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder.parent)
        temporary = Path(tempfile.mkdtemp(prefix=temporary_prefix("decoding"), dir=folder.parent))
        without_points = []
        with open(temporary / "points_cm.i16", "wb") as file:
            for part in parts:
                file.write(part.points_cm.tobytes())
                without_points.append(replace(part, points_cm=part.points_cm[:0]))
        dataset = _concatenate(without_points)
        arrays = {name: getattr(dataset, name) for name in (*_FLAT_ARRAYS, *_OFFSETS)}
        np.savez(temporary / "buildings.npz", **arrays)
        (temporary / "excluded.json").write_text(json.dumps(excluded) + "\n")
        for path in temporary.iterdir():
            integrity.seal(path)
        os.replace(temporary, folder)
    except OSError as error:
        raise InputError(f"{folder}: not written: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def _is_usable(folder: Path) -> bool:
    """Whether all files of a cache are intact; a damaged one is removed."""
    names = ("points_cm.i16", "buildings.npz", "excluded.json")
    damaged = [name for name in names if not integrity.is_usable(folder / name)]
    if damaged:
        log.warning("%s: damaged or incomplete; decoding the clouds again", folder / damaged[0])
        shutil.rmtree(folder)
    return not damaged


def _open_cache(folder: Path) -> BuildingDataset:
    with reading(folder, "a readable cache of clouds; delete it"):
        with np.load(folder / "buildings.npz") as file:
            arrays: dict[str, Any] = {name: file[name] for name in (*_FLAT_ARRAYS, *_OFFSETS)}
        num_points = int(arrays["point_offset"][-1])
        points = np.zeros((0, 3), np.int16)
        if num_points:
            points = np.memmap(folder / "points_cm.i16", np.int16, "r", shape=(num_points, 3)).view(
                np.ndarray
            )
        excluded = json.loads((folder / "excluded.json").read_text().partition("\n")[0])
    return BuildingDataset(points_cm=points, **arrays, num_excluded=excluded, folder=folder)


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
    count = np.diff(offset)
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
            cloud = slice(offset[i], offset[i + 1])
            centroid = np.array([axes[0][cloud].mean(), axes[1][cloud].mean()]) * 0.01
            ring = xy[xy_offset[i] : xy_offset[i + 1]].reshape(-1, 2)
            reach[i] = np.hypot(*(ring - centroid).T).max()
        require(reach < limits.max_length_m, reasons.FOOTPRINT_TOO_LARGE)
    rows = np.flatnonzero(usable)
    points = _value_index(offset, rows)
    vertices = _value_index(angle_offset, rows)
    return BuildingDataset(
        points_cm=np.stack([axis[points] for axis in axes], -1),
        point_offset=_offsets([count[rows]]),
        ground_z_m=ground[rows].astype(np.float32),
        xy_m=xy.reshape(-1, 2)[vertices].astype(np.float32),
        vertex_offset=_offsets([num_vertices[rows]]),
        angle_deg=angle[vertices].astype(np.float32),
        height_m=height[rows].astype(np.float32),
        num_excluded={},
    )


def _floats(table: Any, name: str) -> np.ndarray:
    return table[name].to_numpy(zero_copy_only=False).astype(float)


def _value_index(offset: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Indices of the values of ``rows`` in a ragged array, in order."""
    if not len(rows):
        return np.zeros(0, np.int64)
    return np.concatenate([np.arange(offset[i], offset[i + 1]) for i in rows])


def _offsets(lengths: Sequence[np.ndarray]) -> np.ndarray:
    """int64 (n + 1,): where each row begins, from the lengths of rows."""
    ends = np.cumsum(np.concatenate([np.zeros(0, np.int64), *lengths]))
    return np.concatenate([[0], ends]).astype(np.int64)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
