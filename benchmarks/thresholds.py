"""The effect of each threshold of the fit: on simulated buildings with labels, and on halves A and B of Delft.

The defaults were chosen on the simulated buildings and half A; half B only shows how well they generalise.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import labelled
import numpy as np

from p2wss.config import Config
from p2wss.data.building import Building, Reconstruction
from p2wss.fit import fitting
from p2wss.fit.points import roof_points
from p2wss.fit.settings import Thresholds
from p2wss.mesh.surface import distance_to_mesh

VARIATIONS: dict[str, dict[str, tuple[float, ...]]] = {
    "cutting": {
        "mean_price_m": (0.005, 0.007, 0.01, 0.014, 0.02),
        "slope_share": (0.0, 0.2, 0.3, 0.5),
        "over_share": (0.2, 0.4, 0.7, 1.0),
        "loss_share": (0.0, 0.5, 0.7, 1.0),
        "min_price_m": (0.5, 1.0, 2.0),
    },
    "limits": {
        "class_gain_m": (0.001, 0.002, 0.004),
        "separate_slope_gain_m": (0.003, 0.006, 0.012),
    },
    "effort": {"num_followed": (3, 5, 9), "num_search_points": (48, 64, 96)},
}


def _points_to_mesh_m(building: Building, fit: Reconstruction) -> float:
    point_m = roof_points(building.polygon, building.point_m, building.classification)
    return float(distance_to_mesh(point_m, fit.mesh.vertex_m, fit.mesh.triangle).mean())


def _measures(cases: list[Any], buildings: list[Building], thresholds: Thresholds) -> dict[str, float]:
    """Errors of simulated ``cases``, the share of them that is cut into parts although all have one height, and the
    distance from points to mesh and the number of triangles on both halves of real ``buildings``."""
    config = Config().reconstruct
    simulated = [case.building for case in cases]
    one_part = fitting.fit(simulated, labelled.config(), thresholds=thresholds)
    errors = labelled.summary(labelled.errors(cases, one_part))
    several_parts = labelled.config().model_copy(update={"max_parts": config.max_parts})
    is_cut = [fit.num_parts > 1 for fit in fitting.fit(simulated, several_parts, thresholds=thresholds)]
    fits = fitting.fit(buildings, config, thresholds=thresholds)
    measures = {"height_mae_m": errors["height_mae_m"], "angle_mae_deg": errors["angle_mae_deg"]}
    measures["wrongly_cut"] = float(np.mean(is_cut))
    order = np.argsort([building.building_id for building in buildings])
    for half, index in (("A", order[::2]), ("B", order[1::2])):
        meshed = [i for i in index.tolist() if fits[i].has_mesh]
        distances_m = [_points_to_mesh_m(buildings[i], fits[i]) for i in meshed]
        measures[f"p2m_{half}_m"] = float(np.mean(distances_m))
        measures[f"triangles_{half}"] = float(np.mean([len(fits[i].mesh.triangle) for i in meshed]))
    return measures


def table(manifest: Path, buildings: list[Building]) -> dict[str, Any]:
    """One row per value of each threshold, the others at their defaults; printed as it comes."""
    cases = labelled.read(manifest)
    default = Thresholds()
    rows: dict[str, Any] = {"default": _measures(cases, buildings, default)}
    print("threshold".ljust(28) + "".join(name.rjust(15) for name in rows["default"]))
    _print("default", rows["default"])
    for group, fields in VARIATIONS.items():
        for field, values in fields.items():
            for value in values:
                defaults = getattr(default, group)
                if value != getattr(defaults, field):
                    title = f"{field} = {value:g}"
                    new = {field: value}
                    settings = (
                        defaults._replace(**new) if isinstance(defaults, tuple) else replace(defaults, **new)
                    )
                    changed = replace(default, **{group: settings})
                    rows[title] = _measures(cases, buildings, changed)
                    _print(title, rows[title])
    return rows


def _print(title: str, row: dict[str, float]) -> None:
    print(title.ljust(28) + "".join(f"{value:15.4f}" for value in row.values()), flush=True)
