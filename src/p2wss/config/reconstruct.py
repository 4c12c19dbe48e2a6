"""Section reconstruct: buildings from real LiDAR."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section

# what `p2wss reconstruct` writes, and how the names of these files end
OUTPUT_SUFFIXES = {
    "cityjsonseq": ".city.jsonl",
    "cityjson": ".city.json",
    "glb": ".glb",
    "obj": ".obj",
    "ply": ".ply",
    "stl": ".stl",
    "gpkg": ".gpkg",
    "geoparquet": ".parquet",
}
Output = Literal["cityjsonseq", "cityjson", "glb", "obj", "ply", "stl", "gpkg", "geoparquet"]


class Reconstruct(Section):
    """Buildings from the user's own LiDAR."""

    outputs: list[Output] = Field(
        ["cityjsonseq", "glb", "gpkg"], min_length=1, description="files to write, beside a summary in JSON"
    )
    per_building: bool = Field(
        False, description="one more glb, obj, ply and stl for each building, as far as outputs has them"
    )
    buffer_m: float = Field(
        1, ge=0, le=20, description="points within this distance of a footprint are its cloud"
    )
    min_num_points: int = Field(
        10, ge=1, description="a building with fewer gets a flat roof, none without any"
    )
    simplify_m: float = Field(
        0.3, ge=0, le=5, description="Douglas-Peucker tolerance for real footprints; 0 = as they are"
    )
    min_eave_height_m: float = Field(1, gt=0, description="lower predictions are raised to this")
    max_roof_height_m: float = Field(12, gt=0, description="a roof that would rise further is cut flat")
    fit: bool = Field(
        True, description="fit height and angles to the points; false = the values of the network as they are"
    )
    num_views: int = Field(
        1,
        ge=1,
        le=36,
        description="views of a building, turned about its axis, that the network sees before a fit; without a fit "
        "it sees model.decoding.num_rotations of its training",
    )
    max_parts: int = Field(
        4, ge=1, le=16, description="heights of one building at most; 1 = the paper's model"
    )
    dormers: bool = Field(
        False, description="box dormers and small boxes that rise out of a fitted roof, up to four each"
    )
    not_representable_m: float = Field(
        0.25, gt=0, description="a fitted building whose points are further off in the mean is flagged"
    )
    terrain_tolerance_m: float = Field(
        0.2, gt=0, le=10, description="of the triangulated terrain, where --terrain gives one"
    )
    terrain_margin_m: float = Field(20, ge=0, le=1000, description="of that terrain around the buildings")
