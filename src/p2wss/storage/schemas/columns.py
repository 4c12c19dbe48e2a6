"""Columns that several schemas share."""

import pyarrow as pa


def field(name: str, kind: pa.DataType, about: str, nullable: bool = False) -> pa.Field:
    """A column with its description, which is stored in the file."""
    return pa.field(name, kind, nullable=nullable, metadata={"about": about})


IDENTITY = [
    field(
        "building_id",
        pa.string(),
        "cleabs of BD TOPO or the user's id; parts of a multipolygon have suffixes -1, -2, ..",
    ),
    field("tile", pa.string(), "name of the tile, from its north-west corner"),
]
FRAME = [
    field("origin_x_m", pa.float64(), "x of the local origin in the CRS of the file"),
    field("origin_y_m", pa.float64(), "y of the local origin in the CRS of the file"),
]
FOOTPRINT = [
    field(
        "footprint_xy_m",
        pa.list_(pa.float64()),
        "vertices of all rings, exterior (CCW) first, alternating x and y, relative to the origin",
    ),
    field(
        "ring_offset", pa.list_(pa.int32()), "ring r has vertices ring_offset[r] to ring_offset[r + 1] - 1"
    ),
]
STATUS = [
    field("status", pa.string(), "'ok', or the reason why the building was excluded"),
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
    field(
        "triangle_kind", pa.list_(pa.uint8()), "per triangle: 0 ground, 1 wall, 2 roof, 3 flat, 4 outer floor"
    ),
    field(
        "triangle_edge",
        pa.list_(pa.int32()),
        "per triangle: of buildings by the kernel the footprint edge of its face, or -1; of reconstructions the number"
        " of its plane",
    ),
]
