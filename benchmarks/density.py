"""How many true roofs are found exactly with few points per square metre, and with noise; the last line is JSON.

    python benchmarks/density.py --data ../shared/data --judge ../shared/tools/structure.py
    .. --lines 0.2      # with the inner lines of the true roofs as for `p2wss reconstruct --lines`, moved by 0.2 m

Needs ``trondheim``, ``nyc_roofn3d`` and the judge, which are not part of the project; a place that is absent is left
out.

The true roofs are wireframes that persons labelled, and the outlines are traced from the points. For each density,
points within an outline are drawn at random, and the same share of the points beside it. The judge compares the
edges of the roofs with the true ones. A roof is exact if less than 2 % of its edges are false, and less than 2 %
missing, by more than 0.5 m. In Trondheim noise is measured, too: it moves all points up or down, as in heights from
pictures, or every second point is higher, as with two flights that do not fit each other.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import few_points
import numpy as np
import pyproj
import real
from figures import Figures

from p2wss.config import Config
from p2wss.data.building import Building
from p2wss.reconstruction.outputs.city import city_json
from p2wss.reconstruction.product import reconstruct_buildings
from p2wss.reconstruction.result import Result
from p2wss.reconstruction.roof_lines import LINES, with_lines
from p2wss.storage.features import Features

EPSG = {"trondheim": 25832, "nyc_roofn3d": 32118}
# more points per square metre than any building has
ALL_PER_M2 = 1000.0
# bars by points per square metre: share of exact roofs in Trondheim
BARS = {3.0: 0.9, 1.0: 0.85, 0.5: 0.65}
# bars by noise of heights and by shift of every second point, metres: share of exact roofs in Trondheim
NOISE_BARS = {(0.1, 0.0): 0.9, (0.15, 0.0): 0.85, (0.2, 0.0): 0.7, (0.0, 0.2): 0.9}
FIGURES = r"false edges ([\d.]+), missing ([\d.]+), exact (\d+) of (\d+), corners F1 ([\d.]+)"


def judged(buildings: list[Building], place: Path, judge: Path) -> dict[str, float]:
    """What the judge says about the roofs of some buildings of a place."""
    rows = reconstruct_buildings(buildings, None, Config().reconstruct)
    results = [Result(row, "ok", None, 0, np.nan, np.nan, False) for row in rows]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "roofs.city.jsonl"
        path.write_text("".join(city_json(results, pyproj.CRS(EPSG[place.name]))), encoding="utf-8")
        command = list(map(str, [sys.executable, judge, path, place / "wireframes.json"]))
        line = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = re.fullmatch(FIGURES, line.strip())
    assert found, line
    false, missing, num_exact, num_roofs, corners = map(float, found.groups())
    return {"exact": num_exact / num_roofs, "false": false, "missing": missing, "corners": corners}


def noisy(building: Building, noise_m: float, apart_m: float, seed: int) -> Building:
    """A building with normal noise on the heights of its points, and with every second point higher by ``apart_m``."""
    rng = np.random.default_rng([seed, *building.building_id.encode()])
    num = len(building.point_m)
    off_m = noise_m * rng.normal(size=num) + apart_m * (rng.random(num) < 0.5)
    return replace(building, point_m=building.point_m + np.column_stack([np.zeros((num, 2)), off_m]))


def few(building: Building, per_m2: float, seed: int) -> Building:
    return few_points.thinned(building, per_m2, seed, True)


# kinds of points: a function of a building and a seed that makes them, and the bar in Trondheim. Noise is measured
# there only
DENSITIES = {
    "all per m²": (partial(few, per_m2=ALL_PER_M2), None),
    **{f"{per_m2:g} per m²": (partial(few, per_m2=per_m2), bar) for per_m2, bar in BARS.items()},
}
NOISES = {
    f"flights {apart_m:g} m apart" if apart_m else f"noise of {noise_m:g} m": (
        partial(noisy, noise_m=noise_m, apart_m=apart_m),
        bar,
    )
    for (noise_m, apart_m), bar in NOISE_BARS.items()
}


def with_true_lines(
    building: Building, wireframe: dict[str, list] | None, moved_m: float, seed: int
) -> Building:
    """A building with the lines of its true roof within its footprint, their vertices moved by normal noise."""
    if wireframe is None:
        return building
    vertex_m = np.array(wireframe["vertex_m"])[:, :2] - building.origin_xy_m
    rng = np.random.default_rng([seed, *building.building_id.encode()])
    end_m = (vertex_m + rng.normal(0, 1, vertex_m.shape) * moved_m)[np.array(wireframe["edge"])]
    features = with_lines(Features(np.array([building.polygon], object), {}, None), end_m)
    return replace(building, line_m=features[LINES][0])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--judge", type=Path, required=True)
    parser.add_argument("--lines", type=float, help="with lines of true roofs, moved by so many metres")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    arguments = parser.parse_args()
    figures = Figures()
    print("place, points".ljust(34) + "exact, false, missing, corners F1")
    for name in EPSG:
        place = arguments.data / name
        if not place.exists():
            continue
        buildings = real.read_files(place / "footprints.gpkg", [place / "cloud.laz"], name, Config())
        wireframes = json.loads((place / "wireframes.json").read_text(encoding="utf-8"))
        has_bars = name == "trondheim" and arguments.lines is None
        for kind, (drawing, bar) in (DENSITIES | (NOISES if has_bars else {})).items():
            draws = []
            for seed in arguments.seeds if bar else [0]:
                drawn = [drawing(each, seed=seed) for each in buildings]
                if arguments.lines is not None:
                    drawn = [
                        with_true_lines(each, wireframes.get(each.building_id), arguments.lines, seed)
                        for each in drawn
                    ]
                draws.append(judged(few_points.with_roofs_around(drawn), place, arguments.judge))
            mean = {key: float(np.mean([draw[key] for draw in draws])) for key in draws[0]}
            label = f"{name}, {kind}"
            print(label.ljust(34) + ", ".join(f"{value:.3f}" for value in mean.values()))
            figures.row(label, mean)
            if bar and has_bars:
                figures.at_least(f"{label}, exact", mean["exact"], bar)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
