"""Crops: Parquet shards of the points of each building."""

from __future__ import annotations

import pyarrow as pa

from p2wss.data.schemas.columns import FOOTPRINT, FRAME, IDENTITY, field

# the two data sets of the crops: values of ``dataset`` in the manifest and in every table of eval
SIMULATED, REAL = "simulated", "real"

CROPS = pa.schema(
    [
        *IDENTITY,
        field(
            "split",
            pa.string(),
            "train, val, test, guard (too near another split: unused) or none (real LiDAR)",
        ),
        field("num_points", pa.int32(), "points within the buffer"),
        *FRAME,
        field(
            "origin_z_m",
            pa.float64(),
            "z of z_cm = 0; chosen from the points alone, so it tells nothing of the labels",
        ),
        field("x_cm", pa.list_(pa.int16()), "point x - origin_x_m, centimetres"),
        field("y_cm", pa.list_(pa.int16()), "point y - origin_y_m, centimetres"),
        field("z_cm", pa.list_(pa.int16()), "point z - origin_z_m, centimetres"),
        field("classification", pa.list_(pa.uint8()), "LAS class per point: 2 ground, 6 building, .."),
        *FOOTPRINT,
        field("ground_z_m", pa.float64(), "z of the ground at the building as the cloud shows it"),
        field(
            "eave_height_m", pa.float32(), "label: eave above label_terrain_z_m; null for real LiDAR", True
        ),
        field(
            "label_terrain_z_m",
            pa.float64(),
            "label: terrain_z_m of the building, z of height 0; null for real LiDAR",
            True,
        ),
        field("angle_deg", pa.list_(pa.float32()), "label: one per edge; null for real LiDAR", True),
        field("roof_type", pa.string(), "label; null for real LiDAR", True),
        field(
            "num_roof_points",
            pa.int32(),
            "points on this building's roof; of real LiDAR on the building (p2wss.data.points)",
        ),
        field("num_wall_points", pa.int32(), "points on this building's walls; null for real LiDAR", True),
        field(
            "num_walls_seen",
            pa.int32(),
            "footprint edges whose walls have 10 points or more; null for real LiDAR",
            True,
        ),
        field("num_strips", pa.int32(), "flight lines that the points come from"),
        field("visible_roof_share", pa.float32(), "share of the roof's 1 m cells that have a point"),
        field("is_truncated", pa.bool_(), "more points than crops.max_points: networks see a part of them"),
    ]
)
