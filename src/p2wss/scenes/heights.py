"""Heights of a building: its eave height from BD TOPO, its ground height from the terrain."""

from __future__ import annotations

import numpy as np
import pandas as pd
import shapely

from p2wss.config import Scenes
from p2wss.data.seeds import generator
from p2wss.data.terrain import Terrain
from p2wss.storage.features import Features

# ranges of eave heights to draw from where BD TOPO has none, by its attribute nature, then by its usage
DRAWN_BY_NATURE_M = {
    "Serre": (2.5, 4.0),
    "Silo": (8.0, 20.0),
    "Eglise": (8.0, 14.0),
    "Chapelle": (3.5, 6.0),
    "Château": (7.0, 12.0),
    "Tour, donjon": (10.0, 20.0),
    "Industriel, agricole ou commercial": (4.0, 9.0),
}
DRAWN_BY_USAGE_M = {
    "Annexe": (2.2, 3.2),
    "Industriel": (4.0, 9.0),
    "Agricole": (3.5, 7.0),
    "Résidentiel": (2.8, 7.0),
}
DRAWN_M = (2.5, 6.5)
_STEP_M = 1.0  # between samples of the terrain along a footprint


def eave_heights(features: Features, config: Scenes) -> tuple[np.ndarray, np.ndarray]:
    """Eave height above the ground (float64, metres) and its source (text), one per feature.

    The height is the first of these that is known and at least ``min_eave_height_m``:

    1. "hauteur": BD TOPO's attribute, which is the height of the eave;
    2. "altitudes": altitude_minimale_toit - altitude_minimale_sol;
    3. "floors": num_floors x ``storey_height_m``;
    4. "drawn": drawn from a range by nature or usage, with a seed from (seed, "scenes", building_id).

    A column that they lack counts as unknown.
    """

    def numbers(name: str) -> np.ndarray:
        return features.columns.get(name, np.full(len(features), np.nan)).astype(float)

    candidates = {
        "hauteur": numbers("hauteur_m"),
        "altitudes": numbers("altitude_minimale_toit_m") - numbers("altitude_minimale_sol_m"),
        "floors": numbers("num_floors") * config.storey_height_m,
    }
    height = np.full(len(features), np.nan)
    source = np.full(len(features), "drawn", dtype=object)
    for name, values in candidates.items():
        rows = np.isnan(height) & (values >= config.min_eave_height_m) & np.isfinite(values)
        height[rows], source[rows] = values[rows], name
    for row in np.flatnonzero(np.isnan(height)):
        nature, usage = _text(features, "nature", int(row)), _text(features, "usage", int(row))
        low, high = DRAWN_BY_NATURE_M.get(nature) or DRAWN_BY_USAGE_M.get(usage) or DRAWN_M
        rng = generator(config.seed, "scenes", features["building_id"][row], "height")
        height[row] = np.round(rng.uniform(low, high), 1)
    return height, source


def _text(features: Features, column: str, row: int) -> str:
    value = features[column][row] if column in features.columns else None
    return value if isinstance(value, str) else ""


def ground_heights(shapes: np.ndarray, terrain: Terrain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Terrain along the edges of each polygon, sampled every metre: median (m), lowest (m), share with data.

    float64 arrays (len(shapes),): NaN, NaN and 0 for an empty polygon or one without terrain.
    """
    num_shapes = len(shapes)
    boundary = shapely.segmentize(shapely.boundary(shapes), _STEP_M)
    xy, shape = shapely.get_coordinates(boundary, return_index=True)
    z = terrain.interpolated(xy[:, 0], xy[:, 1])
    has_data = np.isfinite(z)
    count = np.bincount(shape, minlength=num_shapes)
    share = np.bincount(shape[has_data], minlength=num_shapes) / np.maximum(count, 1)
    by_shape = pd.Series(z[has_data]).groupby(shape[has_data])
    median, lowest = np.full(num_shapes, np.nan), np.full(num_shapes, np.nan)
    rows = np.unique(shape[has_data])
    median[rows], lowest[rows] = by_shape.median().to_numpy(), by_shape.min().to_numpy()
    return median, lowest, share
