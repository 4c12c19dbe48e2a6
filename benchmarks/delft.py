"""What `p2wss reconstruct` makes of 74 real houses, as a user runs it.

    python benchmarks/delft.py --download delft     # fetches 3.6 MB into the folder delft; needs the network once
    python benchmarks/delft.py --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py

The houses are row houses in Delft (AHN3, 15 points per m²; footprints of the BGT). ``--download`` cuts them out of the
example data of 3dfier, whose digests are checked. The footprints are bit-identical to the footprints of ``--data``, and
the cloud has the same points, both in the same order. ``--judge`` is a script that shares no code with p2wss and is not
part of the project; without it, ``p2wss evaluate`` measures by the same definitions. Roofer's output is recorded in
``--data``; elsewhere the program is run if it is installed. The bars apply to the default. The last line is JSON.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.request import urlopen

import geopandas as gpd
import laspy
import numpy as np
from figures import Figures
from real_places import judged_file

import p2wss

VARIANTS = {
    "--model point2wss": ["--model", "point2wss"],
    "default": [],
    "--roofs parametric": ["--roofs", "parametric"],
    "detail: low": ["--config", '{"reconstruct": {"detail": "low"}}'],
    "detail: high": ["--config", '{"reconstruct": {"detail": "high"}}'],
}
# bars of the default: Chamfer distance, roof Chamfer distance and points to mesh in metres, number of triangles
BARS = {"cd": 0.91, "roof": 0.24, "p2m": 0.117, "tri": 40}
# the same measures as columns of `p2wss evaluate`
COLUMNS = {"cd": "cd_m", "roof": "roof_cd_m", "p2m": "points_to_mesh_m", "tri": "num_triangles"}
# example data of 3dfier (TU Delft) at one commit, and the SHA-256 of its files
SOURCE = (
    "https://raw.githubusercontent.com/tudelft3d/3dfier/238782d14e4cac442275fc72256e01c4f3f9a623/example_data"
)
CLOUD, FOOTPRINTS = "ahn3/ahn3_cropped_1.laz", "bgt/bgt_pand.sqlite"
DIGESTS = {
    CLOUD: "0f55355090308932881c5a002b6b25a6e6a04422a3c712739191d0db6bb30d18",
    FOOTPRINTS: "0717d62108ae5459dcb7646d92f15e4b4c5640f79e5ecfd1fe8e1e3558e220d9",
}
# x_min, y_min, x_max, y_max of the centroids of the houses, and margin of the cloud around the houses, metres in
# EPSG:28992
BOX_M, MARGIN_M = (84830.0, 447495.0, 84925.0, 447618.0), 5.0


def fetched(name: str, folder: Path, source: str = SOURCE) -> Path:
    """A file of the example data in ``folder``, fetched unless it is there. Ends with a message if its digest is
    wrong."""
    path = folder / Path(name).name
    if not path.exists():
        try:
            with urlopen(f"{source}/{name}", timeout=60) as response:
                content = response.read()
        except OSError as error:
            sys.exit(f"{source}/{name}: cannot be fetched: {error}; put the file into {folder}")
        folder.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != DIGESTS[name]:
        sys.exit(f"{path}: its SHA-256 is {digest}, not {DIGESTS[name]}: incomplete, or changed; remove it")
    return path


def downloaded(folder: Path, source: str = SOURCE) -> Path:
    """The folder with ``ahn3.laz`` and ``footprints.gpkg`` of the 74 houses, cut out of the example data."""
    cloud, footprints = laspy.read(fetched(CLOUD, folder, source)), fetched(FOOTPRINTS, folder, source)
    houses = gpd.read_file(footprints)
    centre, (x_min, y_min, x_max, y_max) = houses.centroid, BOX_M
    houses = houses[(centre.x > x_min) & (centre.x < x_max) & (centre.y > y_min) & (centre.y < y_max)]
    low_x, low_y, high_x, high_y = houses.total_bounds + MARGIN_M * np.array([-1, -1, 1, 1])
    cloud.points = cloud.points[
        (cloud.x >= low_x) & (cloud.x <= high_x) & (cloud.y >= low_y) & (cloud.y <= high_y)
    ]
    cloud.write(folder / "ahn3.laz")
    houses = houses[["gml_id", "geometry"]].rename(columns={"gml_id": "building_id"})
    houses.to_file(folder / "footprints.gpkg")
    return folder


def measures(judge: Path | None, city_json: Path, place: Path) -> dict[str, float]:
    """Mean measures of a CityJSON file, and the number of watertight buildings."""
    footprints, cloud = place / "footprints.gpkg", place / "ahn3.laz"
    if judge is None:
        rows = p2wss.evaluate(city_json, footprints, cloud)
        means = {name: round(rows[column].mean(), 3) for name, column in COLUMNS.items()}
        return means | {"watertight": int(rows["is_watertight"].fillna(False).sum())}
    summary = judged_file(judge, city_json, footprints, [cloud])["summary"]
    means = {name: round(summary[name]["mean"], 3) for name in BARS}
    return means | {"watertight": round(summary["watertight"] * summary["meshes"])}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--data", type=Path, help="folder with delft_ahn3")
    where.add_argument(
        "--download", type=Path, help="folder for the example data of 3dfier, kept for the next run"
    )
    parser.add_argument(
        "--judge", type=Path, help="evaluate_cityjson.py; by default `p2wss evaluate` measures"
    )
    arguments = parser.parse_args()
    place = arguments.data / "delft_ahn3" if arguments.data else downloaded(arguments.download)
    cloud, footprints = place / "ahn3.laz", place / "footprints.gpkg"
    figures = Figures()
    print(f"{'':<18} {'CD':>6} {'roof':>6} {'p2m':>6} {'tri':>6} watertight")
    with tempfile.TemporaryDirectory() as folder:
        files = {}
        if (place / "roofer_lod22.city.jsonl").exists():
            files["Roofer"] = place / "roofer_lod22.city.jsonl"
        elif shutil.which("roofer"):
            command = ["roofer", "--id-attribute", "building_id", "--lod22", cloud, footprints, folder]
            subprocess.run(command, check=True, capture_output=True)
            (files["Roofer"],) = Path(folder).glob("*.city.jsonl")
        for number, (name, options) in enumerate(VARIANTS.items()):
            out = Path(folder, str(number))
            command = ["p2wss", "reconstruct", cloud, footprints, out, *options]
            subprocess.run([*command, "--format", "cityjsonseq"], check=True, stderr=subprocess.PIPE)
            files[name] = out / "ahn3.city.jsonl"
        for name, file in files.items():
            values = measures(arguments.judge, file, place)
            figures.row(name, values)
            cells = " ".join(f"{values[key]:6.3f}" for key in ("cd", "roof", "p2m"))
            print(f"{name:<18} {cells} {values['tri']:6.1f} {values['watertight']:.0f}")
            if name == "default":
                for key, bar in BARS.items():
                    figures.at_most(f"default, {key}", values[key], bar)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
