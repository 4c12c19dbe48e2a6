"""Tags of OpenStreetMap. GDAL writes the rarer tags as text into one column of its layers of areas."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

# configuration of GDAL's driver: which ways are areas, and which tags are columns
AREAS = Path(__file__).with_name("osm_areas.ini")
_OTHERS = "other_tags"
# columns that every layer of areas has that GDAL makes of OpenStreetMap
_AREAS = {"osm_id", "osm_way_id", "building", _OTHERS}
_PAIR = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')


def with_others(columns: Mapping[str, np.ndarray], names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The columns, plus a column for each of the tags ``names`` that are in the column of other tags (hstore or JSON).

    >>> columns = with_others({"other_tags": np.array(['"height"=>"9 m"', None], object)}, ("height", "levels"))
    >>> columns["height"].tolist(), list(columns)
    (['9 m', None], ['other_tags', 'height'])
    """
    tags = [_pairs(each) for each in columns.get(_OTHERS, np.zeros(0)).tolist()]
    found = {
        name: np.array([each.get(name) for each in tags], object) for name in names if name not in columns
    }
    return {**columns, **{name: each for name, each in found.items() if any(v is not None for v in each)}}


def is_building(columns: Mapping[str, np.ndarray], num: int) -> np.ndarray:
    """bool (num,): whether each feature is a building or a part of one. It matters for layers that GDAL makes of
    OpenStreetMap, in which forests are areas, too; all features of other layers count as buildings."""
    if not set(columns) >= _AREAS:
        return np.ones(num, bool)
    parts = with_others(columns, ("building:part",)).get("building:part", np.full(num, None, object))
    return np.array(
        [
            any(each is not None and each not in ("", "no") for each in pair)
            for pair in zip(columns["building"].tolist(), parts.tolist(), strict=True)
        ],
        bool,
    )


def _pairs(text: Any) -> dict[str, Any]:
    if not isinstance(text, str):
        return {}
    if text.startswith("{"):
        return dict(json.loads(text))
    return {key: value.replace('\\"', '"') for key, value in _PAIR.findall(text)}
