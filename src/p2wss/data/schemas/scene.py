"""Scenes: GeoParquet of the buildings of a tile and its margin, with heights and roof angles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa

from p2wss.data.files import read_metadata, read_table, write_geoparquet
from p2wss.data.schemas.columns import IDENTITY, STATUS, field

# Scenes are GeoParquet: these columns and a `geometry` of cleaned polygons (exterior CCW, courtyards CW, 2D).
SCENE = pa.schema(
    [
        *IDENTITY,
        field("in_tile", pa.bool_(), "false for a building of the margin, which only casts shadows"),
        *STATUS,
        field("eave_height_m", pa.float32(), "eave above terrain_z_m"),
        field("eave_height_source", pa.string(), "'hauteur', or the fallback that gave the height"),
        field("terrain_z_m", pa.float64(), "median height of the DTM along the footprint"),
        field("base_z_m", pa.float64(), "lowest height of the DTM along the footprint, where the walls end"),
        field(
            "roof_type",
            pa.string(),
            "what the sampler drew: gable, hip, half-hip, shed, flat, mixed, uniform",
        ),
        field("angle_deg", pa.list_(pa.float32()), "one per edge over all rings; edge i starts at vertex i"),
    ]
)


def read_scene(path: str | Path) -> tuple[Any, dict[str, Any]]:
    """A scene as (GeoDataFrame with the columns of ``SCENE`` and a geometry, metadata)."""
    import geopandas as gpd

    read_table(path, SCENE, columns=["building_id"])  # a clear error for what is no scene
    return gpd.read_parquet(path), read_metadata(path)


def write_scene(path: str | Path, scene: Any, metadata: dict[str, Any]) -> None:
    """Write a GeoDataFrame with the columns of ``SCENE`` and a geometry as GeoParquet with ``metadata``."""
    write_geoparquet(path, scene[[*SCENE.names, scene.geometry.name]], metadata)
