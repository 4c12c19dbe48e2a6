"""Stage 2, scenes: tiles of cleaned footprints with gutter, ground and roof angles (paper, 5.1)."""

from p2wss.data.footprints import clean_footprints, read_footprints, split_parts
from p2wss.scenes.cut import NEIGHBOUR_M, count_buildings, cut_scene, failed_fraction

__all__ = [
    "NEIGHBOUR_M",
    "clean_footprints",
    "count_buildings",
    "cut_scene",
    "failed_fraction",
    "read_footprints",
    "split_parts",
]
