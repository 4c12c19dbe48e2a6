"""Speed, rejects and sensitivity of the geometry kernel, against SFCGAL (and compas_cgal where installed).

    python benchmarks/skeleton.py [--num 5000] [--real FOLDER]

All speeds are CPU time of one core. FOLDER holds real footprints (default: ../shared/data, skipped if
absent).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "unit" / "skeleton"))
from sfcgal import sfcgal_volumes  # noqa: E402
from skeleton_samples import REGIMES, sample_angles, sample_footprints  # noqa: E402
from skeleton_solids import volumes  # noqa: E402

from p2wss.skeleton import Polygons, Status, build, clean  # noqa: E402

FIRST_USE = """
import time, numpy as np
start = time.process_time()
from p2wss.skeleton import Polygons, build, clean
square = np.array([[0, 0], [10, 0], [10, 10], [0, 10]], float)
polygons = clean(Polygons.from_rings([[square]])).polygons
build(polygons, np.full(4, 45.0), np.array([5.0]))
print(time.process_time() - start)
"""


def cpu_seconds(call, repeats: int = 3) -> float:
    """Least CPU time of a few calls."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        call()
        best = min(best, time.process_time() - start)
    return best


def speed(num: int) -> float:
    """Buildings per second and core for clean-up, skeleton, mesh and checks, over the regimes."""
    print(f"{'regime':<12}{'courtyards':>11}{'edges':>7}{'buildings/s':>13}{'triangles':>11}  rejected")
    slowest = np.inf
    for share in (0.0, 1.0):
        raw = sample_footprints(num, 1, share)
        polygons = clean(raw).polygons
        eave = np.full(num, 5.0)
        cleaning = cpu_seconds(lambda raw=raw: clean(raw))
        for regime in REGIMES:
            angle = sample_angles(polygons, regime, 5)
            meshes = build(polygons, angle, eave)
            building = cpu_seconds(lambda p=polygons, a=angle, e=eave: build(p, a, e))
            rate = num / (cleaning + building)
            if share == 0.0:
                slowest = min(slowest, rate)
            reasons = dict(Counter(Status(s).reason for s in meshes.status if s))
            print(
                f"{regime:<12}{share:>11.0%}{len(polygons.xy_m) / num:>7.2f}{rate:>13.0f}"
                f"{len(meshes.triangle) / max((meshes.status == 0).sum(), 1):>11.1f}  {reasons or 0}"
            )
    return slowest


def against_sfcgal(num: int) -> float:
    """How many times as fast as SFCGAL on the same buildings, both in CPU time."""
    polygons = clean(sample_footprints(num, 2)).polygons
    angle = sample_angles(polygons, "one", 2)
    eave = np.full(num, 5.0)
    mine = cpu_seconds(lambda: build(polygons, angle, eave)) / num
    _, theirs = sfcgal_volumes(polygons, angle)
    print(f"\nSFCGAL {1 / theirs.mean():.0f} roofs/s, this kernel {1 / mine:.0f} checked solids/s")
    return theirs.mean() / mine


def against_compas(num: int) -> float | None:
    """The same for compas_cgal's roofs, or None where it is not installed."""
    if importlib.util.find_spec("compas_cgal") is None:
        print("compas_cgal is not installed: not compared")
        return None
    from compas_cgal import _straight_skeleton_2

    polygons = clean(sample_footprints(num, 2)).polygons
    angle = sample_angles(polygons, "one", 2)
    mine = cpu_seconds(lambda: build(polygons, angle, np.full(num, 5.0))) / num
    used = 0.0
    for k in range(num):
        ring = polygons.rings(k)[0]
        turned = np.roll(angle[polygons.vertex_offset[k] : polygons.vertex_offset[k + 1]], 1).tolist()
        start = time.process_time()
        _straight_skeleton_2.extrude_straight_skeleton(
            np.column_stack([ring, np.zeros(len(ring))]), [], [turned], True, -1.0
        )
        used += time.process_time() - start
    print(f"compas_cgal {num / used:.0f} roofs/s")
    return used / num / mine


def triangles_by_edges(num: int) -> None:
    polygons = clean(sample_footprints(num, 1)).polygons
    meshes = build(polygons, sample_angles(polygons, "realistic", 5), np.full(num, 5.0))
    edges, triangles = np.diff(polygons.vertex_offset), np.diff(meshes.triangle_offset)
    print(f"\n{'edges':>6}{'buildings':>11}{'triangles: mean':>17}{'p5':>6}{'p95':>6}   (realistic)")
    for n in np.unique(edges):
        own = triangles[(edges == n) & (meshes.status == 0)]
        if len(own) >= 20:
            low, high = np.quantile(own, [0.05, 0.95])
            print(f"{n:>6}{len(own):>11}{own.mean():>17.1f}{low:>6.0f}{high:>6.0f}")


def scaling() -> float:
    """Milliseconds for one building of 1,000 edges."""
    print(f"\n{'edges':>6}{'ms':>9}{'us per edge':>13}")
    took = 0.0
    for n in (4, 10, 30, 100, 300, 1000):
        rng = np.random.default_rng(n)
        t = np.linspace(0, 2 * np.pi, n, endpoint=False)
        ring = n * (0.12 + rng.uniform(0, 0.025, n))[:, None] * np.stack([np.cos(t), np.sin(t)], 1) * 3
        polygons = clean(Polygons.from_rings([[ring]])).polygons
        angle = rng.uniform(20, 45, len(polygons.xy_m))
        repeats = max(1, 1000 // n)

        def run(polygons=polygons, angle=angle, repeats=repeats):
            for _ in range(repeats):
                status = build(polygons, angle, np.array([5.0])).status
            assert status[0] == 0, Status(status[0])

        took = cpu_seconds(run) / repeats
        print(f"{len(angle):>6}{1e3 * took:>9.2f}{1e6 * took / len(angle):>13.1f}")
    return 1e3 * took


def sensitivity(num: int) -> float:
    """Share of realistic buildings whose volume a millimetre of jitter changes by more than 2 %."""
    print("\n1 mm of jitter changes the volume by more than 2 %:")
    worst = 0.0
    for regime in REGIMES:
        polygons = clean(sample_footprints(num, 6)).polygons
        angle = sample_angles(polygons, regime, 7)
        jitter = np.random.default_rng(8).normal(0, 1e-3, polygons.xy_m.shape)
        other = Polygons(polygons.xy_m + jitter, polygons.ring_offset, polygons.polygon_offset)
        before, after = (volumes(build(p, angle, np.full(num, 5.0))) for p in (polygons, other))
        share = float(np.mean(np.abs(after / before - 1) > 0.02))
        print(f"  {regime:<12}{share:>8.2%}")
        if regime == "realistic":
            worst = share
    return worst


def real(folder: Path) -> float | None:
    """Share rejected of real footprints with ten draws of realistic angles; prints every reason."""
    names = ["olemps_bdtopo/BATIMENT.shp", "delft_ahn3/footprints.gpkg", "bresse_ign/footprints.gpkg"]
    if not all((folder / name).exists() for name in names):
        print(f"\nno real footprints in {folder}: skipped")
        return None
    import geopandas

    print(f"\n{'real footprints':<30}{'polygons':>9}{'edges':>7}{'draws':>8}{'rejected':>10}  reasons")
    worst = 0.0
    for name in names:
        geometry = geopandas.read_file(folder / name).geometry.explode()
        raw = Polygons.from_rings(
            [[np.asarray(r.coords)[:, :2] for r in (g.exterior, *g.interiors)] for g in geometry]
        )
        cleaned = clean(raw)
        reasons: Counter[str] = Counter()
        for seed in range(10):
            angle = sample_angles(cleaned.polygons, "realistic", seed)
            meshes = build(cleaned.polygons, angle, np.full(len(raw), 6.0))
            status = np.where(cleaned.status != 0, cleaned.status, meshes.status)
            reasons.update(Status(s).reason for s in status if s)
        share = sum(reasons.values()) / (10 * len(raw))
        worst = max(worst, share)
        edges = len(cleaned.polygons.xy_m) / len(raw)
        print(f"{name:<30}{len(raw):>9}{edges:>7.2f}{10 * len(raw):>8}{share:>10.3%}  {dict(reasons) or '-'}")
    return worst


def first_use() -> float:
    """CPU seconds of the first clean() and build() with an empty cache, imports included."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        done = subprocess.run(
            [sys.executable, "-c", FIRST_USE], env=environment, capture_output=True, text=True, check=True
        )
    print(f"\nfirst use with an empty cache: {float(done.stdout):.1f} CPU seconds")
    return float(done.stdout)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=5000, help="buildings per regime")
    parser.add_argument("--real", type=Path, default=ROOT.parent / "shared" / "data")
    options = parser.parse_args()

    figures: dict[str, dict[str, object]] = {}

    def bar(name: str, value: float | None, limit: float, at_least: bool) -> None:
        if value is not None:
            ok = value >= limit if at_least else value <= limit
            figures[name] = {"value": round(value, 5), "bar": limit, "ok": bool(ok)}

    clean(sample_footprints(2, 0))  # loads the machine code
    bar("buildings_per_s_core", speed(options.num), 10_000, True)
    bar("ratio_to_sfcgal", against_sfcgal(min(options.num, 500)), 40, True)
    bar("ratio_to_compas_cgal", against_compas(min(options.num, 500)), 1, True)
    triangles_by_edges(options.num)
    bar("ms_for_1000_edges", scaling(), 1000, False)
    bar("sensitive_share", sensitivity(options.num), 0.001, False)
    bar("real_rejected_share", real(options.real), 0.005, False)
    bar("first_use_s", first_use(), 30, False)
    print(json.dumps(figures))
    return 0 if all(figure["ok"] for figure in figures.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
