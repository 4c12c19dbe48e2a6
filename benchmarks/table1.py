"""Table 1 of the paper in its own protocol, all digits masked, by the network alone.

    python benchmarks/table1.py results/shipped/crops/manifest.json --model models/point2wss.safetensors
    .. --scans results/shipped/scans --buildings results/shipped/buildings --buffer 4   # the same scan cropped again

Needs torch, and labelled crops of a run of the pipeline.

The crops hold the points up to ``crops.buffer_m`` (1 m) around the true footprint. So the border of a crop gives the
footprint away to a network that was trained on such crops. ``--buffer`` crops the scans of the buildings in the
manifest again, with another distance. The last line is JSON: each figure with its bar, the figure of the paper.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import labelled
import numpy as np
from figures import Figures

from p2wss.clouds.scan_files import read_scan
from p2wss.config import Config
from p2wss.crops.rows import crop_simulated
from p2wss.eval import cases
from p2wss.eval.cases import Case
from p2wss.eval.measure import target_height_m
from p2wss.nets.predictor import load_predictor
from p2wss.storage import files
from p2wss.storage.schemas.buildings import BUILDINGS
from p2wss.storage.schemas.crops import CROPS, SIMULATED

# the figures of the paper, on its own data
BARS = {"height_m": 0.23, "angle_deg": 2.34, "coordinate_m": 0.41}


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


def errors_of(
    rows: list[Case], eave_height_m: np.ndarray, xy_m: list[np.ndarray], angle_deg: list[np.ndarray]
) -> dict[str, np.ndarray]:
    """Absolute errors of the parameters, over all values."""
    offset_m = np.concatenate(xy_m) - np.concatenate([case.building.rings[0] for case in rows])
    truth_deg = np.concatenate([case.angle_deg for case in rows if case.angle_deg is not None])
    return {
        "height_m": np.abs(eave_height_m - [target_height_m(case) for case in rows]),
        "angle_deg": np.abs(np.concatenate(angle_deg) - truth_deg),
        "coordinate_m": np.abs(offset_m).ravel(),
        "vertex_m": np.linalg.norm(offset_m, axis=1),
    }


def errors_in(rows: list[Case], predictor: Any, title: str) -> dict[str, float]:
    """Mean errors over the buildings that the network supports; prints them, also by number of vertices."""
    rows = [
        case
        for case in rows
        if len(case.building.rings) == 1 and len(case.building.rings[0]) <= predictor.max_num_vertices
    ]
    start = time.process_time()
    height_m, xy_m, angle_deg = predictor.reconstruct_all_masked(
        [case.building.point_m for case in rows], [case.building.rings[0] for case in rows]
    )
    cpu_ms = 1000 * (time.process_time() - start) / len(rows)
    errors = errors_of(rows, height_m, xy_m, angle_deg)
    text = ", ".join(f"{key} {error.mean():.3f} ± {error.std():.2f}" for key, error in errors.items())
    print(f"{title}: {len(rows)} buildings, {text}, {cpu_ms:.0f} ms CPU")
    for count in sorted(set(map(len, xy_m))):
        index = [i for i, each in enumerate(xy_m) if len(each) == count]
        part = errors_of(
            [rows[i] for i in index], height_m[index], [xy_m[i] for i in index], [angle_deg[i] for i in index]
        )
        text = ", ".join(f"{key} {part[key].mean():.3f}" for key in BARS)
        print(f"    {len(index)} with {count} vertices: {text}", flush=True)
    return {key: float(error.mean()) for key, error in errors.items()}


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
    result = Figures()
    errors = errors_in(rows, predictor, "as cropped")
    result.row("as cropped", errors)
    for key, bar in BARS.items():
        result.at_most(key, errors[key], bar)
    for buffer_m in arguments.buffer:
        again = cropped_again(rows, arguments.scans, arguments.buildings, buffer_m)
        result.row(f"crop of {buffer_m:g} m", errors_in(again, predictor, f"crop of {buffer_m:g} m"))
    return result.end()


if __name__ == "__main__":
    sys.exit(main())
