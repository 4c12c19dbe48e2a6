"""Real houses with few points: how near planes and parametric roofs are to all points; the last line is JSON.

    python benchmarks/few_points.py --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py
    .. --model models/point2wss.safetensors       # also the network
    .. --densities      # so many points per square metre, for the curve of docs/img/density.py

Needs ``delft_ahn3`` and the judge, which are not part of the project.

Three times, a number of points of each house of Delft is drawn, and the same share of the points beside it; the judge
measures against all points. Settings were chosen on half A of the houses (every second by id), none on half B.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import real
import shapely
from figures import Figures

from p2wss.clouds.crops import AROUND_M, FEW_POINTS
from p2wss.config import Config, Reconstruct
from p2wss.data.building import Building, Reconstruction
from p2wss.data.las_classes import BUILDING_CLASS
from p2wss.fit import fitting
from p2wss.reconstruction.product import (
    reconstruct_buildings,
    reconstruct_with_network,
    with_fallback,
    with_supposed_roofs,
)

_NUM_DRAWS = 3
# points per square metre of the footprint; at 20, nearly all houses keep all their points, 14 per square metre (median)
DENSITIES = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
# bars of half B: (points to mesh, roof CD) in metres, by number of points on each building or, below 1, by their share
BARS: dict[float, tuple[float, float]] = {
    80: (0.133, 0.240),
    40: (0.160, 0.280),
    20: (0.185, 0.330),
    10: (0.240, 0.430),
    0.1: (0.150, 0.270),
    0.03: (0.280, 0.450),
}


def thinned(building: Building, amount: float, draw: int, per_m2: bool = False) -> Building:
    """A building with some of its points: ``amount`` points of class building, or that share of them if it is below 1,
    or with ``per_m2`` so many per square metre of the footprint. About the same share of the other points is kept."""
    on_building = np.flatnonzero(building.classification == BUILDING_CLASS)
    unit = building.polygon.area if per_m2 else 1.0 if amount >= 1 else len(on_building)
    count = min(len(on_building), round(amount * unit))
    rng = np.random.default_rng([draw, *building.building_id.encode()])
    others = np.setdiff1d(np.arange(len(building.point_m)), on_building)
    chosen = rng.choice(on_building, count, replace=False)
    others = others[rng.random(len(others)) * max(len(on_building), 1) < count]
    rows = np.sort(np.concatenate([chosen, others]))
    return replace(building, point_m=building.point_m[rows], classification=building.classification[rows])


def with_roofs_around(buildings: list[Building]) -> list[Building]:
    """The buildings; a building with few points gets the points on the roofs around it, as in the command."""
    placed = [(each.point_m + each.position_m)[each.is_on_building] for each in buildings]
    result = []
    for number, building in enumerate(buildings):
        others_m = (
            np.vstack([each for other, each in enumerate(placed) if other != number]) - building.position_m
        )
        beside_m = shapely.distance(building.polygon, shapely.points(others_m[:, :2]))
        num_inside = shapely.contains_xy(building.polygon, *building.point_m[:, :2].T).sum()
        around = (beside_m < AROUND_M) & (num_inside < FEW_POINTS)
        result.append(replace(building, around_m=others_m[around]))
    return result


def only_supposed(building: Building) -> Building:
    """A building with the roof that the network predicts in place of its points; unchanged if it has many points."""
    (supposed,) = with_supposed_roofs([building])
    if not len(supposed.supposed_m):
        return building
    classes = np.full(len(supposed.supposed_m), BUILDING_CLASS, np.uint8)
    none_m = np.zeros((0, 3))
    return replace(
        building, point_m=supposed.supposed_m, classification=classes, around_m=none_m, supposed_m=none_m
    )


def fits_of(
    buildings: list[Building], config: Reconstruct, predictor: Any, only_default: bool
) -> dict[str, list[Reconstruction]]:
    """Reconstructions by method. "fit": without the network; "alone": also without points on roofs around; "supposed":
    from the network's roof in place of the points. only_default: the default alone."""
    default = reconstruct_buildings(buildings, None, config)
    if only_default:
        return {"default": default}
    parametric = config.model_copy(update={"roofs": "parametric"})
    alone = [replace(each, around_m=np.zeros((0, 3))) for each in buildings]
    fits = {"fit": fitting.fit(buildings, config), "alone": fitting.fit(alone, config)}
    fits |= {"parametric": fitting.fit(buildings, parametric)}
    fits |= {"supposed": fitting.fit([only_supposed(each) for each in buildings], config)}
    if predictor is not None:
        fits["network"] = reconstruct_with_network(buildings, predictor, config)
    return {"default": default} | {
        name: with_fallback(rows, buildings, config) for name, rows in fits.items()
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--judge", type=Path, required=True)
    parser.add_argument("--model", type=Path, default=None, help="weights of a network")
    parser.add_argument("--densities", action="store_true", help="points per square metre, for the curve")
    arguments = parser.parse_args()
    config, predictor = Config().reconstruct, None
    if arguments.model is not None:
        from p2wss.nets.predictor import load_predictor

        predictor = load_predictor(arguments.model)
    figures = Figures()
    buildings = real.read(arguments.data, "delft", Config())
    half_b = set(sorted(building.building_id for building in buildings)[1::2])
    print("points".ljust(8) + "method".ljust(22) + "half A, half B: points to mesh/roof CD/triangles")
    per_m2 = arguments.densities
    for amount in DENSITIES if per_m2 else BARS:
        rows: dict[str, list[dict[str, Any]]] = {}
        for draw in range(_NUM_DRAWS):
            few = with_roofs_around([thinned(building, amount, draw, per_m2) for building in buildings])
            for method, fits in fits_of(few, config, predictor, per_m2).items():
                rows.setdefault(method, []).extend(real.judged(fits, "delft", arguments))
        for method, every in rows.items():
            halves = [
                real.summary([row for row in every if (row["id"] in half_b) == is_b])
                for is_b in (False, True)
            ]
            values = "  ".join(f"{half['p2m']:.3f}/{half['roof']:.3f}/{half['tri']:.0f}" for half in halves)
            print(f"{amount:<8g}{method:<22}{values}", flush=True)
            unit = " per m²" if per_m2 else ""
            figures.row(f"{amount:g}{unit}, {method}", {"half A": halves[0], "half B": halves[1]})
            if method == "default" and not per_m2:
                p2m, roof = BARS[amount]
                figures.at_most(f"{amount:g}, points to mesh", halves[1]["p2m"], p2m)
                figures.at_most(f"{amount:g}, roof CD", halves[1]["roof"], roof)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
