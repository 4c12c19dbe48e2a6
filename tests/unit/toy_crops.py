"""Simple labelled crops for tests and benchmarks of training: convex quads, z = h + min tan(a) d."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS

SPLITS = ("train", "val", "test")


def make(folder: Path, num: dict[str, int], seed: int = 0, lidar: int = 0) -> Path:
    """Write shards and a manifest of ``num`` buildings per split to ``folder``; returns the manifest."""
    rng = np.random.default_rng(seed)
    rows = [_building(rng, split, f"{split}-{i}") for split in SPLITS for i in range(num.get(split, 0))]
    shards = [("simulated", rows, "0001_0001.parquet")]
    if lidar:
        real = [_building(rng, "none", f"lidar-{i}") for i in range(lidar)]
        for row in real:
            row.update(eave_height_m=None, label_terrain_z_m=None, angle_deg=None, roof_type=None)
        shards.append(("real", real, "hd/0002_0001.parquet"))
    entries = []
    for dataset, shard, name in shards:
        columns = {field.name: [row[field.name] for row in shard] for field in CROPS}
        files.write_table(folder / name, columns, CROPS, files.provenance(crs="EPSG:2154"))
        entries.append(
            {
                "path": name,
                "dataset": dataset,
                "rows": {split: sum(row["split"] == split for row in shard) for split in SPLITS},
                "sha256": files.sha256(folder / name),
            }
        )
    files.write_json(folder / "manifest.json", {"shards": entries})
    return folder / "manifest.json"


def ring_and_angles(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A convex quad (4, 2), counter-clockwise, and the angles of its edges in degrees."""
    length, width = rng.uniform(8, 18), rng.uniform(7, 12)
    ring = np.array([[0, 0], [length, 0], [length, width], [0, width]]) - [length / 2, width / 2]
    ring += rng.uniform(-0.6, 0.6, ring.shape)
    theta = rng.uniform(0, 2 * math.pi)
    turn = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
    slope, hip = rng.integers(20, 46, 2)
    kind = rng.integers(4)
    angles = [
        [slope, 90, slope, 90],  # gable
        [slope, hip, slope, hip],  # hip
        [slope, 90, 90, 90],  # shed
        [0, 0, 0, 0],  # flat
    ][kind]
    return ring @ turn, np.array(angles, float)


def roof_height(ring: np.ndarray, angles: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Height above the eave (n,) of the roof over points (n, 2); nan outside the convex ring."""
    following = np.roll(ring, -1, 0)
    along = (following - ring) / np.linalg.norm(following - ring, axis=1)[:, None]
    distance = along[:, 0, None] * (xy[:, 1] - ring[:, 1, None]) - along[:, 1, None] * (
        xy[:, 0] - ring[:, 0, None]
    )
    slope = np.where(angles < 90, np.tan(np.radians(np.minimum(angles, 89))), np.inf)
    with np.errstate(invalid="ignore"):
        rise = np.where(np.isinf(slope)[:, None], np.inf, slope[:, None] * distance)
    return np.where((distance >= 0).all(0), rise.min(0), np.nan)


def _building(rng: np.random.Generator, split: str, name: str) -> dict[str, object]:
    ring, angles = ring_and_angles(rng)
    height = rng.uniform(3, 12)
    ground = rng.uniform(100, 300)
    low, high = ring.min(0) - 1, ring.max(0) + 1
    xy = rng.uniform(low, high, (int(8 * np.prod(high - low)), 2))
    xy = xy[rng.random(len(xy)) < rng.uniform(0.6, 1)]
    roof = roof_height(ring, angles, xy)
    z = np.where(np.isnan(roof), 0, height + roof) + rng.normal(0, 0.03, len(xy))
    point_cm = np.round(100 * np.column_stack([xy, z])).astype(np.int16)
    return {
        "building_id": name,
        "tile": "0001_0001",
        "split": split,
        "num_points": len(xy),
        "origin_x_m": 1000.0,
        "origin_y_m": 2000.0,
        "origin_z_m": ground,
        "x_cm": point_cm[:, 0],
        "y_cm": point_cm[:, 1],
        "z_cm": point_cm[:, 2],
        "classification": np.where(np.isnan(roof), 2, 6).astype(np.uint8),
        "footprint_xy_m": ring.ravel(),
        "ring_offset": [0, len(ring)],
        "ground_z_m": ground + rng.normal(0, 0.05),
        "eave_height_m": height,
        "label_terrain_z_m": ground,
        "angle_deg": angles,
        "roof_type": "toy",
        "num_roof_points": int((~np.isnan(roof)).sum()),
        "num_wall_points": 0,
        "visible_roof_share": 1.0,
    }
