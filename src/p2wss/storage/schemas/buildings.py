"""Buildings: Parquet of the parameters and the closed mesh of each building of a scene.

Written by the stage buildings; read by scans and crops.
"""

import pyarrow as pa

from p2wss.storage.schemas.columns import FOOTPRINT, FRAME, IDENTITY, MESH, STATUS, field

BUILDINGS = pa.schema(
    [
        *IDENTITY,
        field("in_tile", pa.bool_(), "false for a building in the margin of the tile"),
        *STATUS,
        field("eave_height_m", pa.float32(), "eave above terrain_z_m"),
        field("terrain_z_m", pa.float64(), "z of height 0, as in the scene"),
        field("base_z_m", pa.float64(), "z of the ground face of the mesh"),
        field("roof_type", pa.string(), "type drawn by the sampler, as in the scene"),
        field("angle_deg", pa.list_(pa.float32()), "one per edge over all rings"),
        *FRAME,
        *FOOTPRINT,
        *MESH,
    ]
)
