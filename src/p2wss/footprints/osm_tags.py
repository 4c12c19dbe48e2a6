"""Tags of OpenStreetMap, of which GDAL writes the rarer ones as text into one column of its layers of areas."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

# of GDAL's driver: which ways are areas, and which tags are columns
AREAS = Path(__file__).with_name("osm_areas.ini")
_OTHERS = "other_tags"
# columns of all layers of areas that GDAL makes of OpenStreetMap
_AREAS = {"osm_id", "osm_way_id", "building", _OTHERS}
_PAIR = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')


def with_others(columns: Mapping[str, np.ndarray], names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The columns, and those tags of these names that some feature has in the column of others (hstore or JSON).

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
    """Whether each of ``num`` features is a building or a part of one, bool (n,); of a layer that GDAL makes of
    OpenStreetMap, in which forests are areas, too. All features of others are."""
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
