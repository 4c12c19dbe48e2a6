"""Random footprints and angles for the tests and the benchmark of the kernel."""

from __future__ import annotations

import numpy as np
import shapely

from p2wss.config import Scenes
from p2wss.data import polygon_arrays
from p2wss.footprints.coverage import clean_coverage
from p2wss.skeleton import Polygons

REGIMES = ("one", "iid", "realistic", "many-90", "many-0")


def _outline(rng: np.random.Generator) -> np.ndarray:
    """A counter-clockwise ring: rectangles, L, T, U and Z shapes, stars, rows of steps."""
    w, h = rng.uniform(5, 12), rng.uniform(8, 25)
    a, b = rng.uniform(0.25, 0.6, 2)
    kind = rng.integers(0, 8)
    if kind <= 1:
        ring = [[0, 0], [w, 0], [w, h], [0, h]]
    elif kind == 2:
        ring = [[0, 0], [w, 0], [w, h * a], [w * b, h * a], [w * b, h], [0, h]]
    elif kind == 3:
        left = 0.2 * b * w
        ring = [
            [0, 0],
            [w, 0],
            [w, h * a],
            [0.7 * w, h * a],
            [0.7 * w, h],
            [left, h],
            [left, h * a],
            [0, h * a],
        ]
    elif kind == 4:
        ring = [[0, 0], [2 * w, 0], [2 * w, h], [(2 - a) * w, h]]
        ring += [[(2 - a) * w, h * b], [w * a, h * b], [w * a, h], [0, h]]
    elif kind == 5:
        low, high = 0.5 * w, 1.5 * w
        ring = [
            [0, 0],
            [w, 0],
            [w, h * a],
            [high, h * a],
            [high, h],
            [low, h],
            [low, h * a * 1.2],
            [0, h * a * 1.2],
        ]
    elif kind == 6:
        n = int(rng.integers(5, 13))
        t = np.linspace(0, 2 * np.pi, n, endpoint=False) + rng.uniform(-0.2, 0.2, n)
        r = rng.uniform(0.6, 1, n) * w
        return np.stack([r * np.cos(t), r * np.sin(t)], 1)
    else:
        front, x = [], 0.0
        for _ in range(rng.integers(2, 6)):
            step, depth = rng.uniform(3, 8), rng.uniform(-2, 2)
            front += [[x, depth], [x + step, depth]]
            x += step
        ring = [*front, [x, 12.0], [0, 12.0]]
    return np.array(ring, float)


def _court(rng: np.random.Generator) -> list[np.ndarray]:
    """A rectangle with one or two courtyards."""
    w, h = rng.uniform(14, 40, 2)
    x0, y0 = rng.uniform(3, 5, 2)
    x1, y1 = w - rng.uniform(3, 5), h - rng.uniform(3, 5)
    outer = np.array([[0, 0], [w, 0], [w, h], [0, h]])
    if w > 30:
        xm = (x0 + x1) / 2
        left = [[x0, y0], [x0, y1], [xm - 2, y1], [xm - 2, y0]]
        right = [[xm + 2, y0], [xm + 2, y1], [x1, y1 - 1], [x1, y0]]
        return [outer, np.array(left), np.array(right)]
    if rng.random() < 0.6:
        return [outer, np.array([[x0, y0], [x0, y1], [x1, y1], [x1, y0]])]
    return [outer, np.array([[x0, y0], [(x0 + x1) / 2, y1], [x1, (y0 + y1) / 2]])]


def sample_footprints(
    num: int, seed: int, court_share: float = 0.0, jitters: tuple[float, ...] = (0, 0.01, 0.1)
) -> Polygons:
    """Footprints of about 7 edges on average, most at a random orientation, with one of the jitters (metres)."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(num):
        rings = _court(rng) if rng.random() < court_share else [_outline(rng)]
        jitter = rng.choice(jitters)
        turn = rng.uniform(0, 2 * np.pi) if rng.random() < 0.7 else 0.0
        c, s = np.cos(turn), np.sin(turn)
        out.append([(r + jitter * rng.normal(size=r.shape)) @ np.array([[c, -s], [s, c]]) for r in rings])
    return Polygons.from_rings(out)


def clean(raw: Polygons) -> Polygons:
    """Each polygon cleaned by itself; one that is rejected is empty."""
    first = np.array([rings[0][0] if (rings := raw.rings(k)) else (0, 0) for k in range(len(raw))])
    # so far apart that none is a neighbour of another
    number = np.arange(len(raw))
    shift = np.column_stack([number % 64, number // 64]) * 1000.0 - first
    of_vertex = np.repeat(shift, np.diff(raw.vertex_offset), axis=0)
    apart = Polygons(raw.xy_m + of_vertex, raw.ring_offset, raw.polygon_offset)
    shapes = polygon_arrays.to_geometries(apart)
    valid = np.flatnonzero(shapely.is_valid(shapes) & ~shapely.is_empty(shapes))
    result = np.full(len(raw), shapely.Polygon(), dtype=object)
    result[valid] = clean_coverage(shapes[valid], Scenes(snap_m=0, simplify_m=0, min_edge_m=0.05))
    polygons = polygon_arrays.to_polygons(result)
    xy_m = polygons.xy_m - np.repeat(shift, np.diff(polygons.vertex_offset), axis=0)
    return Polygons(xy_m, polygons.ring_offset, polygons.polygon_offset)


def edge_source(raw: Polygons, cleaned: Polygons) -> np.ndarray:
    """For each edge of cleaned polygons the edge of the raw ones whose middle is nearest, int64."""
    middles = []
    for polygons in (raw, cleaned):
        rings = np.split(polygons.xy_m, polygons.ring_offset[1:-1])
        middles.append(np.concatenate([(ring + np.roll(ring, -1, axis=0)) / 2 for ring in rings]))
    result = []
    for k in range(len(raw)):
        a, b = raw.vertex_offset[k : k + 2]
        c, d = cleaned.vertex_offset[k : k + 2]
        distance = np.linalg.norm(middles[0][a:b] - middles[1][c:d, None], axis=2)
        result.append(a + distance.argmin(axis=1) if d > c else np.zeros(0, int))
    return np.concatenate(result)


def edge_lengths(polygons: Polygons) -> np.ndarray:
    """Length in metres of every edge."""
    xy, offset = polygons.xy_m, polygons.ring_offset
    following = np.arange(1, len(xy) + 1)
    filled = offset[1:] > offset[:-1]
    following[offset[1:][filled] - 1] = offset[:-1][filled]
    return np.hypot(*(xy[following] - xy).T)


def sample_angles(polygons: Polygons, regime: str, seed: int) -> np.ndarray:
    """Angles of every edge. ``realistic``: flat, hip and gable roofs and a few irregular ones."""
    rng = np.random.default_rng(seed)
    n, num = len(polygons.xy_m), len(polygons)
    polygon = np.repeat(np.arange(num), np.diff(polygons.vertex_offset))
    slope = rng.integers(20, 46, n).astype(float)
    base = rng.integers(20, 46, num).astype(float)[polygon]
    if regime == "one":
        return base
    if regime == "iid":
        return rng.choice(np.r_[0, 90, 20:46], n).astype(float)
    if regime == "many-90":
        return np.where(rng.random(n) < 0.35, 90, slope)
    if regime == "many-0":
        kind = rng.integers(0, 3, n)
        return np.where(kind == 0, 0, np.where(kind == 1, 90, slope))
    kind = rng.random(num)[polygon]
    length = edge_lengths(polygons)
    middle = np.array(
        [np.median(part) if len(part) else 0 for part in np.split(length, polygons.vertex_offset[1:-1])]
    )
    gable = np.where((length <= 1.001 * middle[polygon]) & (rng.random(n) < 0.7), 90, base)
    irregular = np.where(rng.random(n) < 0.25, 90, slope)
    irregular = np.where((kind >= 0.9) & (rng.random(n) < 0.1), 0, irregular)
    return np.select([kind < 0.15, kind < 0.45, kind < 0.8], [np.zeros(n), base, gable], irregular).astype(
        float
    )
