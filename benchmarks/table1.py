"""Table 1 of the paper in its own protocol, all digits masked: the network alone, and in two passes with the fit.

    python benchmarks/table1.py results/shipped/crops/manifest.json --model models/point2wss.safetensors
    .. --scans results/shipped/scans --buildings results/shipped/buildings --buffer 4   # the same scan cropped again

The crops hold the points up to ``crops.buffer_m`` (1 m) around the true footprint, so that their own border gives the
footprint away, to a network that was trained on such crops. ``--buffer`` crops the scans of the buildings in the
manifest again, with another distance. The last line is JSON: each figure with its bar, those of the paper.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import labelled
import numpy as np

from p2wss.clouds.scan_files import read_scan
from p2wss.config import Config
from p2wss.crops.simulated import crop_simulated
from p2wss.eval import cases
from p2wss.eval.cases import Case
from p2wss.eval.masked import MaskedParameters, fit_all_masked, read_all_masked
from p2wss.eval.methods import for_dataset
from p2wss.eval.parameters import target_height_m
from p2wss.nets.predictor import load_predictor
from p2wss.storage import files
from p2wss.storage.schemas.buildings import BUILDINGS
from p2wss.storage.schemas.crops import CROPS, SIMULATED

BARS = {"height_m": 0.17, "angle_deg": 2.34, "coordinate_m": 0.41}
GOALS = {"height_m": 0.05, "angle_deg": 1.0, "coordinate_m": 0.20}
NETWORK, TWO_PASSES = "network", "two passes"


def cropped_again(labelled_cases: list[Case], scans: Path, buildings: Path, buffer_m: float) -> list[Case]:
    """The same buildings with the points up to ``buffer_m`` around them."""
    wanted = {case.key for case in labelled_cases}
    settings = Config().crops.model_copy(update={"buffer_m": buffer_m, "split": "test"})
    result = []
    for tile in sorted({case.building.tile for case in labelled_cases}):
        table = files.read_table(buildings / f"{tile}.parquet", BUILDINGS)
        columns, _ = crop_simulated(table, read_scan(scans / f"{tile}.laz"), settings)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "crops.parquet")
            files.write_table(path, columns, CROPS, {})
            rows = cases.from_crops(files.read_table(path, CROPS), SIMULATED)
        result += [case for case in rows if case.key in wanted]
    return result


def errors_of(rows: list[Case], values: MaskedParameters) -> dict[str, np.ndarray]:
    """Absolute errors of the parameters, over all values."""
    offset_m = np.concatenate(values.xy_m) - np.concatenate([case.building.rings[0] for case in rows])
    truth_deg = np.concatenate([case.angle_deg for case in rows if case.angle_deg is not None])
    return {
        "height_m": np.abs(values.eave_height_m - [target_height_m(case) for case in rows]),
        "angle_deg": np.abs(np.concatenate(values.angle_deg) - truth_deg),
        "coordinate_m": np.abs(offset_m).ravel(),
        "vertex_m": np.linalg.norm(offset_m, axis=1),
    }


def figures(rows: list[Case], predictor: Any, title: str) -> dict[str, dict[str, float]]:
    """Errors of both settings; prints them."""
    rows = [
        case
        for case in rows
        if len(case.building.rings) == 1 and len(case.building.rings[0]) <= predictor.max_num_vertices
    ]
    buildings = [case.building for case in rows]
    start = time.process_time()
    reading = read_all_masked(buildings, predictor, signs_visible=True)
    network_s = time.process_time() - start
    fitted = fit_all_masked(buildings, reading, predictor, for_dataset(Config().reconstruct, SIMULATED))
    both_s = time.process_time() - start
    result = {}
    for name, values, seconds in ((NETWORK, reading, network_s), (TWO_PASSES, fitted, both_s)):
        errors = errors_of(rows, values)
        result[f"{title}, {name}"] = {key: float(error.mean()) for key, error in errors.items()}
        text = ", ".join(f"{key} {error.mean():.3f} ± {error.std():.2f}" for key, error in errors.items())
        print(f"{title}, {name}: {len(rows)} buildings, {text}, {1000 * seconds / len(rows):.0f} ms CPU")
    for count in sorted({len(case.building.rings[0]) for case in rows}):
        index = [i for i, case in enumerate(rows) if len(case.building.rings[0]) == count]
        part = MaskedParameters(
            fitted.eave_height_m[index], [fitted.xy_m[i] for i in index], [fitted.angle_deg[i] for i in index]
        )
        errors = errors_of([rows[i] for i in index], part)
        text = ", ".join(f"{key} {errors[key].mean():.3f}" for key in BARS)
        print(f"    {len(index)} with {count} vertices: {text}", flush=True)
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("manifest", type=Path, help="manifest of crops with labels")
    parser.add_argument("--model", type=Path, required=True, help="weights of the network")
    parser.add_argument("--every", type=int, default=1, help="only every k-th building")
    parser.add_argument("--scans", type=Path, help="folder of the scans, for --buffer")
    parser.add_argument("--buildings", type=Path, help="folder of the buildings, for --buffer")
    parser.add_argument("--buffer", type=float, nargs="*", default=[], help="also crops with these distances")
    arguments = parser.parse_args()
    predictor = load_predictor(arguments.model)
    rows = labelled.read(arguments.manifest)[:: arguments.every]
    found = figures(rows, predictor, "as cropped")
    for buffer_m in arguments.buffer:
        again = cropped_again(rows, arguments.scans, arguments.buildings, buffer_m)
        found |= figures(again, predictor, f"crop of {buffer_m:g} m")
    summary: dict[str, Any] = {}
    for title, errors in found.items():
        for key, value in errors.items():
            entry: dict[str, Any] = {"value": round(value, 3)}
            if title == f"as cropped, {TWO_PASSES}" and key in BARS:
                entry |= {"bar": BARS[key], "ok": bool(value <= BARS[key]), "goal": GOALS[key]}
            summary[f"{title}, {key}"] = entry
    print(json.dumps(summary))
    return int(not all(entry.get("ok", True) for entry in summary.values()))


if __name__ == "__main__":
    sys.exit(main())
