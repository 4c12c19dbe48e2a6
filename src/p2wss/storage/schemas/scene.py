"""Scenes: GeoParquet of the buildings of a tile and its margin, with heights and roof angles.

Written by the stage scenes; read by buildings and scans.
"""

from pathlib import Path
from typing import Any

import pyarrow as pa

from p2wss.storage.files import read_metadata, read_table, write_geoparquet
from p2wss.storage.messages import reading
from p2wss.storage.schemas.columns import IDENTITY, STATUS, field

# besides these columns, the file has a `geometry` of clean 2D polygons (exterior CCW, courtyards CW)
SCENE = pa.schema(
    [
        *IDENTITY,
        field("in_tile", pa.bool_(), "false for a building in the margin, which is only an occluder"),
        *STATUS,
        field("eave_height_m", pa.float32(), "eave above terrain_z_m"),
        field("eave_height_source", pa.string(), "source of the height: hauteur, altitudes, floors or drawn"),
        field("terrain_z_m", pa.float64(), "median height of the DTM along the footprint"),
        field(
            "base_z_m", pa.float64(), "lowest height of the DTM along the footprint, the foot of the walls"
        ),
        field(
            "roof_type",
            pa.string(),
            "type drawn by the sampler: gable, hip, half-hip, shed, flat, mixed, uniform; none if excluded",
        ),
        field("angle_deg", pa.list_(pa.float32()), "one per edge over all rings; edge i starts at vertex i"),
    ]
)


def read_scene(path: str | Path) -> tuple[Any, dict[str, Any]]:
    """A scene as (GeoDataFrame with the columns of ``SCENE`` and a geometry, metadata).

    Raises :class:`InputError` if the file is missing, broken or not a scene.
    """
    import geopandas as gpd

    read_table(path, SCENE)  # for its tests
    with reading(path, "a readable scene"):
        return gpd.read_parquet(path), read_metadata(path)


def write_scene(path: str | Path, scene: Any, metadata: dict[str, Any]) -> None:
    """Write a GeoDataFrame with the columns of ``SCENE`` and a geometry as GeoParquet with ``metadata``."""
    write_geoparquet(path, scene[[*SCENE.names, scene.geometry.name]], metadata, SCENE)
