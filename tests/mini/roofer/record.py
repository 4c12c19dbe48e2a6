"""Record what Roofer makes of the evaluation's clouds: CityJSON per tile, and the hashes of their points and buildings.

    snakemake -c2 crops && python tests/mini/roofer/record.py [--command roofer] [--manifest ..] [--out ..]

The defaults record the miniature anew in this folder. Roofer must be installed, or ``--command`` must start it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from pathlib import Path

from p2wss.config import load, roofer_command
from p2wss.data.manifest import read_manifest
from p2wss.eval import roofer
from p2wss.eval.cases import test_cases
from p2wss.storage.schemas.crops import REAL

HERE = Path(__file__).parent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--command", default="roofer")
    parser.add_argument("--manifest", type=Path, default=Path("results/mini/crops/manifest.json"))
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    config = load({"eval": {"roofer_command": arguments.command}}).eval
    listed = read_manifest(arguments.manifest)
    crs, sketches = listed.crs, defaultdict(dict)
    for cases in test_cases(listed):
        dataset, tile = cases[0].dataset, cases[0].building.tile
        folder = arguments.out if dataset == REAL else arguments.out / dataset
        folder.mkdir(parents=True, exist_ok=True)
        with roofer.outputs(cases, crs[dataset], config) as (paths, failure):
            if not paths:
                sys.exit(f"{tile}: {failure}")
            for number, path in enumerate(paths):
                (folder / f"{tile}.{number}.city.jsonl").write_bytes(path.read_bytes())
        sketches[dataset][tile] = roofer.made_from(cases)
    text = json.dumps(sketches, sort_keys=True).replace("], ", "],\n").replace("}, ", "},\n")
    (arguments.out / roofer_command.CLOUDS).write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
