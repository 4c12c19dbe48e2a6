"""Stage reconstruct: closed buildings from footprints and LiDAR (paper, section 5.4)."""

from p2wss.reconstruct.pipeline import (
    Progress,
    Result,
    attributes,
    check_overlap,
    city_json,
    common_crs,
    method_name,
    of_tile,
    output_stem,
    run,
    shipped_model,
    solid,
    summary,
    table,
    vertices_m,
    window,
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
    "run",
    "shipped_model",
    "solid",
    "summary",
    "table",
    "vertices_m",
    "window",
]
