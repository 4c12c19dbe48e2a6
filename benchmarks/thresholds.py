"""What the thresholds of the fit change: simulated buildings with labels, and halves A and B of Delft.

The defaults are chosen by the simulated ones and half A; half B only tells how well that carries over.
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
from p2wss.fit.fitting import Thresholds
from p2wss.fit.points import roof_points
from p2wss.metrics.surface import distance_to_mesh

VARIED: dict[str, dict[str, tuple[float, ...]]] = {
    "cutting": {
        "gain_m": (0.006, 0.009, 0.012, 0.018, 0.025),
        "gain_share": (0.05, 0.1, 0.15, 0.25),
        "cost_m": (0.5, 1.0, 2.0),
    },
    "limits": {
        "class_gain_m": (0.001, 0.002, 0.004),
        "own_slope_gain_m": (0.003, 0.006, 0.012),
        "top_gain_m": (0.005, 0.01, 0.02),
    },
    "effort": {"num_followed": (3, 5, 9), "num_search_points": (48, 64, 96)},
}


def _points_to_mesh_m(building: Building, made: Reconstruction) -> float:
    own = roof_points(building.polygon, building.point_m, building.classification, made.ground_z_m)
    return float(distance_to_mesh(own - [0, 0, made.ground_z_m], made.vertex_m, made.triangle).mean())


def _measured(cases: list[Any], buildings: list[Building], thresholds: Thresholds) -> dict[str, float]:
    config = Config().reconstruct
    simulated = [case.building for case in cases]
    one = fitting.fit(simulated, labelled.config(), thresholds=thresholds)
    errors = labelled.summary(labelled.errors(cases, one))
    parts_allowed = labelled.config().model_copy(update={"max_parts": config.max_parts})
    cut = [made.num_parts > 1 for made in fitting.fit(simulated, parts_allowed, thresholds=thresholds)]
    made = fitting.fit(buildings, config, thresholds=thresholds)
    told = {"height_mae_m": errors["height_mae_m"], "angle_mae_deg": errors["angle_mae_deg"]}
    told["cut_in_vain"] = float(np.mean(cut))
    order = np.argsort([building.building_id for building in buildings])
    for half, index in (("A", order[::2]), ("B", order[1::2])):
        own = [i for i in index.tolist() if made[i].has_mesh]
        told[f"p2m_{half}_m"] = float(np.mean([_points_to_mesh_m(buildings[i], made[i]) for i in own]))
        told[f"tri_{half}"] = float(np.mean([len(made[i].triangle) for i in own]))
    return told


def table(manifest: Path, buildings: list[Building]) -> dict[str, Any]:
    """One row per value of each threshold, the others at their defaults; printed as it comes."""
    cases = labelled.read(manifest)
    default = Thresholds()
    rows: dict[str, Any] = {"default": _measured(cases, buildings, default)}
    print("threshold".ljust(28) + "".join(name.rjust(15) for name in rows["default"]))
    _print("default", rows["default"])
    for group, fields in VARIED.items():
        for field, values in fields.items():
            for value in values:
                own = getattr(default, group)
                if value != getattr(own, field):
                    changed = replace(default, **{group: replace(own, **{field: value})})
                    rows[f"{field} = {value:g}"] = _measured(cases, buildings, changed)
                    _print(f"{field} = {value:g}", rows[f"{field} = {value:g}"])
    return rows


def _print(title: str, row: dict[str, float]) -> None:
    print(title.ljust(28) + "".join(f"{value:15.4f}" for value in row.values()), flush=True)
