"""Draws docs/img/density.svg, accuracy against density, from the stored figures: ``python docs/img/density.py``.

python benchmarks/results.py --record few_points --code fit reconstruct.flat -- \
    python benchmarks/few_points.py --data .. --judge .. --densities
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt

RESULTS = Path(__file__).resolve().parents[1] / "results"
# points per m² of all points, the median of the houses
ALL_PER_M2 = 14.0
# key, title, colour
MEASURES = (("p2m", "points to mesh", "#c8553d"), ("roof", "roof CD", "#3d6fc8"))


def main() -> None:
    figures = json.loads((RESULTS / "few_points.json").read_text())["figures"]
    roofer = json.loads((RESULTS / "delft_judge.json").read_text())["figures"]["Roofer"]
    rows = {
        min(float(name.split()[0]), ALL_PER_M2): row
        for name, row in figures.items()
        if name.endswith("per m², default")
    }
    plt.rcParams.update({"font.size": 9, "svg.hashsalt": "p2wss"})
    figure, axes = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
    for key, title, colour in MEASURES:
        mean_m = [(row["half A"][key] + row["half B"][key]) / 2 for row in rows.values()]
        axes.plot(list(rows), mean_m, "o-", color=colour, label=title, markersize=4)
        axes.plot(max(rows), roofer[key], "x", color=colour, label=f"Roofer, all points (recorded): {title}")
    axes.set(xscale="log", yscale="log", xlabel="points on each building per m² of footprint", ylabel="m")
    axes.set_xticks(list(rows), [*(f"{value:g}" for value in list(rows)[:-1]), "all"])
    axes.set_yticks([0.1, 0.2, 0.5, 1.0], ["0.1", "0.2", "0.5", "1"])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(Path(__file__).with_name("density.svg"), metadata={"Date": None})


if __name__ == "__main__":
    main()
