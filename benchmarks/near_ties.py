"""Failures of the geometry kernel on symmetric shapes, whose roofs are full of events at one place and height, with
noise that decides which comes first.

    python benchmarks/near_ties.py [--num 100000] [--seed 0]

Needs no data.

A draw is a shape (rectangle, L, T, U, H, I, plus, star, regular polygon, frame), turned, moved, with noise of its
coordinates and with angles of one kind. It fails without a mesh, and with a mesh that is not closed, is not above the
footprint, or has other angles than requested. With one angle for all edges, it also fails if the volume is not the
volume without noise. The last line is JSON.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from figures import Figures

from p2wss.skeleton import FaceKind, Meshes, Polygons, Status, build

NOISE_M = (0.0, *(10.0**k for k in range(-12, -1)))
ANGLES = ("uniform", "flat", "gabled", "random")
_MOVES_M = (0.0, 100.0, 1e5, 7e6)
_EAVE_M = 5.0
_PLANE_M = 1e-4  # how far a corner of a roof may be from the plane of its edge
Ring = np.ndarray


def _rectangle(rng: np.random.Generator) -> list[Ring]:
    w, h = rng.integers(4, 13, 2)
    return [np.array([[0, 0], [w, 0], [w, h], [0, h]], float)]


def _l_shape(rng: np.random.Generator) -> list[Ring]:
    a, b, c, d = _widths(rng)
    return [np.array([[0, 0], [a + b, 0], [a + b, c], [a, c], [a, c + d], [0, c + d]], float)]


def _t_shape(rng: np.random.Generator) -> list[Ring]:
    a, b, c, d = _widths(rng)
    ring = [[0, 0], [2 * a + b, 0], [2 * a + b, c], [a + b, c], [a + b, c + d], [a, c + d], [a, c], [0, c]]
    return [np.array(ring, float)]


def _u_shape(rng: np.random.Generator) -> list[Ring]:
    a, b, c, d = _widths(rng)
    ring = [[0, 0], [2 * a + b, 0], [2 * a + b, c + d], [a + b, c + d]]
    return [np.array([*ring, [a + b, c], [a, c], [a, c + d], [0, c + d]], float)]


def _h_shape(rng: np.random.Generator) -> list[Ring]:
    a, b, c, d = _widths(rng)
    right = [[a, 0], [a, d], [a + b, d], [a + b, 0], [2 * a + b, 0]]
    return [np.array([[0, 0], *right, *(np.array([2 * a + b, 2 * d + c]) - [[0, 0], *right])], float)]


def _i_shape(rng: np.random.Generator) -> list[Ring]:
    return [_h_shape(rng)[0][:, ::-1][::-1]]


def _plus(rng: np.random.Generator) -> list[Ring]:
    a, b, c, d = _widths(rng)
    x, y = (0, a, a + b, 2 * a + b), (0, d, d + c, 2 * d + c)
    ring = [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2), (2, 2), (2, 3), (1, 3), (1, 2), (0, 2), (0, 1), (1, 1)]
    return [np.array([[x[i], y[j]] for i, j in ring], float)]


def _star(rng: np.random.Generator) -> list[Ring]:
    num = 2 * int(rng.integers(3, 17))
    radius_m = np.where(np.arange(num) % 2 == 0, 10.0, rng.choice([4.0, 6.0, 8.0]))
    return [radius_m[:, None] * _circle(num)]


def _regular(rng: np.random.Generator) -> list[Ring]:
    return [10.0 * _circle(int(rng.integers(4, 65)))]


def _frame(rng: np.random.Generator) -> list[Ring]:
    circle = _circle(int(rng.integers(4, 33)))
    return [10.0 * circle, rng.choice([3.0, 5.0, 7.0]) * circle[::-1]]


def _widths(rng: np.random.Generator) -> np.ndarray:
    """Four widths in metres, all equal in one of three draws."""
    return rng.integers(2, 9, 4) if rng.random() < 2 / 3 else np.full(4, rng.integers(3, 9))


def _circle(num: int) -> Ring:
    turn = 2.0 * np.pi * np.arange(num) / num
    return np.column_stack([np.cos(turn), np.sin(turn)])


SHAPES: dict[str, Callable[[np.random.Generator], list[Ring]]] = {
    "rectangle": _rectangle,
    "L": _l_shape,
    "T": _t_shape,
    "U": _u_shape,
    "H": _h_shape,
    "I": _i_shape,
    "plus": _plus,
    "star": _star,
    "regular": _regular,
    "frame": _frame,
}


@dataclass(frozen=True)
class Draws:
    """Polygons with the angle of each edge, the same polygons without noise, and per polygon the class of the draw."""

    polygons: Polygons
    exact: Polygons
    angle_deg: np.ndarray
    shape: np.ndarray
    noise_m: np.ndarray
    kind: np.ndarray


def draw(num: int, seed: int) -> Draws:
    """Draws of all classes in turn."""
    rng = np.random.default_rng(seed)
    noisy, exact, angle_deg = [], [], []
    number = np.arange(num)
    shape = np.array(list(SHAPES))[number % len(SHAPES)]
    noise_m = np.array(NOISE_M)[number // len(SHAPES) % len(NOISE_M)]
    kind = np.array(ANGLES)[number // len(SHAPES) // len(NOISE_M) % len(ANGLES)]
    for k in range(num):
        rings = SHAPES[shape[k]](rng)
        turn = rng.choice([0.0, 0.5 * np.pi, 0.25 * np.pi, rng.uniform(0.0, 2.0 * np.pi)])
        turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        move_m = rng.choice(_MOVES_M) * rng.uniform(-1.0, 1.0, 2)
        exact.append([ring @ turned + move_m for ring in rings])
        noisy.append([ring + noise_m[k] * rng.normal(size=ring.shape) for ring in exact[-1]])
        angle_deg.append(_angles(rings, kind[k], rng))
    return Draws(
        Polygons.from_rings(noisy),
        Polygons.from_rings(exact),
        np.concatenate(angle_deg),
        shape,
        noise_m,
        kind,
    )


def _angles(rings: list[Ring], kind: str, rng: np.random.Generator) -> np.ndarray:
    length_m = np.concatenate([np.hypot(*(np.roll(ring, -1, axis=0) - ring).T) for ring in rings])
    slope = rng.choice([30.0, 45.0, rng.uniform(10.0, 70.0)])
    if kind == "uniform":
        return np.full(len(length_m), slope)
    if kind == "flat":  # everywhere, or here and there
        return np.where(rng.random(len(length_m)) < rng.choice([1.0, 0.3]), 0.0, slope)
    if kind == "gabled":  # all shortest edges, or any
        is_gable = length_m < length_m.min() + 0.1 if rng.random() < 0.5 else rng.random(len(length_m)) < 0.3
        return np.where(is_gable, 90.0, slope)
    steps = rng.choice([0.0, 90.0, 30.0, 45.0, 60.0], len(length_m))
    return steps if rng.random() < 0.5 else rng.uniform(5.0, 85.0, len(length_m))


def failures(draws: Draws) -> np.ndarray:
    """Why each draw failed, or an empty text."""
    num = len(draws.polygons)
    meshes, exact = (
        build(polygons, draws.angle_deg, np.full(num, _EAVE_M)) for polygons in (draws.polygons, draws.exact)
    )
    area_m2 = _ring_areas(draws.polygons)
    reason = np.array([Status(code).reason if code else "" for code in meshes.status], dtype=object)
    for name, is_wrong in _wrong(draws, meshes, area_m2).items():
        reason[is_wrong & (reason == "")] = name
    # roofs with one angle for all edges change steadily with the footprint, other roofs may jump
    is_steady = (draws.kind == "uniform") & (reason == "") & (exact.status == 0)
    extent_m = np.sqrt(area_m2)
    change_m3 = np.abs(_volumes(meshes) - _volumes(exact))
    reason[is_steady & (change_m3 > (1000.0 * draws.noise_m + 1e-5) * extent_m**2)] = "other-volume"
    return reason


def _wrong(draws: Draws, meshes: Meshes, area_m2: np.ndarray) -> dict[str, np.ndarray]:
    """For each rule, by name, the mask of the meshes that break it."""
    num = len(meshes)
    of_triangle = np.repeat(np.arange(num), np.diff(meshes.triangle_offset))
    triangle = meshes.triangle + meshes.vertex_offset[of_triangle][:, None]
    side = np.stack([triangle, np.roll(triangle, -1, axis=1)], axis=-1).reshape(-1, 2)
    side_mesh = np.repeat(of_triangle, 3)
    code, back = side @ [len(meshes.vertex_m), 1], side @ [1, len(meshes.vertex_m)]
    values, times = np.unique(code, return_counts=True)
    is_open = ~np.isin(back, values) | (times[np.searchsorted(values, code)] != 1)

    first = draws.polygons.vertex_offset[:-1]
    local_m = meshes.vertex_m.copy()
    local_m[:, :2] -= np.repeat(draws.polygons.xy_m[first], np.diff(meshes.vertex_offset), axis=0)
    corner_m = local_m[triangle]
    normal = 0.5 * np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    is_ground, is_wall = meshes.kind == FaceKind.GROUND, meshes.kind == FaceKind.WALL
    is_top = ~is_ground & ~is_wall
    ground_m2, top_m2 = (
        np.bincount(of_triangle, np.where(which, sign * normal[:, 2], 0.0), num)
        for which, sign in ((is_ground, -1.0), (is_top, 1.0))
    )

    edge = first[of_triangle] + meshes.edge
    start_m = draws.polygons.xy_m[edge] - draws.polygons.xy_m[first[of_triangle]]
    along = draws.polygons.xy_m[draws.polygons.next_vertex[edge]] - draws.polygons.xy_m[edge]
    along /= np.hypot(*along.T)[:, None]
    from_edge_m = (corner_m[..., 1] - start_m[:, None, 1]) * along[:, None, 0]
    from_edge_m -= (corner_m[..., 0] - start_m[:, None, 0]) * along[:, None, 1]
    slope = np.radians(draws.angle_deg[edge])[:, None]
    off_m = np.where(
        is_wall[:, None],
        from_edge_m,
        from_edge_m * np.sin(slope) - (corner_m[..., 2] - _EAVE_M) * np.cos(slope),
    )
    level_m = np.ptp(corner_m[..., 2], axis=1)
    off_m = np.where((meshes.edge < 0)[:, None], level_m[:, None], off_m)
    # the area of a roof is that of its plan over the cosine of the slope
    is_roof = meshes.kind == FaceKind.ROOF
    roof_m2, expected_m2 = (
        np.bincount(of_triangle, np.where(is_roof, value, 0.0), num)
        for value in (np.linalg.norm(normal, axis=1), normal[:, 2] / np.cos(slope[:, 0]))
    )

    def any_of(which: np.ndarray, meshes_of: np.ndarray) -> np.ndarray:
        return np.bincount(meshes_of, which, num) > 0

    return {
        "open": any_of(is_open, side_mesh),
        "inside-out": any_of(
            (is_top & (normal[:, 2] <= 0.0)) | (is_ground & (normal[:, 2] >= 0.0)), of_triangle
        ),
        "ground-area": np.abs(ground_m2 - area_m2) > 1e-6 * area_m2,
        "top-area": np.abs(top_m2 - area_m2) > 1e-5 * area_m2,
        "slope": any_of((np.abs(off_m) > _PLANE_M).any(axis=1), of_triangle),
        "roof-area": np.abs(roof_m2 - expected_m2) > 1e-4 * area_m2,
        "volume": _volumes(meshes) < area_m2 * _EAVE_M * (1.0 - 1e-6),
    }


def _ring_areas(polygons: Polygons) -> np.ndarray:
    """Area of each polygon without its courtyards."""
    first = polygons.xy_m[np.repeat(polygons.vertex_offset[:-1], np.diff(polygons.vertex_offset))]
    here = polygons.xy_m - first
    after = polygons.xy_m[polygons.next_vertex] - first
    of_polygon = np.repeat(np.arange(len(polygons)), np.diff(polygons.vertex_offset))
    twice_m2 = here[:, 0] * after[:, 1] - here[:, 1] * after[:, 0]
    return 0.5 * np.bincount(of_polygon, twice_m2, len(polygons))


def _volumes(meshes: Meshes) -> np.ndarray:
    of_triangle = np.repeat(np.arange(len(meshes)), np.diff(meshes.triangle_offset))
    origin = meshes.vertex_m[np.minimum(meshes.vertex_offset[:-1], max(len(meshes.vertex_m) - 1, 0))]
    corner_m = meshes.vertex_m[meshes.triangle + meshes.vertex_offset[of_triangle][:, None]]
    a, b, c = np.moveaxis(corner_m - origin[of_triangle][:, None], 1, 0)
    return np.bincount(of_triangle, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0, len(meshes))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=100_000, help="draws")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    drawn: Counter[tuple] = Counter()
    failed: Counter[tuple] = Counter()
    reasons: Counter[str] = Counter()
    at_once = len(SHAPES) * len(NOISE_M) * len(ANGLES) * 5
    for first in range(0, options.num, at_once):
        draws = draw(min(at_once, options.num - first), options.seed * 1_000_003 + first)
        reason = failures(draws)
        classes = list(zip(draws.shape.tolist(), draws.noise_m.tolist(), draws.kind.tolist(), strict=True))
        drawn.update(classes)
        failed.update(each for each, why in zip(classes, reason, strict=True) if why)
        reasons.update(why for why in reason if why)

    figures = Figures()
    print(f"failures per thousand draws\n{'shape':<11}{'angles':<9}" + "".join(f"{n:>8.0e}" for n in NOISE_M))
    for shape in SHAPES:
        for kind in ANGLES:
            cells = [(shape, noise_m, kind) for noise_m in NOISE_M]
            shares = [1000.0 * failed[cell] / max(drawn[cell], 1) for cell in cells]
            print(
                f"{shape:<11}{kind:<9}"
                + "".join(f"{share:>8.1f}" if share else f"{'-':>8}" for share in shares)
            )
        of_shape = sum(count for cell, count in failed.items() if cell[0] == shape)
        figures.row(shape, {"failed": of_shape, "drawn": sum(n for c, n in drawn.items() if c[0] == shape)})
    print(dict(reasons.most_common()))
    figures.row("reasons", reasons)
    figures.row("draws", {"value": sum(drawn.values())})
    figures.at_most("failed", sum(failed.values()), 0)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
