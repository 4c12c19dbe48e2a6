"""What ``p2wss plan`` says of the miniature, a city, the paper, a département and France; the last line is JSON.

    python benchmarks/plans.py

In an empty folder: nothing is counted or downloaded yet. The département and France are rectangles of their area, with
the mean density of buildings in France; real LiDAR everywhere, the shipped weights, an evaluation of 100,000 buildings
of each kind.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import yaml
from figures import Figures

ROOT = Path(__file__).resolve().parents[1]
# about 48 million buildings (Référentiel national des bâtiments) on 551,500 km2
BUILDINGS_PER_KM2 = 87
FIGURES = [
    "tiles",
    "jobs",
    "buildings",
    "pairs",
    "real_clouds",
    "cpu_hours",
    "gpu_hours",
    "cpu_hours_without_gpu",
    "download_gb",
    "disk_gb",
    "peak_memory_gb",
]


def area(name: str, width_km: int, height_km: int) -> dict[str, Any]:
    """The config of a rectangle with real LiDAR everywhere."""
    bounds_m = [100_000, 6_100_000, 100_000 + 1000 * width_km, 6_100_000 + 1000 * height_km]
    return {
        "region": {
            "name": name,
            "vintage": name,
            "bounds_m": bounds_m,
            "tiles": ["all"],
            "lidar_tiles": ["all"],
        },
        "dataset": {"num_pairs": 1_000_000, "num_lidar_dvae": 1, "num_lidar_test": 100_000},
        "fetch": {"source": "geoplateforme", "geoplateforme": {"footprints_window_m": 5000}},
        "model": {"weights": str(ROOT / "models/point2wss.safetensors")},
        "plan": {"buildings_per_km2": BUILDINGS_PER_KM2},
    }


CONFIGS: dict[str, str | dict[str, Any] | None] = {
    "miniature": None,
    "city": "config/regions/lyon.yaml",
    "paper": "config/paper.yaml",
    "département": area("departement", 80, 75),  # 6,000 km2, the mean
    "France": area("france", 750, 735),
}


def plan(config: str | dict[str, Any] | None, folder: Path) -> dict[str, Any]:
    """The JSON of ``p2wss plan`` for a config of the project, for settings, or for the miniature."""
    command = [sys.executable, "-m", "p2wss.cli", "plan", "--json", "--costs", str(ROOT / "config/costs.csv")]
    if isinstance(config, str):
        command += ["--config", str(ROOT / config)]
    elif config is not None:
        path = folder / "config.yaml"
        path.write_text(yaml.safe_dump(config))
        command += ["--config", str(path)]
    run = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(run.stdout)


def main() -> int:
    figures = Figures()
    with tempfile.TemporaryDirectory() as folder:
        plans = {name: plan(config, Path(folder)) for name, config in CONFIGS.items()}
    print(f"{'':22}" + "".join(f"{name:>14}" for name in plans))
    for name in FIGURES:
        print(f"{name:22}" + "".join(f"{result[name]:14,.5g}" for result in plans.values()))
    for name, result in plans.items():
        figures.row(name, {key: result[key] for key in FIGURES})
    for name in ("pairs", "lidar_dvae", "lidar_test"):
        wanted = {"pairs": 800_000, "lidar_dvae": 500_000, "lidar_test": 350_000}[name]
        figures.at_least(f"paper: {name}", plans["paper"][name], wanted)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
