"""Crops: Parquet shards of the points of each building.

Written by the stage crops; read by dvae, model and eval.
"""

import pyarrow as pa

from p2wss.storage.schemas.columns import FOOTPRINT, FRAME, IDENTITY, field

# the two data sets of the crops: values of ``dataset`` in the manifest and in every table of eval
SIMULATED, REAL = "simulated", "real"

CROPS = pa.schema(
    [
        *IDENTITY,
        field(
            "split",
            pa.string(),
            "train, val, test, guard (too close to another split, not used) or none (real LiDAR)",
        ),
        field("num_points", pa.int32(), "points inside the footprint or within the buffer"),
        *FRAME,
        field(
            "origin_z_m",
            pa.float64(),
            "z of z_cm = 0; derived from the points only, so that it reveals nothing about the labels",
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
            "points on the roof; of real LiDAR: points on the building (p2wss.data.points)",
        ),
        field("num_wall_points", pa.int32(), "points on the walls; null for real LiDAR", True),
        field("visible_roof_share", pa.float32(), "share of the 1 m cells of the roof that have a point"),
    ]
)
