"""Recorded outputs of Roofer as Parquet, so that CityJSON is parsed once for all buildings.

Written and read by the stage eval.
"""

from __future__ import annotations

import pyarrow as pa

from p2wss.storage.schemas.columns import field

RECORDING = pa.schema(
    [
        field("building_id", pa.string(), "the attribute building_id, or else the name in the file"),
        field("vertex_xyz_m", pa.list_(pa.float64()), "x, y, z of each vertex in the CRS of the file"),
        field("triangle", pa.list_(pa.int32()), "three vertices per triangle; none without a mesh"),
        field("triangle_kind", pa.list_(pa.uint8()), "a FaceKind per triangle"),
        field("triangle_surface", pa.list_(pa.int32()), "the polygon that a triangle is part of"),
    ]
)
