"""Reconstruction of real LiDAR against its bars: accuracy, triangles, closedness, CPU time; the last line is JSON.

    python benchmarks/real.py --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py
    .. --model model.safetensors                         # also with the network
    .. --simulated results/mini/crops/manifest.json      # also on the labelled test split

Needs the data and the judge, which are not part of the project.

``--data`` holds ``delft_ahn3``, ``bresse_ign`` and ``lidarhd_crops``. The judge is a separate script that shares no
code with this package. Halves A and B: every second building of Delft by id.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import labelled
import numpy as np
from figures import Figures
from real_places import Place, judged_rows

from p2wss.clouds import reading as clouds
from p2wss.clouds.crops import crop_cloud
from p2wss.config import Config, Reconstruct
from p2wss.data import polygon_arrays
from p2wss.data.building import Building, Reconstruction
from p2wss.fit import fitting
from p2wss.footprints import cleaning
from p2wss.reconstruction.area import footprint_settings, window
from p2wss.reconstruction.product import NETWORK, reconstruct_with_network, with_fallback
from p2wss.reconstruction.result import Result

_CROPS = ("77050_627755", "77050_627760", "77055_627755")
# folder, clouds, EPSG code
SETS = {
    "delft": ("delft_ahn3", ["ahn3.laz"], 28992),
    "bresse": ("bresse_ign", ["lidar.laz"], 2154),
    "blocks": ("lidarhd_crops", [f"{tile}_LA93_IGN69.laz" for tile in _CROPS], 2154),
}
NAMES = {"cd": "CD", "roof": "roof CD", "p2m": "points to mesh", "tri": "triangles"}
TIMES = {"cpu_ms": "CPU ms each"}
# bars by data set and variant; the variant "default" has no option
BARS: dict[str, dict[str, dict[str, float]]] = {
    "delft": {
        "parametric": {"cd": 0.97, "roof": 0.68, "p2m": 0.30, "tri": 28, "cpu_ms": 5},
        "default": {"cd": 0.88, "roof": 0.24, "p2m": 0.117, "tri": 45, "cpu_ms": 18},
        "10 % of the points": {"roof": 0.33, "p2m": 0.17},
    },
    "bresse": {"default": {"cd": 0.83, "roof": 0.14, "p2m": 0.065, "tri": 42}},
    "blocks": {"default": {"cd": 0.97, "roof": 0.49, "p2m": 0.19, "tri": 75, "cpu_ms": 150}},
}
FEW = (10, 20, 40, 80, 200)


def read(folder: Path, name: str, config: Config) -> list[Building]:
    """The buildings of a data set, clean footprints with their points."""
    place, cloud_files, _ = SETS[name]
    data = folder / place
    return read_files(data / "footprints.gpkg", [data / file for file in cloud_files], name, config)


def read_files(footprints: Path, cloud_files: Sequence[Path], name: str, config: Config) -> list[Building]:
    """The buildings of a footprint file, clean footprints with their points."""
    features = cleaning.read_footprints(footprints, None, needs_crs=False)
    features = cleaning.clean_footprints(features, footprint_settings(config))
    cloud = clouds.read_clouds(list(cloud_files), window(features))
    polygons = polygon_arrays.to_polygons(features.geometry)
    cropped = crop_cloud(cloud, polygons, config.reconstruct.buffer_m)
    origin = polygon_arrays.origins(polygons)
    xyz = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])
    buildings = []
    for i, building_id in enumerate(features["building_id"]):
        rows = cropped.of(i)
        if len(rows) >= 50:  # as the judge does
            buildings.append(
                Building(
                    str(building_id),
                    name,
                    (float(origin[i, 0]), float(origin[i, 1])),
                    [ring - origin[i] for ring in polygons.rings(i)],
                    xyz[rows] - [*origin[i], cropped.ground_z_m[i]],
                    cloud.classification[rows],
                    float(cropped.ground_z_m[i]),
                )
            )
    return buildings


def thinned(building: Building, count: int) -> Building:
    """The building with at most ``count`` of its points, drawn with its id as the seed."""
    if len(building.point_m) <= count:
        return building
    seed = list(building.building_id.encode())
    rows = np.sort(np.random.default_rng(seed).choice(len(building.point_m), count, replace=False))
    return replace(building, point_m=building.point_m[rows], classification=building.classification[rows])


def fitted(
    buildings: list[Building], config: Reconstruct, predictor: Any
) -> tuple[list[Reconstruction], dict[str, float]]:
    """Reconstructions by the fit, or by a network, and CPU milliseconds per building."""
    start = time.process_time()
    if predictor is None:
        found = fitting.fit(buildings, config)
    else:
        found = reconstruct_with_network(buildings, predictor, config)
    reconstructions = with_fallback(found, buildings, config)
    return reconstructions, {"cpu_ms": 1e3 * (time.process_time() - start) / max(len(buildings), 1)}


def judged(
    reconstructions: list[Reconstruction], name: str, arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """The judge's rows, one per building."""
    place, cloud_files, epsg = SETS[name]
    results = [Result(row, "ok", None, 0, np.nan, np.nan, False) for row in reconstructions]
    data = arguments.data / place
    files = Place(data / "footprints.gpkg", tuple(data / file for file in cloud_files), epsg)
    return judged_rows(arguments.judge, results, files)


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    meshes = [row for row in rows if row["mesh"]]
    means = {key: float(np.mean([row[key] for row in meshes if key in row])) for key in NAMES}
    closed = float(np.mean([row["watertight"] for row in meshes]))
    return {"buildings": len(rows), "meshes": len(meshes), "watertight": closed, **means}


def report(
    title: str, rows: list[dict[str, Any]], bars: dict[str, float], cpu_ms: dict[str, float]
) -> dict[str, float]:
    row = {**summary(rows), **cpu_ms}
    parts = [f"{row['meshes']} of {row['buildings']} meshes", f"{row['watertight']:.1%} closed"]
    for key, label in {**NAMES, **TIMES}.items():
        if key in row:
            parts.append(f"{label} {row[key]:.3f}{_bar(row[key], bars.get(key))}")
    print(f"{title}: " + ", ".join(parts), flush=True)
    return row


def _bar(value: float, bar: float | None) -> str:
    return "" if bar is None else f" (bar {bar:g}{'' if value <= bar else ' MISSED'})"


def real(arguments: argparse.Namespace, predictor: Any) -> dict[str, Any]:
    """Every data set in every variant, without the network and, with a predictor, with it."""
    config = Config().reconstruct
    figures: dict[str, Any] = {}
    for name in SETS:
        buildings = read(arguments.data, name, Config())
        ids = sorted(building.building_id for building in buildings)
        variants = {
            "parametric": (buildings, config.model_copy(update={"roofs": "parametric"})),
            "default": (buildings, config),
        }
        if name == "delft":
            tenth = [thinned(b, max(1, round(len(b.point_m) * 0.1))) for b in buildings]
            variants["10 % of the points"] = (tenth, config)
            for count in FEW:
                variants[f"{count} points"] = ([thinned(b, count) for b in buildings], config)
        for network in [None] if predictor is None else [None, predictor]:
            fitted(
                buildings, config, network
            )  # warm-up: compiles and loads also the code that few buildings need
            for variant, (thinned_buildings, settings) in variants.items():
                if arguments.variant and variant not in arguments.variant:
                    continue
                reconstructions, cpu_ms = fitted(thinned_buildings, settings, network)
                rows = judged(reconstructions, name, arguments)
                bars = BARS[name].get(variant, {})
                title = f"{name}, {variant}" + (", with the network" if network else "")
                figures[title] = report(title, rows, bars, cpu_ms)
                if variant in BARS[name] and name == "delft":
                    for half, members in (("A", set(ids[::2])), ("B", set(ids[1::2]))):
                        of_half = f"{title}, half {half}"
                        half_rows = [row for row in rows if row["id"] in members]
                        figures[of_half] = report(of_half, half_rows, bars, {})
    return figures


def against_bars(rows: dict[str, dict[str, Any]]) -> Figures:
    """Add every row by its title, and each figure with a bar by the title of its row and its own name."""
    figures = Figures()
    for title, row in rows.items():
        figures.row(title, row)
        name, _, variant = title.partition(", with")[0].partition(", half")[0].partition(", ")
        bars = labelled.BARS if name == "simulated" else BARS[name].get(variant, {})
        if name != "simulated":
            figures.at_least(f"{title}, closed", row["watertight"], 1.0)
            figures.at_least(f"{title}, meshes", row["meshes"], row["buildings"])
        for key, limit in bars.items():
            # bars of the network alone are bars of the training
            if key in row and title != f"simulated, {NETWORK}":
                figures.at_most(f"{title}, {NAMES.get(key, key)}", row[key], limit)
    return figures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--judge", type=Path, required=True)
    parser.add_argument(
        "--model",
        type=Path,
        default=None,
        help="weights of a network, besides the fit",
    )
    parser.add_argument("--simulated", type=Path, default=None, help="manifest of crops with labels")
    parser.add_argument(
        "--variant", action="append", help="only this one, for example default; may be repeated"
    )
    arguments = parser.parse_args()
    predictor = None
    if arguments.model is not None:
        from p2wss.nets.predictor import load_predictor

        predictor = load_predictor(arguments.model)
    figures: dict[str, Any] = {}
    if arguments.simulated is not None:
        figures |= labelled.figures(arguments.simulated, predictor)
    figures |= real(arguments, predictor)
    return against_bars(figures).end()


if __name__ == "__main__":
    sys.exit(main())
