"""Speed, rejections and sensitivity of the geometry kernel, against SFCGAL and, where installed, compas_cgal.

    python benchmarks/skeleton.py [--num 5000] [--real FOLDER]

Needs SFCGAL; the rest is optional.

All speeds are CPU time of one core. FOLDER contains real footprints (default: ../shared/data; skipped if
absent). The last line is JSON.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "unit" / "skeleton"))
from figures import Figures, cpu_seconds  # noqa: E402
from numba import njit  # noqa: E402
from sfcgal import sfcgal_volumes  # noqa: E402
from skeleton_samples import REGIMES, clean, edge_source, sample_angles, sample_footprints  # noqa: E402
from skeleton_solids import volumes  # noqa: E402

from p2wss.config import Scenes  # noqa: E402
from p2wss.scenes.roofs import FootprintEdges, draw_angles  # noqa: E402
from p2wss.skeleton import Polygons, Status, build  # noqa: E402
from p2wss.skeleton.footprint import load_footprint, set_angles  # noqa: E402
from p2wss.skeleton.kinetic import simulate, skeleton_work  # noqa: E402
from p2wss.skeleton.queries import QueryPoints, _assign, query_work  # noqa: E402

FIRST_USE = """
import time, numpy as np
start = time.process_time()
from p2wss.skeleton import Polygons, build, roof_points
square = np.array([[0, 0], [10, 0], [10, 10], [0, 10]], float)
polygons = Polygons.from_rings([[square]])
solid = polygons, np.full(4, 45.0), np.array([5.0])
build(*solid)
print("build", time.process_time() - start)
start = time.process_time()
roof_points(*solid, np.ones((1, 2)), np.zeros(1, int))
print("roof_points", time.process_time() - start)
"""
REAL = ("olemps_bdtopo/BATIMENT.shp", "delft_ahn3/footprints.gpkg", "bresse_ign/footprints.gpkg")


def speed(num: int) -> float:
    """Buildings per second and core for skeleton, mesh and checks, in the slowest regime."""
    print(f"{'regime':<12}{'courtyards':>11}{'edges':>7}{'buildings/s':>13}{'triangles':>11}  rejected")
    slowest = np.inf
    for share in (0.0, 1.0):
        polygons = clean(sample_footprints(num, 1, share))
        eave = np.full(num, 5.0)
        for regime in REGIMES:
            angle = sample_angles(polygons, regime, 5)
            meshes = build(polygons, angle, eave)
            build_s = cpu_seconds(partial(build, polygons, angle, eave))
            rate = num / build_s
            if share == 0.0:
                slowest = min(slowest, rate)
            reasons = dict(Counter(Status(s).reason for s in meshes.status if s))
            print(
                f"{regime:<12}{share:>11.0%}{len(polygons.xy_m) / num:>7.2f}{rate:>13.0f}"
                f"{len(meshes.triangle) / max((meshes.status == 0).sum(), 1):>11.1f}  {reasons or 0}"
            )
    return slowest


def against_sfcgal(num: int) -> float:
    """Speed divided by the speed of SFCGAL on the same buildings, both in CPU time."""
    polygons = clean(sample_footprints(num, 2))
    angle = sample_angles(polygons, "one", 2)
    eave = np.full(num, 5.0)
    kernel_s = cpu_seconds(lambda: build(polygons, angle, eave)) / num
    _, sfcgal_s = sfcgal_volumes(polygons, angle)
    print(f"\nSFCGAL {1 / sfcgal_s.mean():.0f} roofs/s, this kernel {1 / kernel_s:.0f} checked solids/s")
    return sfcgal_s.mean() / kernel_s


def against_compas(num: int) -> float | None:
    """Speed divided by the speed of compas_cgal's roofs; None where compas_cgal is not installed."""
    if importlib.util.find_spec("compas_cgal") is None:
        print("compas_cgal is not installed: not compared")
        return None
    from compas_cgal import _straight_skeleton_2

    polygons = clean(sample_footprints(num, 2))
    angle = sample_angles(polygons, "one", 2)
    kernel_s = cpu_seconds(lambda: build(polygons, angle, np.full(num, 5.0))) / num
    compas_s = 0.0
    for k in range(num):
        ring = polygons.rings(k)[0]
        turned = np.roll(angle[polygons.vertex_offset[k] : polygons.vertex_offset[k + 1]], 1).tolist()
        start = time.process_time()
        _straight_skeleton_2.extrude_straight_skeleton(
            np.column_stack([ring, np.zeros(len(ring))]), [], [turned], True, -1.0
        )
        compas_s += time.process_time() - start
    print(f"compas_cgal {num / compas_s:.0f} roofs/s")
    return compas_s / num / kernel_s


def triangles_by_edges(num: int) -> None:
    """Print the number of triangles of a solid by the number of its footprint edges."""
    polygons = clean(sample_footprints(num, 1))
    meshes = build(polygons, sample_angles(polygons, "realistic", 5), np.full(num, 5.0))
    edges, triangles = np.diff(polygons.vertex_offset), np.diff(meshes.triangle_offset)
    print(f"\n{'edges':>6}{'buildings':>11}{'triangles: mean':>17}{'p5':>6}{'p95':>6}   (realistic)")
    for n in np.unique(edges):
        counts = triangles[(edges == n) & (meshes.status == 0)]
        if len(counts) >= 20:
            low, high = np.quantile(counts, [0.05, 0.95])
            print(f"{n:>6}{len(counts):>11}{counts.mean():>17.1f}{low:>6.0f}{high:>6.0f}")


def scaling() -> float:
    """Milliseconds for one building of 1,000 edges."""
    print(f"\n{'edges':>6}{'ms':>9}{'us per edge':>13}")
    seconds = 0.0
    for n in (4, 10, 30, 100, 300, 1000):
        rng = np.random.default_rng(n)
        t = np.linspace(0, 2 * np.pi, n, endpoint=False)
        ring = n * (0.12 + rng.uniform(0, 0.025, n))[:, None] * np.stack([np.cos(t), np.sin(t)], 1) * 3
        polygons = clean(Polygons.from_rings([[ring]]))
        angle = rng.uniform(20, 45, len(polygons.xy_m))
        repeats = max(1, 1000 // n)

        def run(polygons=polygons, angle=angle, repeats=repeats):
            for _ in range(repeats):
                status = build(polygons, angle, np.array([5.0])).status
            assert status[0] == 0, Status(status[0])

        seconds = cpu_seconds(run) / repeats
        print(f"{len(angle):>6}{1e3 * seconds:>9.2f}{1e6 * seconds / len(angle):>13.1f}")
    return 1e3 * seconds


def roof_angles(polygons: Polygons, seed: int) -> np.ndarray:
    """Angles of every edge as the stage scenes draws them, no building against another."""
    import shapely

    config = Scenes(seed=seed)
    angle = [np.zeros(0)]
    for k in range(len(polygons)):
        rings = polygons.rings(k)
        if rings:
            radius = shapely.maximum_inscribed_circle(shapely.Polygon(rings[0], rings[1:]), 0.1).length
            edges = FootprintEdges.from_rings(rings, np.zeros(sum(map(len, rings)), bool), radius)
            angle.append(draw_angles(edges, str(k), config)[1])
    return np.concatenate(angle)


def changed_share(polygons: Polygons, angle: np.ndarray, seed: int) -> float:
    """Share of buildings whose volume a millimetre of jitter before the clean-up changes by more than
    2 %."""
    jitter = np.random.default_rng(seed).normal(0, 1e-3, polygons.xy_m.shape)
    volume = []
    for xy in (polygons.xy_m, polygons.xy_m + jitter):
        raw = Polygons(xy, polygons.ring_offset, polygons.polygon_offset)
        cleaned = clean(raw)
        eave = np.full(len(polygons), 5.0)
        volume.append(volumes(build(cleaned, angle[edge_source(raw, cleaned)], eave)))
    return float(np.mean(np.abs(volume[1] / volume[0] - 1) > 0.02))


def sensitivity(num: int, real: dict[str, Polygons], figures: Figures) -> float:
    """The largest :func:`changed_share` over the data sets with angles by roof type; prints all regimes."""
    print(
        "\n1 mm of jitter changes the volume by more than 2 %:\n"
        f"  {'footprints':<28}{'sampler':<12}{'buildings':>10}{'share':>10}"
    )
    worst = 0.0
    exact = sample_footprints(num, 6, jitters=(0.0,))
    for name, raw in {"orthogonal": exact, "mixed": sample_footprints(num, 6), **real}.items():
        polygons = clean(raw)
        seeds = range(1 if name in ("orthogonal", "mixed") else 10)
        for regime in ("roof types", *(REGIMES if name == "mixed" else ())):
            shares = []
            for seed in seeds:
                by_type = regime == "roof types"
                angle = roof_angles(polygons, seed) if by_type else sample_angles(polygons, regime, 7)
                shares.append(changed_share(polygons, angle, seed))
            share = float(np.mean(shares))
            count = len(polygons) * len(seeds)
            print(f"  {name:<28}{regime:<12}{count:>10}{share:>10.3%}")
            figures.row(f"{name}, {regime}", {"buildings": count, "share": share})
            # a share of a few hundred buildings says nothing about one in a thousand
            if regime == "roof types" and count >= 1000:
                worst = max(worst, share)
    return worst


def real_footprints(folder: Path) -> dict[str, Polygons]:
    """The real footprints as they are in the files, by data set; empty where a file is absent."""
    if not all((folder / name).exists() for name in REAL):
        print(f"no real footprints in {folder}: skipped")
        return {}
    import geopandas

    footprints = {}
    for name in REAL:
        geometry = geopandas.read_file(folder / name).geometry.explode()
        footprints[name.split("/")[0]] = Polygons.from_rings(
            [[np.asarray(r.coords)[:, :2] for r in (g.exterior, *g.interiors)] for g in geometry]
        )
    return footprints


def rejections(num: int, real: dict[str, Polygons]) -> float | None:
    """Share of real footprints rejected with ten draws of roof types, None without any; prints every reason."""
    print(
        f"\n{'footprints':<18}{'sampler':<12}{'polygons':>9}{'edges':>7}{'draws':>8}{'rejected':>10}  reasons"
    )
    worst = None
    random = {"random": sample_footprints(num, 6), "courtyards": sample_footprints(num, 6, 1.0)}
    for name, raw in {**random, **real}.items():
        cleaned = clean(raw)
        for regime in ("roof types", *REGIMES):
            reasons: Counter[str] = Counter()
            for seed in range(10 if name in real else 1):
                by_type = regime == "roof types"
                angle = roof_angles(cleaned, seed) if by_type else sample_angles(cleaned, regime, seed)
                meshes = build(cleaned, angle, np.full(len(raw), 6.0))
                reasons.update(Status(s).reason for s in meshes.status if s)
            share = sum(reasons.values()) / ((seed + 1) * len(raw))
            print(
                f"{name:<18}{regime:<12}{len(raw):>9}{len(cleaned.xy_m) / len(raw):>7.2f}"
                f"{(seed + 1) * len(raw):>8}{share:>10.3%}  {dict(reasons) or '-'}"
            )
            if regime == "roof types" and name in real:
                worst = max(worst or 0.0, share)
    return worst


@njit(error_model="numpy")
def _evaluate(repeats, num_edges, num_rings, angle_deg, work, query, x, y, face, distance):
    status = 0
    for _ in range(repeats):
        status += set_angles(work.edge, num_edges, angle_deg)
        status += simulate(work, num_edges, num_rings, np.inf)
        _assign(num_edges, np.inf, work, query, QueryPoints(x, y, face, distance))
    return status


@njit(error_model="numpy")
def _load(polygons_xy, ring_offset, work):
    return load_footprint(polygons_xy, ring_offset, 0, len(ring_offset) - 1, work.edge)[0]


def fit_evaluation(num_points: int = 60) -> float:
    """Mean microseconds to evaluate one set of angles at 60 points, as the fit does, over footprints of up to
    8 edges."""
    polygons = clean(sample_footprints(400, 4))
    angle = sample_angles(polygons, "realistic", 4)
    rng = np.random.default_rng(0)
    seconds = []
    for k in range(len(polygons)):
        first, last = polygons.vertex_offset[k : k + 2]
        n = last - first
        if n > 8:
            continue
        work, query = skeleton_work(16), query_work(16)
        xy = polygons.xy_m[first:last].copy()
        assert _load(xy, np.array([0, n]), work) == 0
        low, high = xy.min(0) - xy[0], xy.max(0) - xy[0]
        x, y = rng.uniform(low, high, (num_points, 2)).T.copy()
        out = np.zeros(num_points, np.int64), np.zeros(num_points)
        arguments = n, 1, angle[first:last].copy(), work, query, x, y, *out
        assert _evaluate(1, *arguments) == 0
        seconds.append(cpu_seconds(partial(_evaluate, 200, *arguments)) / 200)
    mean, high = 1e6 * float(np.mean(seconds)), 1e6 * np.quantile(seconds, 0.95)
    print(
        f"\nset_angles + simulate + _assign, {num_points} points, up to 8 edges: {mean:.1f} us (p95 {high:.1f})"
    )
    return mean


def first_use() -> float:
    """CPU seconds of the first build() with an empty cache, imports included; prints further calls."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        by_call = []
        for _ in range(2):
            process = subprocess.run(
                [sys.executable, "-c", FIRST_USE], env=environment, capture_output=True, text=True, check=True
            )
            lines = map(str.split, process.stdout.splitlines())
            by_call.append({name: float(value) for name, value in lines})
    print("\nCPU seconds of the first call in a process, empty cache and full cache:")
    for name in by_call[0]:
        print(f"  {name:<12}{by_call[0][name]:>7.2f}{by_call[1][name]:>7.2f}")
    return by_call[0]["build"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=5000, help="buildings per regime")
    parser.add_argument("--real", type=Path, default=ROOT.parent / "shared" / "data", help="real footprints")
    options = parser.parse_args()

    figures = Figures()
    clean(sample_footprints(2, 0))  # loads the machine code
    figures.at_least("buildings_per_s_core", speed(options.num), 10_000)
    figures.at_least("ratio_to_sfcgal", against_sfcgal(min(options.num, 500)), 40)
    figures.at_least("ratio_to_compas_cgal", against_compas(min(options.num, 500)), 1)
    triangles_by_edges(options.num)
    figures.at_most("ms_for_1000_edges", scaling(), 1000)
    figures.at_most("us_per_fit_evaluation", fit_evaluation(), 5)
    real = real_footprints(options.real)
    figures.at_most("sensitive_share", sensitivity(options.num, real, figures), 0.01)
    figures.at_most("real_rejected_share", rejections(options.num, real), 0.005)
    figures.at_most("first_use_s", first_use(), 30)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
