"""Read the shards that a manifest of crops lists into a dataset whose points are in a temporary file."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from p2wss.data import reasons
from p2wss.data.manifest import read_manifest
from p2wss.data.points import points_on_building
from p2wss.storage import files
from p2wss.storage.errors import InputError
from p2wss.storage.schemas.crops import CROPS, SIMULATED
from p2wss.training.dataset import BuildingDataset, TrainingLimits

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
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
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
    except OSError as error:
        raise InputError(f"the points of {manifest}: temporary file: {error.strerror or error}") from error

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
