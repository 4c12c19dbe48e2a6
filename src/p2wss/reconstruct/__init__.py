"""Stage reconstruct: closed buildings from footprints and LiDAR (paper, section 5.4)."""

from p2wss.data.metric_crs import common_crs, metric_crs
from p2wss.nets.weights_file import shipped_model, weights_to_use
from p2wss.reconstruct.area import Area, run_area
from p2wss.reconstruct.attributes import TO_3DBAG, attributes, input_footprints, table
from p2wss.reconstruct.city import city_json, solid
from p2wss.reconstruct.inputs import footprint_settings, in_tile, output_stem, window
from p2wss.reconstruct.outlines import outline_frame
from p2wss.reconstruct.pipeline import (
    Result,
    check_overlap,
    no_overlap,
    run,
    summary,
    vertices_m,
)
from p2wss.reconstruct.product import method_name, reconstruct_buildings
from p2wss.reconstruct.registration import Registration, register
from p2wss.reconstruct.registration import summary as registration_summary

__all__ = [
    "TO_3DBAG",
    "Area",
    "Registration",
    "Result",
    "attributes",
    "check_overlap",
    "city_json",
    "common_crs",
    "footprint_settings",
    "in_tile",
    "input_footprints",
    "method_name",
    "metric_crs",
    "no_overlap",
    "outline_frame",
    "output_stem",
    "reconstruct_buildings",
    "register",
    "registration_summary",
    "run",
    "run_area",
    "shipped_model",
    "solid",
    "summary",
    "table",
    "vertices_m",
    "weights_to_use",
    "window",
]
