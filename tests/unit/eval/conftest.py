"""A hamlet of known buildings: shards as the stage crops writes them, sampled from meshes of the kernel."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from p2wss import skeleton
from p2wss.mesh.surface import sample_surface
from p2wss.skeleton.types import FaceKind, Polygons
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS

SHAPES = {
    "gable": ([(0, 0), (12, 0), (12, 8), (0, 8)], [35, 90, 35, 90]),
    "hip": ([(0, 0), (14, 0), (14, 9), (0, 9)], [40, 40, 40, 40]),
    "flat": ([(0, 0), (10, 0), (10, 10), (0, 10)], [0, 0, 0, 0]),
    "mixed": ([(0, 0), (16, 0), (16, 6), (7, 6), (7, 13), (0, 13)], [30, 90, 30, 30, 90, 30]),
}


def crop_columns(num_buildings: int, tile: str, labelled: bool, seed: int, split: str) -> dict[str, object]:
    """Columns of the schema ``CROPS``: buildings of SHAPES in turn, 40 m apart, on ground at z = 100 + 3 sin(i)."""
    draw = np.random.default_rng(seed)
    rows: dict[str, list[object]] = {name: [] for name in CROPS.names}
    for i in range(num_buildings):
        roof_type = list(SHAPES)[i % len(SHAPES)]
        ring, angle = SHAPES[roof_type]
        xy = np.array(ring, float) - 5
        height = 4.0 + 0.5 * (i % 7)
        ground = 100 + 3 * np.sin(i)
        polygon = Polygons.from_rings([[xy]])
        vertex, triangle, kind, _ = skeleton.build(polygon, np.array(angle, float), np.array([height])).mesh(
            0
        )
        on_roof = sample_surface(vertex, triangle[kind >= FaceKind.ROOF], 600, draw)
        on_ground = np.column_stack([draw.uniform(-6, -5, 60), draw.uniform(-5, 5, 60), np.zeros(60)])
        point = np.vstack([on_roof, on_ground]) + draw.normal(0, 0.03, (660, 3)) + [0, 0, ground]
        origin_z = np.floor(point[:, 2].min())
        cm = np.round((point - [0, 0, origin_z]) * 100).astype(np.int16)
        for name, value in {
            "building_id": f"{tile}-{i}",
            "tile": tile,
            "split": split,
            "num_points": len(point),
            "origin_x_m": 652000.0 + 40 * (i % 10),
            "origin_y_m": 6861000.0 + 40 * (i // 10),
            "origin_z_m": origin_z,
            "x_cm": cm[:, 0],
            "y_cm": cm[:, 1],
            "z_cm": cm[:, 2],
            "classification": np.r_[np.full(600, 6), np.full(60, 2)].astype(np.uint8),
            "footprint_xy_m": xy.ravel(),
            "ring_offset": [0, len(xy)],
            "ground_z_m": ground,
            "eave_height_m": height if labelled else None,
            "label_terrain_z_m": ground if labelled else None,
            "angle_deg": angle if labelled else None,
            "roof_type": roof_type if labelled else None,
            "num_roof_points": 600,
            "num_wall_points": 0 if labelled else None,
            "visible_roof_share": 0.5 + 0.5 * draw.random(),
        }.items():
            rows[name].append(value)
    return rows


@pytest.fixture(scope="session")
def hamlet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A manifest with 20 buildings to train on, 4 to validate, 16 to test, and 12 of real LiDAR without labels."""
    folder = tmp_path_factory.mktemp("crops")
    train = crop_columns(24, "0652_6862", True, 1, "train")
    test = crop_columns(16, "0652_6862", True, 2, "test")
    simulated = {name: [*train[name], *test[name]] for name in train}
    simulated["building_id"] = [f"b{i}" for i in range(40)]
    simulated["split"] = ["val"] * 4 + ["train"] * 20 + ["test"] * 16
    lidar = crop_columns(12, "0653_6861", False, 3, "none")
    metadata = files.provenance(crs="EPSG:2154")
    files.write_table(folder / "a.parquet", simulated, CROPS, metadata)
    files.write_table(folder / "b.parquet", lidar, CROPS, metadata)
    manifest = folder / "manifest.json"
    manifest.write_text(
        json.dumps(
            {
                "shards": [
                    {
                        "path": "a.parquet",
                        "dataset": "simulated",
                        "rows": {"val": 4, "train": 20, "test": 16},
                    },
                    {"path": "b.parquet", "dataset": "real", "rows": {"none": 12}},
                ],
                "crs": {"simulated": "EPSG:2154", "real": "EPSG:2154"},
            }
        )
    )
    return manifest
