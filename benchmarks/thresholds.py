"""The effect of the prices of planes: on the structure of drawn houses, and on real houses and blocks.

    python benchmarks/thresholds.py --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py

Needs ``delft_ahn3``, ``lidarhd_crops`` and the judge, which are not part of the project.

The defaults were chosen on the towns of seeds 7 and 8, half A of Delft, and blocks b0 and b4; there are no bars.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import real
import structure
from drawn_towns.files import ROOFS, write_town
from drawn_towns.lidar import LIDAR
from figures import Figures
from roof_edges import structure as structure_of

import p2wss
from p2wss.config import Config
from p2wss.data.building import Building
from p2wss.fit import fitting
from p2wss.fit.settings import PlanePrices, Planes, Thresholds
from p2wss.mesh import Mesh
from p2wss.reconstruction.product import with_fallback
from p2wss.towns import FOOTPRINTS

SEEDS = (7, 8)
VARIATIONS: dict[str, tuple[float, ...]] = {
    "face_m3": (0.05, 0.15, 0.3),
    "edge_m2": (0.1, 0.12, 0.2),
    "line_m3": (0.0, 0.08, 0.3),
    "meet_share": (0.25, 1.0),
    "small_step_share": (1.0, 3.0),
    "support_m": (0.2, 100.0),
}


def town(seed: int, folder: Path) -> tuple[dict[str, Mesh], list[Building]]:
    """(true meshes by building, buildings with their points) of a drawn town."""
    write_town(folder, seed, "wings")
    truth = {name: each.solid for name, each in p2wss.read(folder / ROOFS).items()}
    buildings = real.read_files(folder / FOOTPRINTS, [folder / LIDAR], "wings", Config())
    return {name: mesh for name, mesh in truth.items() if mesh is not None}, buildings


def of_town(truth: dict[str, Mesh], buildings: list[Building], thresholds: Thresholds) -> dict[str, float]:
    """False and missing edges, exact roofs and triangles of the houses of a town."""
    fits = {
        fit.building_id: fit for fit in fitting.fit(buildings, Config().reconstruct, thresholds=thresholds)
    }
    rows = []
    for name, true in truth.items():
        mesh = fits[name].placed_mesh if name in fits and fits[name].has_mesh else Mesh.empty()
        found = structure_of(mesh, true)
        rows.append({"structure": found, "roof_cd_m": np.nan, "triangles": len(mesh.triangle)})
    figures = structure.summary(rows)
    return {
        name: float(figures[name]) for name in ("false edges", "missing edges", "exact roofs", "triangles")
    }


def of_places(
    places: dict[str, list[Building]], thresholds: Thresholds, arguments: argparse.Namespace
) -> dict[str, float]:
    """Points to mesh and triangles of real buildings."""
    result: dict[str, float] = {}
    config = Config().reconstruct
    for name, buildings in places.items():
        fits = with_fallback(fitting.fit(buildings, config, thresholds=thresholds), buildings, config)
        rows = real.summary(real.judged(fits, name, arguments))
        result |= {f"{name}, points to mesh": rows["p2m"], f"{name}, triangles": rows["tri"]}
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--judge", type=Path, required=True)
    arguments = parser.parse_args()
    figures = Figures()
    places = {name: real.read(arguments.data, name, Config()) for name in ("delft", "blocks")}
    with tempfile.TemporaryDirectory() as folder:
        towns = {seed: town(seed, Path(folder) / str(seed)) for seed in SEEDS}
        prices: list[tuple[str, PlanePrices]] = [("default", PlanePrices())]
        for field, values in VARIATIONS.items():
            prices += [(f"{field} = {value:g}", PlanePrices()._replace(**{field: value})) for value in values]
        for title, each in prices:
            thresholds = Thresholds(planes=Planes(prices=each))
            row: dict[str, Any] = {}
            for seed, (truth, buildings) in towns.items():
                of_seed = of_town(truth, buildings, thresholds)
                row |= {f"town {seed}, {name}": value for name, value in of_seed.items()}
            row |= of_places(places, thresholds, arguments)
            figures.row(title, row)
            print(
                title.ljust(26) + ", ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True
            )
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
