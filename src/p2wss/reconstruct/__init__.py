"""Stage reconstruct: closed buildings from footprints and LiDAR (paper, section 5.4)."""

from p2wss.reconstruct.inputs import common_crs, of_tile, output_stem, shipped_model, weights_to_use, window
from p2wss.reconstruct.pipeline import (
    Progress,
    Result,
    attributes,
    check_overlap,
    city_json,
    method_name,
    reconstruct_buildings,
    run,
    solid,
    summary,
    table,
    vertices_m,
)

__all__ = [
    "Progress",
    "Result",
    "attributes",
    "check_overlap",
    "city_json",
    "common_crs",
    "method_name",
    "of_tile",
    "output_stem",
    "reconstruct_buildings",
    "run",
    "shipped_model",
    "solid",
    "summary",
    "table",
    "vertices_m",
    "weights_to_use",
    "window",
]
