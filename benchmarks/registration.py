"""Registration of footprints on real LiDAR against its bars; the last line is JSON.

    python benchmarks/registration.py --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py
    .. --model src/p2wss/weights/point2wss.safetensors     # the network in place of the fit
    python benchmarks/towns.py --kind streets --seed 7 --lidar --out town && .. --town town  # simulated LiDAR instead

Needs data and the judge, which are not part of the project.

* Delft: each block of clean footprints is moved by a seeded vector of 0, 0.5, 1 and 1.5 m, registered, reconstructed
  and judged against the footprints and points in place, in two halves (every second building by id). Then all blocks
  are moved by one vector of 1.5 m, with normal deviations of 15 cm. Thresholds were chosen on Delft with the seeds 0 to
  29, so the seeds from 30 are the test, of both halves.
* Deviations: 1,000 blocks moved at random by 0.5 to 1.5 m.
* Few points: blocks of six places, in place, and moved by 0.5 to 1.5 m, with all points, half of them, and a seventh;
  the rules were chosen with the seeds 100 to 103.
* Missed roofs: the same with all points, a share of the roof points being unclassified.
* Classes removed: the same with the classes that p2wss itself finds.
* Sheds: squares of 2 to 6 m, at random places of three clouds without a building, must stay.

``--data`` and the judge are those of ``real.py``.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely
from figures import Figures, cpu_seconds
from real_places import Place, judged_rows, places
from shapely import affinity

from p2wss.clouds import reading as clouds
from p2wss.clouds.reading import Cloud
from p2wss.config import Config
from p2wss.data import polygon_arrays
from p2wss.data.seeds import generator
from p2wss.footprints import cleaning as footprints
from p2wss.reconstruction.pipeline import run as run_reconstruct
from p2wss.reconstruction.points.unclassified import with_classes
from p2wss.reconstruction.registration.blocks import find_blocks
from p2wss.reconstruction.registration.register import NOTHING, OWN_CLASSES, Registration, register
from p2wss.skeleton.types import Polygons
from p2wss.storage.features import Features

SHIFTS_M = (0.5, 1.0, 1.5)
# how much worse than in place a measure may be: for moved footprints, for footprints in place
BARS = {"p2m": (0.02, 0.003), "roof": (0.03, 0.003), "cd": (None, 0.003)}
NAMES = {"cd": "CD", "roof": "roof CD", "p2m": "points to mesh"}
REMAINING_M, CPU_MS, SHEDS = 0.15, 3.0, 40
# deviation between the blocks of a map that is off everywhere; number of blocks whose deviation is tested; least share
# within two deviations
SPREAD_M, NUM_DRAWN, WITHIN = 0.15, 1000, 0.95
TOWN_NOISE_M = (0.0, 0.2)
# places and shares of their points; distance in metres from which a block counts as left where it was
SPARSE = ("delft_ahn3", "bresse_ign", "nyc_roofn3d", "trondheim", "dallas", "adelaide")
SHARES, LEFT_M = (1.0, 0.5, 0.15), 0.3
MISSED_SHARES = (0.0, 0.3, 0.6)
UNCLASSIFIED = ("toronto", "amsterdam_ahn")


def read(place: Place) -> tuple[gpd.GeoDataFrame, Cloud]:
    """Clean footprints and all points of a place."""
    frame = footprints.read_footprints(place.footprints, None, needs_crs=False)
    return footprints.clean_footprints(frame, Config().scenes), clouds.read_clouds(place.clouds)


def moved(
    features: Features, length_m: float, seed: int, noise_m: float = 0.0, spread_m: float | None = None
) -> tuple[Features, np.ndarray, np.ndarray]:
    """(features, vector of each footprint, block of each footprint). Each block is moved by a vector of length
    ``length_m``, and each vertex by noise, the same in all footprints that share the vertex. spread_m: if given, all
    blocks are moved in one direction, with this normal deviation."""
    shapes = features.geometry
    block = find_blocks(shapes).of_footprint
    angle = [
        generator(seed, "registration", length_m, b).uniform(0, 2 * np.pi) for b in range(block.max() + 1)
    ]
    if spread_m is not None:
        angle = angle[:1] * len(angle)
    by_block = length_m * np.column_stack([np.cos(angle), np.sin(angle)])
    by_block += generator(seed, "spread").normal(0, spread_m or 0.0, by_block.shape)
    vector = by_block[block]
    polygons = polygon_arrays.to_polygons(shapes)
    _, node = np.unique(np.round(polygons.xy_m, 3), axis=0, return_inverse=True)
    noise = generator(seed, "vertices").normal(0, noise_m, (node.max() + 1, 2))[node.ravel()]
    xy_m = polygons.xy_m + np.repeat(vector, np.diff(polygons.vertex_offset), axis=0) + noise
    result = polygon_arrays.to_geometries(Polygons(xy_m, polygons.ring_offset, polygons.polygon_offset))
    return replace(features, geometry=result), vector, block


def judged(
    features: Features, cloud: Cloud, place: Place, predictor: Any, judge: Path, **settings: Any
) -> dict[str, dict[str, Any]]:
    """The judge's rows by id. settings: of the section reconstruct, in place of the defaults."""
    config = Config().reconstruct.model_copy(update=settings)
    results = run_reconstruct(features, cloud, predictor, "tile", config)
    return {row["id"]: row for row in judged_rows(judge, results, place)}


def measures(rows: dict[str, dict[str, Any]]) -> dict[str, dict[str, float]]:
    """The mean of each measure, by half."""
    ids = sorted(rows)
    halves = {"half A": ids[::2], "half B": ids[1::2]}
    return {
        half: {key: float(np.mean([rows[i][key] for i in some if key in rows[i]])) for key in NAMES}
        for half, some in halves.items()
    }


def of_moved_blocks(
    figures: Figures,
    title: str,
    place: Place,
    predictor: Any,
    arguments: argparse.Namespace,
    noise_m: float = 0.0,
) -> None:
    """Add the table of a place. noise_m: standard deviation of the vertices, with and without a shift."""
    frame, cloud = read(place)
    start, _, _ = moved(frame, 0.0, arguments.seeds[0], noise_m)
    in_place = measures(judged(start, cloud, place, predictor, arguments.judge))
    figures.row(f"{title}, in place, not registered", in_place)
    print(f"{title}, in place, not registered:", json.dumps(in_place), flush=True)
    for length_m, spread_m in ((0.0, None), *((each, None) for each in SHIFTS_M), (SHIFTS_M[-1], SPREAD_M)):
        runs: list[dict[str, dict[str, float]]] = []
        remaining: list[float] = []
        name = f"{title}, moved by {length_m} m" + (" together" if spread_m else "")
        for seed in arguments.seeds if length_m else arguments.seeds[:1]:
            result, vector, block = moved(frame, length_m, seed, noise_m, spread_m)
            if not arguments.off:
                result, registered = register(result, cloud)
                left = np.linalg.norm(vector + [row.shift_m for row in registered], axis=1)
                remaining += [float(left[block == b].mean()) for b in range(block.max() + 1)]
            runs.append(measures(judged(result, cloud, place, predictor, arguments.judge)))
            print(f"{name}, seed {seed}:", json.dumps(runs[-1]), flush=True)
        for half in in_place:
            for key, (bar, bar_in_place) in BARS.items():
                limit = bar if length_m else bar_in_place
                worse = float(np.mean([run[half][key] for run in runs])) - in_place[half][key]
                if limit is None or arguments.off:
                    figures.row(f"{name}, {half}, {NAMES[key]} worse by", {"value": worse})
                    print(f"{name}, {half}, {NAMES[key]} worse by {worse:.3f}")
                else:
                    figures.at_most(f"{name}, {half}, {NAMES[key]} worse by", worse, limit)
        if remaining:
            figures.at_most(
                f"{name}, median of the remaining shift, m", float(np.median(remaining)), REMAINING_M
            )
            spread = {"p90": float(np.quantile(remaining, 0.9)), "max": max(remaining)}
            figures.row(f"{name}, remaining shift", spread)
    if not arguments.off:
        seconds = cpu_seconds(lambda: register(frame, cloud), repeats=5)
        figures.at_most(f"{title}, CPU ms per building", 1e3 * seconds / len(frame), CPU_MS)


def of_deviations(figures: Figures, arguments: argparse.Namespace) -> None:
    """Add the share of the blocks with evidence that end within two stated deviations of their true place."""
    for name, place in places(arguments.data).items():
        frame, cloud = read(place)
        within: list[bool] = []
        num_drawn, seed = 0, arguments.seeds[0]
        while num_drawn < NUM_DRAWN:
            result, vector, block = moved(frame, SHIFTS_M[seed % len(SHIFTS_M)], seed)
            rows = register(result, cloud)[1]
            for b in range(block.max() + 1):
                row = int(np.flatnonzero(block == b)[0])
                shift_sd_m = rows[row].shift_sd_m
                if shift_sd_m is not None:
                    left_m = float(np.linalg.norm(vector[row] + rows[row].shift_m))
                    within.append(left_m <= 2 * shift_sd_m)
            num_drawn, seed = num_drawn + int(block.max()) + 1, seed + 1
        figures.row(f"{name}, moved at random", {"drawn": num_drawn, "with evidence": len(within)})
        if name == "delft":
            figures.at_least(
                f"{name}, moved at random, within two deviations", float(np.mean(within)), WITHIN
            )


def of_few_points(figures: Figures, arguments: argparse.Namespace) -> None:
    """Add what registration does to blocks in place, and to moved blocks, where points are few.

    The shift with all points counts as true. A block in place is moved falsely if it is moved to another place than
    that: the footprint may be displaced.
    """
    num_false = num_runs = 0
    within: list[bool] = []
    for name in SPARSE:
        folder = arguments.data / name
        frame, cloud = read(Place(folder / "footprints.gpkg", tuple(sorted(folder.glob("*.laz"))), 0))
        known = np.array([row.shift_m for row in register(frame, cloud)[1]])
        for share in SHARES:
            left: dict[float, list[bool]] = {length_m: [] for length_m in SHIFTS_M}
            for seed in arguments.seeds:
                keep = generator(seed, "few points", share).random(len(cloud)) < share
                few = Cloud(
                    cloud.x_m[keep], cloud.y_m[keep], cloud.z_m[keep], cloud.classification[keep], cloud.crs
                )
                num_runs += 1
                for length_m in (0.0, *SHIFTS_M):
                    blocks = registered_blocks(frame, few, known, length_m, seed)
                    if length_m:
                        left[length_m] += [off_m > LEFT_M for off_m, _ in blocks]
                        within += [off_m <= 2 * row.shift_sd_m for off_m, row in blocks if row.shift_sd_m]
                    else:
                        num_false += sum(
                            row.shift_m != (0.0, 0.0) and off_m > LEFT_M for off_m, row in blocks
                        )
            figures.row(
                f"{name}, {share:.0%} of the points, share left more than {LEFT_M} m off",
                {f"moved by {length_m} m": float(np.mean(each)) for length_m, each in left.items()},
            )
    figures.row("few points, blocks in place that move, per run", {"value": num_false / num_runs})
    figures.at_least("few points, within two deviations", float(np.mean(within)), WITHIN)


def registered_blocks(
    frame: gpd.GeoDataFrame, cloud: Cloud, known: np.ndarray, length_m: float, seed: int
) -> list[tuple[float, Registration]]:
    """(how far each block is off, its registration) after it was moved by a vector of length ``length_m`` and
    registered. known: (footprints, 2), the shifts in place with all points."""
    features, vector, block = moved(frame, length_m, seed)
    rows = register(features, cloud)[1]
    first = np.unique(block, return_index=True)[1].tolist()
    return [(float(np.linalg.norm(vector[k] + rows[k].shift_m - known[k])), rows[k]) for k in first]


def of_missed_roofs(figures: Figures, arguments: argparse.Namespace) -> None:
    """Add the figures of blocks in place and moved, in clouds whose producer left a share of the roof points
    unclassified."""
    for share in MISSED_SHARES:
        left: list[bool] = []
        within: list[bool] = []
        num_false = num_in_place = 0
        for name in SPARSE:
            folder = arguments.data / name
            frame, cloud = read(Place(folder / "footprints.gpkg", tuple(sorted(folder.glob("*.laz"))), 0))
            known = np.array([row.shift_m for row in register(frame, cloud)[1]])
            for seed in arguments.seeds:
                is_missed = generator(seed, "missed roofs", share).random(len(cloud)) < share
                classes = np.where(is_missed & (cloud.classification == 6), 1, cloud.classification)
                some = replace(cloud, classification=classes.astype(np.uint8))
                in_place = registered_blocks(frame, some, known, 0.0, seed)
                num_in_place += len(in_place)
                num_false += sum(row.shift_m != (0.0, 0.0) and off_m > LEFT_M for off_m, row in in_place)
                for length_m in SHIFTS_M:
                    blocks = registered_blocks(frame, some, known, length_m, seed)
                    left += [off_m > LEFT_M for off_m, _ in blocks]
                    within += [off_m <= 2 * row.shift_sd_m for off_m, row in blocks if row.shift_sd_m]
        title = f"{share:.0%} of the roof points unclassified"
        figures.row(f"{title}, blocks in place", {"number": num_in_place, "moved": num_false})
        figures.row(f"{title}, share of moved blocks left more than {LEFT_M} m off", {"value": np.mean(left)})
        figures.at_least(f"{title}, within two deviations", float(np.mean(within)), WITHIN)


def of_own_classes(figures: Figures, arguments: argparse.Namespace) -> None:
    """Add the figures of blocks in place, and moved by 1 m and more, in clouds whose classes are removed."""
    counts = dict.fromkeys(("in place", "in place and moved", "displaced", "displaced and left"), 0)
    for name in (*SPARSE, *UNCLASSIFIED):
        folder = arguments.data / name
        frame, cloud = read(Place(folder / "footprints.gpkg", tuple(sorted(folder.glob("*.laz"))), 0))
        own, _ = with_classes(replace(cloud, classification=np.ones(len(cloud), np.uint8)))
        registers = np.full(len(frame), OWN_CLASSES, np.int8)
        for length_m in (0.0, *SHIFTS_M[1:]):
            state, what = ("displaced", " and left") if length_m else ("in place", " and moved")
            for seed in arguments.seeds:
                features, vector, block = moved(frame, length_m, seed)
                rows = register(features, own, registers)[1]
                for k in np.unique(block, return_index=True)[1].tolist():
                    off_m = float(np.linalg.norm(vector[k] + rows[k].shift_m))
                    counts[state] += 1
                    counts[state + what] += off_m > (LEFT_M if length_m else 0.0)
    figures.row("classes removed, blocks", counts)
    share = counts["in place and moved"] / counts["in place"]
    figures.at_most("classes removed, share of blocks in place that move", share, 0.01)


def town(folder: Path, num_buildings: int) -> Place:
    """The first footprints of a town that lie within its cloud, with their neighbours, in a file beside it."""
    cloud = next(folder.glob("lidar/*.laz"), None)
    if cloud is None:
        sys.exit(f"{folder}: no town with LiDAR; see the top of this file for the command")
    source = next(folder.glob("bdtopo/*.gpkg"))
    points = clouds.read_clouds([cloud])
    frame = footprints.read_footprints(source).to_frame()
    box = shapely.box(points.x_m.min(), points.y_m.min(), points.x_m.max(), points.y_m.max())
    frame = frame[frame.within(box)].iloc[:num_buildings][["building_id", "geometry"]]
    path = folder / "registration.gpkg"
    frame.to_file(path, driver="GPKG", engine="pyogrio")
    return Place(path, (cloud,), 2154)


def of_sheds(figures: Figures, arguments: argparse.Namespace) -> None:
    """Add the figures of footprints at places without a building, beside footprints of buildings."""
    num_sheds = num_moved = 0
    for name, place in places(arguments.data).items():
        frame, cloud = read(place)
        for seed in arguments.seeds:
            sheds = shed_footprints(frame, cloud, generator(seed, "sheds", name))
            shapes = np.array([*frame.geometry, *sheds], dtype=object)
            both = Features(shapes, {"building_id": np.arange(len(shapes)).astype(str)})
            rows = register(both, cloud)[1][len(frame) :]
            num_sheds += len(rows)
            num_moved += sum(row.shift_m != (0.0, 0.0) for row in rows)
        rows = register(frame, cloud)[1]
        moved_m = [np.hypot(*row.shift_m) for row in rows if row.shift_m != (0.0, 0.0)]
        num_known = sum(row.source != NOTHING for row in rows)
        print(
            f"{place}: {len(rows)} footprints, evidence for {num_known}, moved {np.round(moved_m, 2).tolist()}"
        )
    figures.row("sheds", {"number": num_sheds})
    figures.at_most("share of sheds without a building that move", num_moved / num_sheds, 0.01)


def shed_footprints(features: Features, cloud: Cloud, draw: np.random.Generator) -> list[shapely.Polygon]:
    """Rectangles at random places with points, of which at most 30 % are of class building."""
    footprint_tree = shapely.STRtree(features.geometry)
    low = np.array([cloud.x_m.min() + 3, cloud.y_m.min() + 3])
    high = np.array([cloud.x_m.max() - 9, cloud.y_m.max() - 9])
    result: list[shapely.Polygon] = []
    for _ in range(20 * SHEDS):
        corner, size = draw.uniform(low, high), draw.uniform(2.2, 6, 2)
        shed = affinity.rotate(shapely.box(*corner, *(corner + size)), draw.uniform(0, 90))
        x_min, y_min, x_max, y_max = shed.bounds
        near = (cloud.x_m > x_min) & (cloud.x_m < x_max) & (cloud.y_m > y_min) & (cloud.y_m < y_max)
        inside = shapely.contains_xy(shed, cloud.x_m[near], cloud.y_m[near])
        is_building = cloud.classification[near][inside] == 6
        if len(footprint_tree.query(shed, predicate="dwithin", distance=0.3)) or len(result) == SHEDS:
            continue
        if len(is_building) >= 5 and is_building.mean() <= 0.3 and all(shed.distance(s) > 6 for s in result):
            result.append(shed)
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--judge", type=Path, required=True)
    parser.add_argument("--model", type=Path, default=None, help="weights of a network, in place of the fit")
    parser.add_argument("--seeds", type=int, nargs="+", default=[30, 31, 32])
    parser.add_argument(
        "--town", type=Path, default=None, help="folder of a town with LiDAR, in place of Delft"
    )
    parser.add_argument("--town-buildings", type=int, default=100)
    parser.add_argument("--off", action="store_true", help="without the registration, for comparison")
    arguments = parser.parse_args()
    predictor = None
    if arguments.model is not None:
        from p2wss.nets.predictor import load_predictor

        predictor = load_predictor(arguments.model)
    figures = Figures()
    if arguments.town is not None:
        place = town(arguments.town, arguments.town_buildings)
        for noise_m in TOWN_NOISE_M:
            title = f"town, vertices {noise_m:g} m"
            of_moved_blocks(figures, title, place, predictor, arguments, noise_m)
    else:
        of_moved_blocks(figures, "delft", places(arguments.data)["delft"], predictor, arguments)
        if not arguments.off:
            of_deviations(figures, arguments)
            of_few_points(figures, arguments)
            of_missed_roofs(figures, arguments)
            of_own_classes(figures, arguments)
            of_sheds(figures, arguments)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
