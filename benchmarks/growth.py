"""Whether CPU time and memory of ``p2wss reconstruct`` grow in proportion to the work; the last line is JSON.

    python benchmarks/growth.py [--kinds planes row ..] [--most 5]

Needs no data. Draws clouds and footprints, the work doubling eight times, and runs the whole command on each:

* planes: of one building, 5 to 1,280: a hall of aisles 8 m deep. Each bay of an aisle has its own slope, with steps
  between all bays; bays of neighbouring aisles begin at different places;
* row: gabled houses of one block, 10 to 2,560, wall to wall, with steps between them;
* run: detached gabled houses, 100 to 25,600, which take a quarter of an hour and 3 GB of disk; ``--most 5`` ends
  at 3,200;
* density: points per m² on one house of 140 m² with five roofs, 2 to 512;
* edges: of one outline, 4 to 1,024, with teeth of half a metre around one roof of 1,600 m²; the area stays the same.

Each size is a process of its own. Its CPU time and peak memory (``figures.run``) are reduced by the least values of
runs of one small house, in turn with it. The least of three runs counts if they take below ten seconds, of fifteen for
the divisor of a ratio. The exponent is the slope of log cost over log work in the upper half of the sizes, where hardly
any cost is constant: 1 is in proportion, 2 with the square. Memory counts only for sizes that take ``MIN_MIB`` more
than the small house, as less is within what the start takes; the exponent is 0 with fewer than two such sizes. *Built*
is the share of the drawn roof faces that the result has: time in which nothing was found proves nothing. A kind ends
where a run takes longer than ``--limit``; the figures state up to which size it was measured.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from figures import Figures, Run, run

# the least work of each kind, and the bar for its exponents
FIRST = {"planes": 5, "row": 10, "run": 100, "density": 2, "edges": 4}
MOST_EXPONENT = {"planes": 1.15, "row": 1.15, "run": 1.15, "density": 1.15, "edges": 1.15}
NUM_DOUBLINGS = 8
# bars of single ratios: CPU time of a size divided by that of a smaller one
RATIOS = {"planes": (640, 40, 20.0)}
MIN_MIB = 20.0
# drawn roofs per unit of work, or for all sizes; and the least share of them to be built in the upper half of the sizes
ROOFS = {"planes": 1.0, "row": 2.0, "run": 2.0}
ROOFS_OF_ALL = {"density": 5.0, "edges": 2.0}
MIN_BUILT = 0.7
LONG_S, REPEATS = 10.0, 3
P2WSS = (sys.executable, "-m", "p2wss.cli", "reconstruct")
NOISE_M, TOOTH_M = 0.03, 0.5


def hall(num_planes: int) -> tuple[list[np.ndarray], np.ndarray]:
    """(outlines, roof rectangles) of a hall. A rectangle: x and y from, x and y to, eave, slope along x, along y."""
    doublings = round(math.log2(num_planes / FIRST["planes"]))
    num_aisles = 2 ** ((doublings + 1) // 2)
    num_bays = num_planes // num_aisles
    parts = []
    for aisle in range(num_aisles):
        # bays of 5 m, the first and last of an aisle longer or shorter than the others
        edge = 5.0 * np.arange(num_bays + 1)
        edge[1:-1] += 1.1 * (aisle % 4)
        for bay in range(num_bays):
            eave_m = 6.0 + 0.9 * ((bay + 2 * aisle) % 3)
            parts.append([edge[bay], 8 * aisle, edge[bay + 1], 8 * aisle + 8, eave_m, 0.4, 0.0])
    return [box(0, 0, 5 * num_bays, 8 * num_aisles)], np.array(parts)


def houses(
    num: int, step_m: float, depth_step_m: float, num_columns: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """(outlines, roof rectangles) of gabled houses of 6 m by 10 m on a grid."""
    outlines, parts = [], []
    for number in range(num):
        row, column = divmod(number, num_columns)
        x, y, eave_m = step_m * column, depth_step_m * row, 5.0 + 0.8 * (number % 3)
        outlines.append(box(x, y, x + 6, y + 10))
        parts += [[x, y, x + 6, y + 5, eave_m, 0.0, 0.6], [x, y + 5, x + 6, y + 10, eave_m + 3.0, 0.0, -0.6]]
    return outlines, np.array(parts)


def box(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    """A rectangle, counter-clockwise."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def toothed(num_edges: int, width_m: float, depth_m: float) -> np.ndarray:
    """A rectangle, counter-clockwise, whose front and back have teeth inwards; each adds four edges."""
    teeth = (num_edges - 4) // 4
    corners: list[tuple[float, float]] = []
    for side, count in enumerate((teeth - teeth // 2, teeth // 2)):
        y, inward = (0.0, TOOTH_M) if side == 0 else (depth_m, -TOOTH_M)
        step = width_m / (2 * count + 1)
        front = [(0.0, y)]
        for k in range(count):
            x0, x1 = step * (2 * k + 1), step * (2 * k + 2)
            front += [(x0, y), (x0, y + inward), (x1, y + inward), (x1, y)]
        front.append((width_m, y))
        corners += front if side == 0 else front[::-1]
    return np.array(corners)


def drawn(kind: str, size: int) -> tuple[list[np.ndarray], np.ndarray, float]:
    """(outlines, roof rectangles, points per m²) of a kind and a size."""
    if kind == "planes":
        return *hall(size), 6.0
    if kind == "row":
        return *houses(size, 6.0, 0.0, size), 6.0
    if kind == "run":
        return *houses(size, 16.0, 24.0, math.ceil(math.sqrt(size))), 6.0
    if kind == "edges":
        gable = [[0, 0, 80, 10, 5.0, 0.0, 0.6], [0, 10, 80, 20, 11.0, 0.0, -0.6]]
        return [toothed(size, 80.0, 20.0)], np.array(gable), 4.0
    wings = [[0, 0, 14, 5, 6, 0, 0.7], [0, 5, 14, 10, 9.5, 0, -0.7], [14, 2, 18, 5, 4, 0, 0.7]]
    wings += [[14, 5, 18, 8, 6.1, 0, -0.7], [4, 10, 8, 13, 3, 0, 0]]
    outline = [
        [0, 0],
        [14, 0],
        [14, 2],
        [18, 2],
        [18, 8],
        [14, 8],
        [14, 10],
        [8, 10],
        [8, 13],
        [4, 13],
        [4, 10],
        [0, 10],
    ]
    return [np.array(outline, float)], np.array(wings, float), float(size)


def write(kind: str, size: int, folder: Path) -> None:
    """Write cloud.las and footprints.gpkg. Each rectangle has evenly many points, with ground around all."""
    import geopandas as gpd
    import laspy
    import shapely

    from p2wss.data.seeds import generator

    outlines, parts, points_per_m2 = drawn(kind, size)
    rng = generator(0, "growth", kind, size)
    (x0, y0, x1, y1, eave_m, along_x, along_y) = parts.T
    count = np.maximum(np.round((x1 - x0) * (y1 - y0) * points_per_m2), 1).astype(int)
    part = np.repeat(np.arange(len(parts)), count)
    u, v = rng.random((2, len(part)))
    right_m, up_m = u * (x1 - x0)[part], v * (y1 - y0)[part]
    xyz = np.column_stack(
        [x0[part] + right_m, y0[part] + up_m, eave_m[part] + along_x[part] * right_m + along_y[part] * up_m]
    )
    polygons = shapely.polygons([shapely.LinearRing(ring) for ring in outlines])
    if kind == "edges":
        xyz = xyz[shapely.contains_xy(polygons[0], *xyz[:, :2].T)]
    low, high = np.min([x0, y0], axis=1) - 3.0, np.max([x1, y1], axis=1) + 3.0
    ground = np.column_stack(
        [rng.uniform(low, high, (round(np.prod(high - low)), 2)), np.zeros(round(np.prod(high - low)))]
    )
    tree = shapely.STRtree(polygons)
    ground = np.delete(
        ground, np.unique(tree.query(shapely.points(ground[:, :2]), "dwithin", 0.3)[0]), axis=0
    )
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.scales = [1e-3] * 3
    las.x, las.y, las.z = (
        np.vstack([xyz, ground]) + rng.normal(0, NOISE_M, (len(xyz) + len(ground), 3)) * [0, 0, 1]
    ).T
    las.classification = np.r_[np.full(len(xyz), 6), np.full(len(ground), 2)].astype(np.uint8)
    las.write(folder / "cloud.las")
    ids = [str(number) for number in range(len(polygons))]
    gpd.GeoDataFrame({"id": ids}, geometry=polygons, crs="EPSG:28992").to_file(folder / "footprints.gpkg")


def command(kind: str, size: int, folder: Path) -> list[object]:
    """The command that reconstructs a drawn input. The input is drawn in a process of its own, as figures.run needs a
    small one."""
    folder.mkdir()
    run([sys.executable, __file__, "--draw", kind, size, folder])
    inputs = (folder / "cloud.las", folder / "footprints.gpkg", folder / "out")
    return [*P2WSS, *inputs, "--quiet"]


def num_roofs(folder: Path) -> int:
    """Roof faces in the CityJSONSeq files of a folder."""
    count = 0
    for path in folder.glob("*.city.jsonl"):
        with path.open(encoding="utf-8") as file:
            for line in file:
                for part in json.loads(line)["CityObjects"].values():
                    for geometry in part.get("geometry", []):
                        is_roof = [s["type"] == "RoofSurface" for s in geometry["semantics"]["surfaces"]]
                        count += sum(is_roof[n] for shell in geometry["semantics"]["values"] for n in shell)
    return count


def measured(
    start: list[object], whole: list[object], limit_s: float, most_runs: int = REPEATS
) -> tuple[float, float, int]:
    """(CPU seconds, MiB) of a run without those of the start, and the number of runs."""
    starts: list[Run] = []
    runs: list[Run] = []
    while len(runs) < most_runs and (not runs or runs[-1].wall_s < LONG_S):
        starts.append(run(start))
        runs.append(run(whole, limit_s))
    cpu_s, mib = (
        min(getattr(each, name) for each in runs) - min(getattr(each, name) for each in starts)
        for name in ("cpu_s", "peak_mib")
    )
    return cpu_s, mib, len(runs)


def exponent(sizes: list[int], costs: list[float]) -> float:
    """Slope of log cost over log size."""
    return float(np.polyfit(np.log(sizes), np.log(np.maximum(costs, 1e-3)), 1)[0])


def measure(kind: str, most: int, limit_s: float, folder: Path, figures: Figures) -> None:
    """Print the table of a kind and add its figures."""
    start = command("run", 1, folder / f"{kind} start")
    run(start)  # compiles what is not compiled yet
    sizes, times_s, peaks_mib, built = [], [], [], []
    print(f"\n{kind:>8}  CPU s less start  CPU ms each  MiB above start  runs  built")
    for size in (FIRST[kind] * 2**number for number in range(most + 1)):
        place = folder / f"{kind} {size}"
        try:
            # the divisor of a ratio is hardly larger than the noise of the start
            is_divisor = kind in RATIOS and size == RATIOS[kind][1]
            most_runs = 5 * REPEATS if is_divisor else REPEATS
            cpu_s, mib, num_runs = measured(start, command(kind, size, place), limit_s, most_runs)
            built.append(
                num_roofs(place / "out") / (ROOFS.get(kind, 0.0) * size + ROOFS_OF_ALL.get(kind, 0.0))
            )
        except TimeoutError:
            print(f"{size:>8,}  not done after {limit_s:g} s")
            break
        finally:
            shutil.rmtree(place)
        print(
            f"{size:>8,}  {cpu_s:>16.3f}  {1e3 * cpu_s / size:>11.2f}  {mib:>15.1f}  {num_runs:>4}  {built[-1]:>5.2f}",
            flush=True,
        )
        sizes.append(size)
        times_s.append(cpu_s)
        peaks_mib.append(mib)
        figures.row(f"{kind} {size}", {"cpu_s": cpu_s, "mib": mib, "built": built[-1]})
    if len(sizes) < 4:
        print("too few sizes for an exponent")
        return
    half = len(sizes) // 2
    figures.row(f"{kind}, measured", {"from": sizes[0], "to": sizes[-1], "exponents from": sizes[half]})
    figures.at_most(
        f"{kind}: exponent of CPU time", exponent(sizes[half:], times_s[half:]), MOST_EXPONENT[kind]
    )
    large = [k for k in range(half, len(sizes)) if peaks_mib[k] >= MIN_MIB]
    of_memory = exponent([sizes[k] for k in large], [peaks_mib[k] for k in large]) if len(large) > 1 else 0.0
    figures.at_most(f"{kind}: exponent of memory", of_memory, MOST_EXPONENT[kind])
    figures.at_least(f"{kind}: built, least of the upper half", min(built[half:]), MIN_BUILT)
    if kind in RATIOS:
        most, least, bar = RATIOS[kind]
        if most in sizes:
            ratio = times_s[sizes.index(most)] / times_s[sizes.index(least)]
            figures.at_most(f"{kind}: CPU time of {most} over {least}", ratio, bar)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=FIRST, default=list(FIRST))
    parser.add_argument("--most", type=int, default=NUM_DOUBLINGS, help="doublings of the work; default: 8")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds after which a run is stopped")
    parser.add_argument("--draw", nargs=3, metavar=("KIND", "SIZE", "FOLDER"), help="only write an input")
    arguments = parser.parse_args()
    if arguments.draw:
        kind, size, folder = arguments.draw
        write(kind, int(size), Path(folder))
        return 0
    figures = Figures()
    with tempfile.TemporaryDirectory() as name:
        for kind in arguments.kinds:
            measure(kind, arguments.most, arguments.limit, Path(name), figures)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
