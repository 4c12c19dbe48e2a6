"""Whether the edges of reconstructed roofs are the true ones, on drawn houses of several bodies; the last line is JSON.

    python benchmarks/structure.py [--seed 1 --seed 2]
    python benchmarks/structure.py --kind large # of large buildings
    python benchmarks/structure.py --kind complexes # of several grown together, 50 to 300 planes
    python benchmarks/structure.py --few        # of houses with 80, 40, 20 and 10 points on each

Needs no data.

Draws the towns of the seeds (``benchmarks/towns.py``), reconstructs them by ``p2wss.reconstruct`` without
the network, and compares the edges with the true ones, by shape of the house and by kind of edge. The definitions are
in ``p2wss.eval.metrics``: false and missing edges are farther than 0.5 m from any edge of the other roof; an
exact roof has less than 2 % of either. No setting was chosen on the default seeds.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import few_points
import numpy as np
import real
from drawn_towns.files import ROOFS, write_town
from drawn_towns.lidar import LIDAR
from figures import Figures
from roof_edges import EDGE_KINDS, Structure, structure

import p2wss
from p2wss.config import Config
from p2wss.mesh import Mesh
from p2wss.reconstruction.product import reconstruct_buildings
from p2wss.reconstruction.scene import Scene
from p2wss.towns import FOOTPRINTS

SEEDS = (101, 102)
# bars by kind of town: shares of false edges, of missing edges, and of exact roofs (0: complexes have none)
BARS = {"wings": (0.03, 0.06, 0.6), "large": (0.03, 0.06, 0.4), "complexes": (0.06, 0.15, 0.0)}
# points on each house
FEW = (80, 40, 20, 10)


def drawn(seed: int, folder: Path, kind: str = "wings") -> Scene:
    """Draw a town into a folder, and read its true roofs."""
    write_town(folder, seed, kind)
    return p2wss.read(folder / ROOFS)


def of_few_points(seed: int, folder: Path) -> dict[int, list[dict[str, Any]]]:
    """For each number of points on a house, a row per building of a town: its structure and triangles."""
    truth, config = drawn(seed, folder), Config()
    buildings = real.read_files(folder / FOOTPRINTS, [folder / LIDAR], "town", config)
    rows: dict[int, list[dict[str, Any]]] = {}
    for num_points in FEW:
        few = few_points.with_roofs_around([few_points.thinned(each, num_points, 0) for each in buildings])
        for building, found in zip(few, reconstruct_buildings(few, None, config.reconstruct), strict=True):
            true = truth[building.building_id].solid
            assert true is not None and found.mesh is not None
            each = structure(found.mesh, true.translated(-building.position_m))
            row = {"structure": each, "triangles": len(found.mesh.triangle), "roof_cd_m": np.inf}
            rows.setdefault(num_points, []).append(row)
    return rows


def measured(seed: int, folder: Path, kind: str) -> list[dict[str, Any]]:
    """A row per building of a town: its shape, its structure (None without a mesh), roof CD, triangles."""
    truth = drawn(seed, folder, kind)
    scene = p2wss.reconstruct(folder / LIDAR, folder / FOOTPRINTS, model="none", progress=False)
    table = p2wss.evaluate(scene, folder / FOOTPRINTS, folder / LIDAR)
    rows = []
    for building_id, true in truth.items():
        assert true.solid is not None
        found = scene[building_id].solid
        rows.append(
            {
                "shape": true.attributes["shape"],
                "structure": structure(Mesh.empty() if found is None else found, true.solid),
                "roof_cd_m": table.loc[building_id, "roof_cd_m"],
                "triangles": table.loc[building_id, "num_triangles"],
            }
        )
    return rows


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """The figures over all of these buildings."""
    each: list[Structure] = [row["structure"] for row in rows]
    edges_m, true_m = sum(s.edges_m for s in each), sum(s.true_m for s in each)
    found, built, corners = np.sum([s.corners for s in each], axis=0)
    return {
        "buildings": len(rows),
        "edges, m": edges_m,
        "false edges": sum(s.false_m for s in each) / edges_m,
        "missing edges": sum(s.missing_m for s in each) / true_m,
        "exact roofs": sum(s.is_exact for s in each) / len(rows),
        "corners, precision": found / built,
        "corners, recall": found / corners,
        "corners, F1": 2 * found / (built + corners),
        "roof CD, m": float(np.nanmean([row["roof_cd_m"] for row in rows])),
        "triangles": float(np.nanmean([row["triangles"] for row in rows])),
    }


def with_few_points(seeds: Sequence[int]) -> int:
    """Print false and missing edges, exact roofs and triangles of houses with few points."""
    figures, towns = Figures(), []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            towns.append(of_few_points(seed, Path(folder)))
    for num_points in FEW:
        values = summary([row for town in towns for row in town[num_points]])
        values = {name: values[name] for name in ("false edges", "missing edges", "exact roofs", "triangles")}
        print(
            f"{num_points:<4} points: " + ", ".join(f"{name} {value:.3f}" for name, value in values.items())
        )
        figures.row(f"{num_points} points", values)
    return figures.end()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, action="append", help="of a town; default: 101 and 102")
    parser.add_argument("--kind", choices=sorted(BARS), default="wings")
    parser.add_argument("--few", action="store_true", help="houses with few points")
    arguments = parser.parse_args()
    if arguments.few:
        return with_few_points(arguments.seed or SEEDS)
    rows = []
    for seed in arguments.seed or SEEDS:
        with tempfile.TemporaryDirectory() as folder:
            rows += measured(seed, Path(folder), arguments.kind)
    figures = Figures()
    shapes = dict.fromkeys(row["shape"] for row in rows)
    groups = {"all": rows} | {shape: [row for row in rows if row["shape"] == shape] for shape in shapes}
    for name, members in groups.items():
        values = summary(members)
        if name == "all":
            print("".ljust(10) + ", ".join(values))
        print(name.ljust(10) + "".join(f"{value:9.3f}" for value in values.values()))
        figures.row(name, values)
    print("\nfalse edges by what they are, m".ljust(32) + "".join(f"{name:>9}" for name in groups))
    for kind in EDGE_KINDS:
        false_m = {
            name: sum(row["structure"].false_by_kind_m[kind] for row in members)
            for name, members in groups.items()
        }
        print(kind.ljust(31) + "".join(f"{value:9.1f}" for value in false_m.values()))
        figures.row(f"false edges, m: {kind}", false_m)
    whole = summary(rows)
    false, missing, exact = BARS[arguments.kind]
    figures.at_most("false edges", whole["false edges"], false)
    figures.at_most("missing edges", whole["missing edges"], missing)
    if exact:
        figures.at_least("exact roofs", whole["exact roofs"], exact)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
