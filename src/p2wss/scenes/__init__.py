"""Stage scenes: tiles of clean footprints with eave heights, ground heights and roof angles (paper, section 5.1)."""

from p2wss.footprints.cleaning import clean_footprints, read_footprints, split_parts
from p2wss.scenes.cut import NEIGHBOUR_DISTANCE_M, count_buildings, cut_scene, failed_fraction

__all__ = [
    "NEIGHBOUR_DISTANCE_M",
    "clean_footprints",
    "count_buildings",
    "cut_scene",
    "failed_fraction",
    "read_footprints",
    "split_parts",
]
