"""Footprints as tables of geopandas, which tests write and read more easily than arrays."""

from __future__ import annotations

from typing import Any

import geopandas as gpd

from p2wss.config import Scenes
from p2wss.footprints import cleaning
from p2wss.storage.features import Features


def read_footprints(*arguments: Any, **more: Any) -> gpd.GeoDataFrame:
    return cleaning.read_footprints(*arguments, **more).to_frame()


def read_whole_blocks(*arguments: Any) -> gpd.GeoDataFrame:
    return cleaning.read_whole_blocks(*arguments).to_frame()


def split_parts(frame: gpd.GeoDataFrame, min_area_m2: float) -> gpd.GeoDataFrame:
    return cleaning.split_parts(Features.of(frame), min_area_m2).to_frame()


def clean_footprints(frame: gpd.GeoDataFrame, config: Scenes) -> gpd.GeoDataFrame:
    return cleaning.clean_footprints(Features.of(frame), config).to_frame()
