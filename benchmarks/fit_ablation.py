"""What each part of the model of the fit is worth: real buildings reconstructed without it, against the judge.

    python benchmarks/fit_ablation.py --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py

Needs ``delft_ahn3``, ``lidarhd_crops``, ``bresse_ign`` and the judge, which are not part of the project.

Means over the original clouds and three copies jittered by 2.5 mm, without the network; there are no bars. Half A of
Delft (every second house by id) and blocks b0 and b4 were used for tuning, all other buildings were not.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import real
from figures import Figures

from p2wss.config import Config, Reconstruct
from p2wss.data.building import Building
from p2wss.fit import fitting
from p2wss.fit.settings import Detection, Planes, Thresholds
from p2wss.reconstruction.product import with_fallback

_NUM_COPIES, _JITTER_M = 4, 0.0025
_DEFAULT = Config().reconstruct


def _with(**settings: Any) -> Thresholds:
    return Thresholds(planes=Planes()._replace(**settings))


def _with_prices(**prices: float) -> Thresholds:
    return _with(prices=Planes().prices._replace(**prices))


VARIANTS: dict[str, tuple[Reconstruct, Thresholds]] = {
    "default": (_DEFAULT, Thresholds()),
    "short edges stay": (_DEFAULT, Thresholds(short_edge_m=0.0)),
    "edges cost nothing, faces four times": (_DEFAULT, _with_prices(face_m3=0.6, edge_m2=1e-9)),
    "all edges cost the same": (_DEFAULT, _with_prices(meet_share=1.0, small_step_share=1.0)),
    "planes stay as detected": (_DEFAULT, _with(detection=Detection(simpler_m=0.0))),
    "no wall moves": (_DEFAULT.model_copy(update={"max_wall_shift_m": 0.0}), Thresholds()),
    "`detail: low`": (_DEFAULT.model_copy(update={"detail": "low"}), Thresholds()),
    "`detail: high`": (_DEFAULT.model_copy(update={"detail": "high"}), Thresholds()),
}


def jittered(building: Building, copy: int) -> Building:
    """A copy of a building whose points are moved by normal noise; copy 0 is the building itself."""
    if copy == 0:
        return building
    rng = np.random.default_rng([copy, *building.building_id.encode()])
    return replace(building, point_m=building.point_m + rng.normal(0, _JITTER_M, building.point_m.shape))


def judged_rows(
    buildings: list[Building],
    name: str,
    config: Reconstruct,
    thresholds: Thresholds,
    arguments: argparse.Namespace,
) -> list[dict[str, Any]]:
    """The judge's rows of all copies of a data set."""
    rows: list[dict[str, Any]] = []
    for copy in range(_NUM_COPIES):
        copies = [jittered(building, copy) for building in buildings]
        fits = with_fallback(fitting.fit(copies, config, thresholds=thresholds), copies, config)
        rows += real.judged(fits, name, arguments)
    return rows


def groups(name: str, ids: Sequence[str]) -> dict[str, set[str]]:
    """The groups in which a data set is reported: members by name."""
    if name == "delft":
        return {"delft": set(ids), "half A": set(ids[::2]), "half B": set(ids[1::2])}
    if name == "blocks":
        return {"blocks": set(ids), "b0 and b4": {ids[0], ids[4]}, "b1 to b3": set(ids[1:4])}
    return {name: set(ids)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--judge", type=Path, required=True)
    parser.add_argument("--variant", action="append", help="only this one; may be repeated")
    arguments = parser.parse_args()
    figures = Figures()
    print("variant".ljust(36) + "CD, roof CD, points to mesh, triangles")
    for name in real.SETS:
        buildings = real.read(arguments.data, name, Config())
        ids = sorted(building.building_id for building in buildings)
        for variant in arguments.variant or VARIANTS:
            rows = judged_rows(buildings, name, *VARIANTS[variant], arguments)
            for group, members in groups(name, ids).items():
                row = real.summary([row for row in rows if row["id"] in members])
                figures.row(f"{variant}, {group}", row)
                values = ", ".join(f"{row[key]:.4f}" for key in ("cd", "roof", "p2m")) + f", {row['tri']:.1f}"
                print(variant.ljust(36) + group.ljust(12) + values, flush=True)
                figures.at_least(f"{variant}, {group}, closed", row["watertight"], 1.0)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
