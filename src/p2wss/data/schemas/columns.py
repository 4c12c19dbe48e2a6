"""Columns that several schemas share."""

from __future__ import annotations

import pyarrow as pa


def field(name: str, kind: pa.DataType, about: str, nullable: bool = False) -> pa.Field:
    return pa.field(name, kind, nullable=nullable, metadata={"about": about})


IDENTITY = [
    field(
        "building_id",
        pa.string(),
        "cleabs of BD TOPO or the user's own id; parts of a multipolygon end in -1, -2, ..",
    ),
    field("tile", pa.string(), "name of the tile, its north-west corner"),
]
FRAME = [
    field("origin_x_m", pa.float64(), "x of the local origin in the CRS of the file"),
    field("origin_y_m", pa.float64(), "y of the local origin in the CRS of the file"),
]
FOOTPRINT = [
    field(
        "footprint_xy_m",
        pa.list_(pa.float64()),
        "vertices of all rings, exterior (CCW) first, x and y in turn, local",
    ),
    field("ring_offset", pa.list_(pa.int32()), "ring r owns vertices ring_offset[r] to ring_offset[r + 1]"),
]
STATUS = [
    field("status", pa.string(), "'ok', or why the building was left out"),
]
MESH = [
    field(
        "vertex_xyz_m",
        pa.list_(pa.float64()),
        "mesh vertices, local x and y, z above the z of height 0; empty if rejected",
    ),
    field(
        "triangle", pa.list_(pa.int32()), "three vertex indices per triangle, counter-clockwise from outside"
    ),
    field("triangle_kind", pa.list_(pa.uint8()), "per triangle: 0 ground, 1 wall, 2 roof, 3 flat"),
    field(
        "triangle_edge",
        pa.list_(pa.int32()),
        "per triangle: the footprint edge it grows from, or -1; of several parts and of Roofer: its polygon",
    ),
]
