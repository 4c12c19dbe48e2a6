"""The lower envelope of the slopes over a convex polygon gives the same loss as the roof of the kernel."""

import numpy as np
import pytest
import shapely

from p2wss.fit.points import even_order
from p2wss.fit.roof.fitter import FittedRoof, Fitter
from p2wss.fit.settings import Limits
from p2wss.skeleton import Polygons
from p2wss.skeleton import roof_points as roof


def loss_by_kernel(ring: np.ndarray, angle_deg: np.ndarray, top_m: float, point_m: np.ndarray) -> float:
    exact = roof(
        Polygons.from_rings([[ring]]), angle_deg, 5.0, point_m[:, :2], np.zeros(len(point_m), int),
        max_roof_height_m=top_m,
    )  # fmt: skip
    cosine = np.where(exact.edge >= 0, np.cos(np.radians(angle_deg[exact.edge])), 1.0)
    return float(np.minimum(np.abs(exact.z_m - point_m[:, 2]) * cosine, 1.0).mean())


def convex_ring(rng: np.random.Generator) -> np.ndarray:
    while True:
        hull = shapely.convex_hull(shapely.multipoints(rng.uniform(0, 14, (rng.integers(3, 12), 2))))
        ring = shapely.get_coordinates(shapely.orient_polygons(hull, exterior_cw=False))[:-1]
        if np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).min() > 0.3:
            return ring


@pytest.mark.parametrize("seed", range(60))
def test_the_loss_over_a_convex_polygon_is_that_of_its_skeleton(seed):
    rng = np.random.default_rng(seed)
    ring = convex_ring(rng)
    if seed % 3 == 0:
        ring = np.array([[0, 0], [9, 0], [9, 5.5], [4, 5.5], [0, 5.5]])  # a straight corner
    n = len(ring)
    angle_deg = rng.uniform(5, 75, n)
    kind = rng.random(n)
    angle_deg[kind < 0.3] = 90.0
    if seed % 5 == 0:
        angle_deg[kind > 0.8] = 0.0
    top_m = float(rng.choice([12.0, 1.0, 3.0]))
    polygon = shapely.Polygon(ring)
    xy = rng.uniform(ring.min(axis=0), ring.max(axis=0), (300, 2))
    xy = xy[shapely.contains_xy(polygon.buffer(-1e-6), xy[:, 0], xy[:, 1])]
    point_m = np.column_stack([xy, rng.uniform(5, 11, len(xy))])
    fitted = FittedRoof([ring], angle_deg, 5.0, 0.0)
    assert Fitter(Limits(max_roof_height_m=top_m)).loss(fitted, point_m) == pytest.approx(
        loss_by_kernel(ring, angle_deg, top_m, point_m), abs=1e-9
    )


def test_points_outside_count_in_full():
    ring = np.array([[0, 0], [9, 0], [9, 5], [0, 5.0]])
    point_m = np.array([[4, 2.5, 5.0], [-0.1, 2, 5.0], [4, 5.2, 5.0], [8.9, 2, 5.25]])
    flat = FittedRoof([ring], np.zeros(4), 5.0, 0.0)
    assert Fitter(Limits()).loss(flat, point_m) == pytest.approx((0 + 1 + 1 + 0.25) / 4)


def test_the_order_of_points_in_the_file_does_not_matter():
    rng = np.random.default_rng(0)
    point_m = np.round(rng.uniform(0, 3, (200, 3)), 1)
    point_m[50:100, 0] = point_m[:50, 0]
    shuffled = rng.permutation(point_m)
    assert np.array_equal(point_m[even_order(point_m)], shuffled[even_order(shuffled)])
