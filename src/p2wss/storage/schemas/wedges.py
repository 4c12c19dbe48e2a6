"""Wedges: Parquet of the convex edges of the skins of buildings. Written by the stage reconstruct."""

import pyarrow as pa

from p2wss.storage.schemas.columns import field

WEDGES = pa.schema(
    [
        field(
            "skin",
            pa.int32(),
            "number of the skin, from 0: with --skin that of its mesh among those of mesh files",
        ),
        *(
            field(f"{axis}{end}_m", pa.float64(), f"{axis} of end {end} in the CRS of the files")
            for end in (0, 1)
            for axis in "xyz"
        ),
        field(
            "opening_angle_deg", pa.float64(), "angle between the two faces inside the buildings, below 180"
        ),
        *(
            column
            for side in (0, 1)
            for column in (
                field(f"face_{side}", pa.int32(), f"face {side}, a number within the skin"),
                field(f"kind_{side}", pa.string(), f"face {side} is of a ground, wall, roof or outer_floor"),
                field(f"building_id_{side}", pa.string(), f"building that face {side} belongs to"),
            )
        ),
    ]
)
