"""Reconstruction of real LiDAR against its bars: accuracy, triangles, closedness, CPU time; the last line is JSON.

    python benchmarks/real.py --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py
    .. --model model.safetensors                         # beside it with the network
    .. --simulated results/mini/crops/manifest.json      # beside it the labelled test split
    .. --sensitivity --simulated results/mini/crops/manifest.json    # only what the thresholds change

``--data`` holds ``delft_ahn3`` and ``bresse_ign``. The judge is a script of its own that shares no code with
this package. Halves A and B: every second building of Delft by id.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import labelled
import numpy as np
import pyproj
import thresholds
from figures import Figures

from p2wss import reconstruct, scenes
from p2wss.config import Config, Reconstruct
from p2wss.data import clouds, polygon_arrays
from p2wss.data.building import Building, Reconstruction
from p2wss.data.points import crop_cloud
from p2wss.fit import fitting
from p2wss.reconstruct.flat import with_fallback
from p2wss.reconstruct.network import reconstruct_with_network

SETS = {"delft": ("delft_ahn3", "ahn3.laz", 28992), "bresse": ("bresse_ign", "lidar.laz", 2154)}
NAMES = {"cd": "CD", "roof": "roof CD", "p2m": "points to mesh", "tri": "triangles"}
TIMES = {"cpu_ms": "CPU ms each", "fit_cpu_ms": "of these the fit and the mesh"}
BARS = {
    "one height": {"cd": 0.97, "roof": 0.68, "p2m": 0.30, "tri": 28, "cpu_ms": 5},
    "parts": {"cd": 0.90, "roof": 0.30, "p2m": 0.15, "tri": 44, "cpu_ms": 18},
    "parts and dormers": {"cd": 0.88, "roof": 0.25, "p2m": 0.12, "tri": 50},
    "parts, 10 % of the points": {"roof": 0.6},
}
FEW = (10, 20, 40, 80, 200)


def read(folder: Path, name: str, config: Config) -> list[Building]:
    """The buildings of a data set, clean footprints with their points."""
    place, cloud_file, _ = SETS[name]
    frame = scenes.read_footprints(folder / place / "footprints.gpkg", None, needs_crs=False)
    frame = scenes.clean_footprints(frame, config.scenes)
    cloud = clouds.read_clouds([folder / place / cloud_file], reconstruct.window(frame))
    polygons = polygon_arrays.to_polygons(frame.geometry.to_numpy())
    cropped = crop_cloud(cloud, polygons, config.reconstruct.buffer_m)
    origin = polygon_arrays.origins(polygons)
    xyz = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])
    buildings = []
    for i, name_of in enumerate(frame["building_id"]):
        own = cropped.of(i)
        if len(own) >= 50:  # as the judge does
            buildings.append(
                Building(
                    str(name_of),
                    name,
                    (float(origin[i, 0]), float(origin[i, 1])),
                    [ring - origin[i] for ring in polygons.rings(i)],
                    xyz[own] - np.array([*origin[i], 0.0]),
                    cloud.classification[own],
                    float(cropped.ground_z_m[i]),
                )
            )
    return buildings


def thinned(building: Building, count: int) -> Building:
    """The building with ``count`` of its points at most, drawn by its id."""
    if len(building.point_m) <= count:
        return building
    seed = list(building.building_id.encode())
    kept = np.sort(np.random.default_rng(seed).choice(len(building.point_m), count, replace=False))
    return replace(building, point_m=building.point_m[kept], classification=building.classification[kept])


def fitted(
    buildings: list[Building], config: Reconstruct, predictor: Any
) -> tuple[list[Reconstruction], dict[str, float]]:
    """Reconstructions, and CPU milliseconds each: of all, and of what follows the network."""
    start = time.process_time()
    known = reconstruct_with_network(buildings, predictor, config) if predictor is not None else None
    begin_fit = time.process_time()
    made = with_fallback(fitting.fit(buildings, config, known), buildings, config)
    end, each = time.process_time(), 1e3 / max(len(buildings), 1)
    return made, {"cpu_ms": each * (end - start), "fit_cpu_ms": each * (end - begin_fit)}


def judged(made: list[Reconstruction], name: str, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    place, cloud_file, epsg = SETS[name]
    results = [reconstruct.Result(one, "ok", None, 0, np.nan, np.nan, False) for one in made]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made.city.jsonl"
        path.write_text(reconstruct.city_json(results, pyproj.CRS.from_epsg(epsg)))
        data = arguments.data / place
        command = [
            sys.executable,
            arguments.judge,
            path,
            data / "footprints.gpkg",
            data / cloud_file,
            "--json",
        ]
        done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)["rows"]


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    meshes = [row for row in rows if row["mesh"]]
    means = {key: float(np.mean([row[key] for row in meshes if key in row])) for key in NAMES}
    closed = float(np.mean([row["watertight"] for row in meshes]))
    return {"buildings": len(rows), "meshes": len(meshes), "watertight": closed, **means}


def report(
    title: str, rows: list[dict[str, Any]], bars: dict[str, float], cpu_ms: dict[str, float]
) -> dict[str, float]:
    found = {**summary(rows), **cpu_ms}
    parts = [f"{found['meshes']} of {found['buildings']} meshes", f"{found['watertight']:.1%} closed"]
    for key, label in {**NAMES, **TIMES}.items():
        if key in found:
            parts.append(f"{label} {found[key]:.3f}{_bar(found[key], bars.get(key))}")
    print(f"{title}: " + ", ".join(parts), flush=True)
    return found


def _bar(value: float, bar: float | None) -> str:
    return "" if bar is None else f" (bar {bar:g}{'' if value <= bar else ' MISSED'})"


def real(arguments: argparse.Namespace, predictor: Any) -> dict[str, Any]:
    """Every set in every variant, without the network and, if there is one, with it."""
    config = Config().reconstruct
    figures: dict[str, Any] = {}
    for name in SETS:
        buildings = read(arguments.data, name, Config())
        ids = sorted(building.building_id for building in buildings)
        variants = {
            "one height": (buildings, 1),
            "parts": (buildings, config.max_parts),
            "parts and dormers": (buildings, config.max_parts),
        }
        if name == "delft":
            tenth = [thinned(b, max(1, round(len(b.point_m) * 0.1))) for b in buildings]
            variants["parts, 10 % of the points"] = (tenth, config.max_parts)
            for count in FEW:
                variants[f"parts, {count} points"] = (
                    [thinned(b, count) for b in buildings],
                    config.max_parts,
                )
        for network in [None] if predictor is None else [None, predictor]:
            fitted(buildings, config, network)  # loads what is compiled, also what few buildings need
            for variant, (chosen, max_parts) in variants.items():
                dormers = variant == "parts and dormers"
                own = config.model_copy(update={"max_parts": max_parts, "dormers": dormers})
                made, cpu_ms = fitted(chosen, own, network)
                rows = judged(made, name, arguments)
                bars = BARS.get(variant, {}) if name == "delft" else {}
                title = f"{name}, {variant}" + (", with the network" if network else "")
                figures[title] = report(title, rows, bars, cpu_ms)
                if variant in BARS and name == "delft":
                    for half, members in (("A", set(ids[::2])), ("B", set(ids[1::2]))):
                        of_half = f"{title}, half {half}"
                        own_rows = [row for row in rows if row["id"] in members]
                        figures[of_half] = report(of_half, own_rows, bars, {})
    return figures


def against_bars(rows: dict[str, dict[str, Any]]) -> Figures:
    """Every row by its title, and each figure that has a bar by the title of its row and its name."""
    figures = Figures()
    for title, row in rows.items():
        figures.row(title, row)
        variant = title.removeprefix("delft, ").partition(", with")[0].partition(", half")[0]
        bars = labelled.BARS if title.startswith("simulated") else {}
        if title.startswith("delft"):
            figures.at_least(f"{title}, closed", row["watertight"], 1.0)
            figures.at_least(f"{title}, meshes", row["meshes"], row["buildings"])
            bars = BARS.get(variant, {})
        for key, limit in bars.items():
            # the network alone is measured beside the fit, and has bars of its own in the training
            if key in row and title != "simulated, network":
                figures.at_most(f"{title}, {NAMES.get(key, key)}", row[key], limit)
    return figures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--judge", type=Path, required=True)
    parser.add_argument("--model", type=Path, default=None, help="beside it, from this network's results")
    parser.add_argument("--simulated", type=Path, default=None, help="manifest of crops with labels")
    parser.add_argument("--sensitivity", action="store_true", help="only what other thresholds change")
    arguments = parser.parse_args()
    predictor = None
    if arguments.model is not None:
        from p2wss.nets.predictor import load_predictor

        predictor = load_predictor(arguments.model).with_num_views(1)  # as p2wss reconstruct does
    figures: dict[str, Any] = {}
    if arguments.sensitivity:
        figures = thresholds.table(arguments.simulated, read(arguments.data, "delft", Config()))
        print(json.dumps(figures))
        return 0
    if arguments.simulated is not None:
        figures |= labelled.figures(arguments.simulated, predictor)
    figures |= real(arguments, predictor)
    return against_bars(figures).end()


if __name__ == "__main__":
    sys.exit(main())
