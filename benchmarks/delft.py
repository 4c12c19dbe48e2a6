"""What `p2wss reconstruct` makes of 74 real houses, as a user runs it, judged by a script that shares no code with it.

    python benchmarks/delft.py --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py

Needs data (AHN3, 15 points per m², row houses in Delft) and the judge, which are not part of the project. Roofer's
output is recorded, not made here. The bars are those of the default. The last line is JSON.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from figures import Figures
from real_places import judged_file

VARIANTS = {
    "--no-fit": ["--no-fit"],
    "default": [],
    "--roofs parametric": ["--roofs", "parametric"],
    "detail: low": ["--config", '{"reconstruct": {"detail": "low"}}'],
    "detail: high": ["--config", '{"reconstruct": {"detail": "high"}}'],
}
# of the default: Chamfer distance, that of the roofs and points to mesh in metres, number of triangles
BARS = {"cd": 0.91, "roof": 0.24, "p2m": 0.117, "tri": 40}


def measures(judge: Path, city_json: Path, place: Path) -> dict[str, float]:
    """Mean measures of a CityJSON file, and the number of watertight buildings."""
    summary = judged_file(judge, city_json, place / "footprints.gpkg", [place / "ahn3.laz"])["summary"]
    means = {name: round(summary[name]["mean"], 3) for name in BARS}
    return means | {"watertight": round(summary["watertight"] * summary["meshes"])}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with delft_ahn3")
    parser.add_argument("--judge", type=Path, required=True, help="evaluate_cityjson.py")
    arguments = parser.parse_args()
    place = arguments.data / "delft_ahn3"
    figures = Figures()
    print(f"{'':<14} {'CD':>6} {'roof':>6} {'p2m':>6} {'tri':>6} watertight")
    with tempfile.TemporaryDirectory() as folder:
        files = {"Roofer": place / "roofer_lod22.city.jsonl"}
        for number, (name, options) in enumerate(VARIANTS.items()):
            out = Path(folder, str(number))
            command = ["p2wss", "reconstruct", place / "ahn3.laz", place / "footprints.gpkg", out, *options]
            subprocess.run([*command, "--format", "cityjsonseq"], check=True, stderr=subprocess.PIPE)
            files[name] = out / "ahn3.city.jsonl"
        for name, file in files.items():
            values = measures(arguments.judge, file, place)
            figures.row(name, values)
            cells = " ".join(f"{values[key]:6.3f}" for key in ("cd", "roof", "p2m"))
            print(f"{name:<14} {cells} {values['tri']:6.1f} {values['watertight']:.0f}")
            if name == "default":
                for key, bar in BARS.items():
                    figures.at_most(f"default, {key}", values[key], bar)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
