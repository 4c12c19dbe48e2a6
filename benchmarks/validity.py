"""Whether written solids are valid: 20,000 solids on real outlines, tested by independent code.

    python benchmarks/validity.py [--num 20000] [--footprints FILE]

Needs footprints, which are not part of the project.

Outlines: BD TOPO of Olemps (default: ../shared/data/olemps_bdtopo), or any vector file with polygons. Roofs: as scenes
draw them, as the paper draws them, and angles from 0 to 90 degrees; the same with courtyards cut out; planes over the
cells between random lines; and hard cases with planes that are nearly equal and lines that end millimetres beside
corners. Each solid goes through the steps of the product (exact faces, tests, simpler roof) and is written to
CityJSON. The text is tested by `tests/unit/solid_rules.py` (GEOS, scipy, integers), which shares no code with the
product, and by val3dity where it is installed. Then solids are damaged, and p2wss and val3dity must find the same
solids invalid. The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "unit"))
import random_solids  # noqa: E402
from figures import Figures, run  # noqa: E402
from random_solids import REGIMES, Rings  # noqa: E402

import p2wss  # noqa: E402
from p2wss.config import Scenes  # noqa: E402
from p2wss.data import polygon_arrays  # noqa: E402
from p2wss.data.building import Reconstruction  # noqa: E402
from p2wss.footprints.cleaning import clean_footprints, read_footprints  # noqa: E402
from p2wss.mesh.repair import surfaces_to_write  # noqa: E402

COLUMNS = ("solids", "broken before", "simpler", "no mesh", "invalid", "without solid")
# kinds of damage to solids, with the range of the distance in metres
MOVED_M = {
    "moved": (-0.02, 0.02),
    "moved far": (-8.0, 8.0),
    **dict.fromkeys(("left out", "turned", "twice", "crossed", "hole"), (0.0, 0.0)),
    "spike": (-2.0, 2.0),
}
DAMAGES = tuple(MOVED_M)
OLEMPS = ROOT.parent / "shared" / "data" / "olemps_bdtopo" / "BATIMENT.shp"


def outlines(path: Path) -> list[Rings]:
    """Cleaned outlines around the origin, as the product meshes them."""
    features = clean_footprints(read_footprints(path), Scenes())
    features = features.take(features["status"] == "ok")
    polygons = polygon_arrays.to_polygons(features.geometry)
    origins = polygon_arrays.origins(polygons)
    return [[ring - origin for ring in polygons.rings(i)] for i, origin in enumerate(origins)]


def solids(rings: list[Rings], num: int) -> Iterator[tuple[str, Reconstruction | None]]:
    """(kind, building or None if it has no solid). The kinds take turns, so that any number of solids has all kinds."""
    kinds = [*REGIMES, "courtyards", "planes", *REGIMES, "hard", *REGIMES]
    draw, count = 0, 0
    while count < num:
        for i, kind in enumerate(kinds):
            # each turn begins elsewhere, so that all outlines have all kinds in the end
            for k in range(draw * 50, draw * 50 + 50):
                name = f"{kind} {i} {k}"
                outline = rings[(k + 211 * i) % len(rings)]
                yield kind, _solid(kind, name, outline, k)
                count += 1
        draw += 1


def _solid(kind: str, name: str, outline: Rings, seed: int) -> Reconstruction | None:
    rng = np.random.default_rng([seed, *name.encode()])
    if kind in ("planes", "hard"):
        return random_solids.with_planes(name, outline, seed, int(rng.integers(1, 8)), kind == "hard")
    regime = kind
    if kind == "courtyards":
        outline = random_solids.courtyard(outline, rng) or outline
        regime = str(rng.choice(REGIMES))
    angle_deg = random_solids.angles(outline, regime, name, seed)
    return random_solids.reconstruction(name, outline, float(rng.uniform(2.5, 9)), angle_deg)


def damaged(text: str, num: int) -> str:
    """CityJSON text sequences of ``num`` random solids of ``text``, each with one fault, which may be too small to
    count."""
    head, *features = text.splitlines()
    rng = np.random.default_rng(0)
    lines = [head]
    for number, row in enumerate(rng.integers(len(features), size=num).tolist()):
        feature = json.loads(features[row])
        (thing,) = feature["CityObjects"].values()
        (geometry,), vertices = thing["geometry"], feature["vertices"]
        geometry.pop("semantics")
        shell = geometry["boundaries"][0]
        face = int(rng.integers(len(shell)))
        ring, kind = shell[face][0], DAMAGES[number % len(DAMAGES)]
        at = int(rng.integers(len(ring)))
        steps = round(rng.uniform(*MOVED_M[kind]) / json.loads(head)["transform"]["scale"][0])
        if kind in ("moved", "moved far"):
            vertices[ring[at]][int(rng.integers(3))] += steps
        elif kind == "left out":
            shell.pop(face)
        elif kind == "turned":
            shell[face] = [each[::-1] for each in shell[face]]
        elif kind == "twice":
            shell.append(shell[face])
        elif kind == "crossed":
            ring[at], ring[at - 1] = ring[at - 1], ring[at]
        elif kind == "spike":
            vertices.append([value + steps for value in vertices[ring[at]]])
            ring[at : at + 1] = [ring[at], len(vertices) - 1, ring[at]]
        else:  # a hole
            corner = np.array([vertices[each] for each in ring])
            hole = np.rint(corner.mean(axis=0) + 0.3 * (corner - corner.mean(axis=0))).astype(int)
            shell[face].append(list(range(len(vertices), len(vertices) + len(hole)))[::-1])
            vertices += hole.tolist()
        feature["id"] = name = f"{kind} {number}"
        feature["CityObjects"] = {name: thing}
        lines.append(json.dumps(feature))
    return "\n".join(lines)


def num_judged_otherwise(text: str) -> int:
    """Number of solids in CityJSON text sequences about whose validity p2wss and val3dity disagree."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "damaged.city.jsonl")
        path.write_text(text, encoding="utf-8")
        ours = {name.partition(" (")[0] for name in p2wss.check(path).invalid}
    return len(ours ^ set(invalid_by_val3dity(text)))


def invalid_by_val3dity(text: str) -> list[str]:
    """The ids of the buildings in CityJSON text sequences that val3dity calls invalid."""
    with tempfile.TemporaryDirectory() as folder:
        path, report = Path(folder, "buildings.city.jsonl"), Path(folder, "report.json")
        path.write_text(text, encoding="utf-8")
        run(["val3dity", path, "--report", report])
        content = json.loads(report.read_text(encoding="utf-8"))
    if content["dataset_errors"]:
        raise RuntimeError(f"val3dity: {content['dataset_errors']}")
    return [each["id"] for each in content["features"] if not each["validity"]]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--num", type=int, default=20_000)
    parser.add_argument("--footprints", type=Path, default=OLEMPS)
    arguments = parser.parse_args()
    rings = outlines(arguments.footprints)
    print(f"{len(rings)} outlines of {arguments.footprints.name}", flush=True)
    counts: dict[str, Counter[str]] = {}
    rules: Counter[int] = Counter()
    invalid, seconds, built = [], 0.0, list[Reconstruction]()
    for number, (kind, building) in enumerate(solids(rings, arguments.num), 1):
        count = counts.setdefault(kind, Counter(dict.fromkeys(COLUMNS, 0)))
        if building is None:
            count["without solid"] += 1
            continue
        start = time.process_time()
        found = surfaces_to_write(building.placed_mesh)[1]
        seconds += time.process_time() - start
        rules.update({breach.code for breach in found})
        ((before, after, codes),) = random_solids.validated([building])
        count["solids"] += 1
        count["broken before"] += bool(found)
        built += [after] if after.has_mesh else []
        if not after.has_mesh:
            count["no mesh"] += 1
        elif after.angle_deg is not before.angle_deg:
            count["simpler"] += 1
        if codes:
            count["invalid"] += 1
            invalid.append(f"{building.building_id}: {codes}")
            print("invalid:", invalid[-1], flush=True)
        if number % 1000 == 0:
            print(number, {name: dict(values) for name, values in counts.items()}, flush=True)
    print("rules broken before:", dict(sorted(rules.items())))
    print(f"{'':12}" + "".join(f"{name:>15}" for name in COLUMNS))
    total = sum(counts.values(), Counter())
    counts["all"] = Counter({name: total[name] for name in COLUMNS})
    for kind, count in counts.items():
        print(f"{kind:12}" + "".join(f"{count[name]:>15}" for name in COLUMNS))
    figures = Figures()
    figures.at_most("invalid", len(invalid), 0)
    if shutil.which("val3dity"):
        text = random_solids.written(built)
        figures.at_most("invalid by val3dity", len(invalid_by_val3dity(text)), 0)
        figures.at_most("damaged, judged otherwise by val3dity", num_judged_otherwise(damaged(text, 5000)), 0)
    figures.at_least("solids", total["solids"], 0.95 * arguments.num)
    figures.at_most("ms_per_building", 1e3 * seconds / total["solids"], 2.0)
    for kind, count in counts.items():
        figures.row(kind, count)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
