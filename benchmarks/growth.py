"""How the CPU time of a fit grows with points, area and edges of a footprint; the last line is JSON.

    python benchmarks/growth.py

Buildings are simulated, with the default settings: rows of houses side by side, each 12 m wide with a gable roof of its
own height, on a rectangle. One quantity grows, the others stay or, where they cannot, follow:

* points: three houses with 1,000 to 100,000 points;
* area: 50 to 5,000 m² with 10 points per m², and one house, so one part, for each 144 m²;
* edges: 1,600 m² under one roof with 5,000 points, whose outline has as many teeth of half a metre as give 4 to 1,000
  edges.

The exponent of a row says how the time grows from the row before: 1 is in proportion, 2 with the square. The number
of parts in the result is shown because another number of them takes another time.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import partial

import numpy as np
import shapely
from figures import Figures, cpu_seconds

from p2wss.config import Config
from p2wss.data.building import Building
from p2wss.data.seeds import generator
from p2wss.fit.fitting import fit

POINTS = (1_000, 3_000, 10_000, 30_000, 100_000)
AREAS_M2 = (50, 150, 500, 1_500, 5_000)
EDGES = (4, 12, 40, 100, 300, 1_000)
HOUSE_M, NOISE_M, POINTS_PER_M2, TOOTH_M = 12.0, 0.03, 10, 0.5
# exponents over the whole range; the issue that asks for this measurement states none
BARS = {"points": 1.0, "area": 1.5, "edges": 1.5}
# what takes longer is measured once
LONG_S = 0.5
# of the largest building of each kind
BARS_S = {"points": 0.5, "area": 1.0, "edges": 10.0}


def row_of_houses(width_m: float, depth_m: float, num_points: int, teeth: int = 0) -> Building:
    """Houses of 12 m side by side, or one roof over an outline with teeth along its front and back."""
    ring = np.array([[0, 0], [width_m, 0], [width_m, depth_m], [0, depth_m]])
    if teeth:
        ring = toothed(width_m, depth_m, teeth)
    rng = generator(0, "growth", width_m, depth_m, num_points, teeth)
    polygon, xy = shapely.Polygon(ring), np.zeros((0, 2))
    while len(xy) < num_points:
        more = rng.uniform((0.0, 0.0), (width_m, depth_m), (num_points, 2))
        xy = np.vstack([xy, more[shapely.contains_xy(polygon, more[:, 0], more[:, 1])]])[:num_points]
    number = np.zeros(len(xy), int) if teeth else (xy[:, 0] // HOUSE_M).astype(int)
    eave_m = 5.0 + 1.5 * (number % 3)
    z = eave_m + 0.7 * np.minimum(xy[:, 1], depth_m - xy[:, 1]) + rng.normal(0.0, NOISE_M, len(xy))
    return Building("growth", "t", (0.0, 0.0), [ring], np.column_stack([xy, z]), np.full(len(xy), 6), 0.0)


def toothed(width_m: float, depth_m: float, teeth: int) -> np.ndarray:
    """A rectangle, counter-clockwise, whose front and back have teeth inwards, ``teeth`` in all; each adds four
    edges."""
    corners: list[tuple[float, float]] = []
    for side, count in enumerate((teeth - teeth // 2, teeth // 2)):
        y, inward = (0.0, TOOTH_M) if side == 0 else (depth_m, -TOOTH_M)
        step = width_m / (2 * count + 1)
        along = [(0.0, y), *((step * (k + 1), y) for k in range(2 * count)), (width_m, y)]
        front = [along[0]]
        for k in range(count):
            (x0, _), (x1, _) = along[2 * k + 1], along[2 * k + 2]
            front += [(x0, y), (x0, y + inward), (x1, y + inward), (x1, y)]
        front.append(along[-1])
        corners += front if side == 0 else front[::-1]
    return np.array(corners)


def measure(name: str, cases: Sequence[tuple[int, Building]], figures: Figures) -> None:
    """Print one table and add its rows."""
    config, times = Config().reconstruct, []
    print(f"\n{name:>8}  CPU ms  exponent  parts")
    fit([cases[0][1]], config)  # loads what is compiled
    for size, building in cases:
        start = time.process_time()
        (reconstruction,) = fit([building], config)
        seconds = time.process_time() - start
        if seconds < LONG_S:
            seconds = cpu_seconds(partial(fit, [building], config))
        exponent = None
        if times:
            exponent = float(np.log(seconds / times[-1][1]) / np.log(size / times[-1][0]))
        times.append((size, seconds))
        parts = reconstruction.num_parts if reconstruction.has_mesh else 0
        print(f"{size:>8,}  {1e3 * seconds:>6.0f}  {exponent or 0:>8.2f}  {parts:>5}", flush=True)
        figures.row(f"{name} {size}", {"cpu_ms": 1e3 * seconds, "exponent": exponent, "parts": parts})
    (first, first_s), (last, last_s) = times[0], times[-1]
    overall = np.log(last_s / first_s) / np.log(last / first)
    figures.at_most(f"{name}: exponent from {first:,} to {last:,}", overall, BARS[name])
    figures.at_most(f"{name}: CPU s for {last:,}", last_s, BARS_S[name])


def main() -> int:
    figures = Figures()
    measure("points", [(count, row_of_houses(36.0, 10.0, count)) for count in POINTS], figures)
    areas = []
    for area in AREAS_M2:
        width_m = area / HOUSE_M
        areas.append((area, row_of_houses(width_m, HOUSE_M, POINTS_PER_M2 * area)))
    measure("area", areas, figures)
    edges = [(count, row_of_houses(80.0, 20.0, 5_000, (count - 4) // 4)) for count in EDGES]
    measure("edges", edges, figures)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
