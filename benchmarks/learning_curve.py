"""How the errors of the network fall during its training: checkpoints of a run; and the weights that it ended with.

    python benchmarks/learning_curve.py results/shipped/crops/manifest.json --model models/point2wss.safetensors \
        --checkpoints CHECKPOINTS/step-*.pt --every 6

Needs torch, labelled crops of a run of the pipeline, and checkpoints of a training.

The weights of each checkpoint predict held-out buildings: with the footprint given, and with all digits masked
as in Table 1 of the paper. The last line is JSON. A training keeps only its last two checkpoints: copy earlier ones
while it runs.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import labelled
import torch
from table1 import errors_of

from p2wss.eval.cases import Case
from p2wss.nets.point2wss import Point2Wss
from p2wss.nets.predictor import Point2WssPredictor
from p2wss.nets.weights import load_model


def figures(rows: list[Case], module: Point2Wss) -> dict[str, float]:
    """Mean absolute errors of both settings."""
    predictor = Point2WssPredictor(module)
    buildings = [case.building for case in rows]
    given = predictor.predict([each.point_m for each in buildings], [each.rings for each in buildings])
    footprints_m = [each.rings[0] for each in buildings]
    masked = predictor.reconstruct_all_masked([each.point_m for each in buildings], footprints_m)
    found = {"given": (given.eave_height_m, footprints_m, given.angle_deg), "masked": masked}
    means = {
        f"{title}, {key}": float(error.mean())
        for title, values in found.items()
        for key, error in errors_of(rows, *values).items()
    }
    return {
        key: round(value, 4)
        for key, value in means.items()
        if not key.startswith(("given, coord", "given, vertex"))
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("manifest", type=Path, help="manifest of crops with labels")
    parser.add_argument("--model", type=Path, required=True, help="weights of the network")
    parser.add_argument("--checkpoints", type=Path, nargs="*", default=[], help="of its training")
    parser.add_argument("--every", type=int, default=1, help="only every k-th building")
    arguments = parser.parse_args()
    module = load_model(arguments.model)
    rows = [
        case
        for case in labelled.read(arguments.manifest)[:: arguments.every]
        if len(case.building.rings) == 1 and len(case.building.rings[0]) <= module.config.max_vertices
    ]
    result = {}
    for path in [arguments.model, *sorted(arguments.checkpoints)]:
        if path != arguments.model:
            weights = torch.load(path, map_location="cpu", weights_only=True)["module"]
            module.load_state_dict({name: weights[name] for name in module.state_dict()})
        result[path.stem] = figures(rows, module)
        text = ", ".join(f"{key} {value:.3f}" for key, value in result[path.stem].items())
        print(f"{path.stem}: {text}", flush=True)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
