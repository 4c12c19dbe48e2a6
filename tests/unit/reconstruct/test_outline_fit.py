"""The outline that the network read, fitted to the points of the building."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from p2wss.reconstruct.outline_fit import fit_outline

EAVE_M = 5.0
# L-shaped, its first vertex the uppermost
L_SHAPE = np.array([[-3.0, 7.0], [-3.0, -6.0], [7.0, -6.0], [7.0, 0.0], [2.0, 0.0], [2.0, 7.0]])
# beyond the edge with x = -3 a house of the same height goes on
NEIGHBOUR = shapely.box(-20, -20, -3, 20)


def turned(xy_m: np.ndarray, deg: float) -> np.ndarray:
    cosine, sine = np.cos(np.deg2rad(deg)), np.sin(np.deg2rad(deg))
    result: np.ndarray = xy_m @ np.array([[cosine, sine], [-sine, cosine]])
    return result


def cloud(
    ring: np.ndarray, buffer_m: float = 1.0, neighbour: shapely.Polygon | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Points and their classes: 10 per m2 on a flat roof and on the ground around it, with 2 cm of noise."""
    rng = np.random.default_rng(5)
    polygon = shapely.Polygon(ring)
    area = polygon.buffer(buffer_m)
    low, high = np.array(area.bounds).reshape(2, 2)
    xy = rng.uniform(low, high, (int(10 * (high - low).prod()), 2))
    xy = xy[shapely.contains_xy(area, *xy.T)]
    roof = polygon if neighbour is None else polygon.union(neighbour)
    is_roof = shapely.contains_xy(roof, *xy.T)
    z = np.where(is_roof, EAVE_M, 0.0) + rng.normal(0, 0.02, len(xy))
    point = np.column_stack([xy + rng.normal(0, 0.02, xy.shape), z])
    return point, np.where(is_roof, 6, 2).astype(np.uint8)


@pytest.mark.parametrize("deg", [0, 17])
@pytest.mark.parametrize("buffer_m", [1.0, 4.0])
def test_a_misread_outline_is_fitted_in_the_order_of_its_vertices(deg: float, buffer_m: float) -> None:
    truth = turned(L_SHAPE, deg)
    reading = truth + np.random.default_rng(3).uniform(-1.2, 1.2, truth.shape)
    # the signs are part of what the network is given
    point, classification = cloud(truth, buffer_m)
    centre = point[:, :2].mean(axis=0)
    reading = centre + np.sign(truth - centre) * np.abs(reading - centre)
    assert np.abs(reading - truth).mean() > 0.4
    fitted = fit_outline(reading, EAVE_M, point, classification)
    assert np.abs(fitted - truth).max() < 0.2


def test_a_wall_shared_with_a_neighbour_stays_where_it_was_read() -> None:
    point, classification = cloud(L_SHAPE, 1.0, NEIGHBOUR)
    assert (classification[point[:, 0] < -3.1] == 6).all()  # the points of the building go on
    reading = L_SHAPE + np.array([0.2, -0.4])
    fitted = fit_outline(reading, EAVE_M, point, classification)
    assert fitted[:2, 0] == pytest.approx(reading[:2, 0], abs=0.15)
    assert np.abs(fitted - L_SHAPE)[:, 1].max() < 0.2 and np.abs(fitted - L_SHAPE)[2:, 0].max() < 0.2


def test_an_edge_out_of_square_is_turned() -> None:
    ring = np.array([[-5.0, 4.0], [-5.0, -4.0], [5.0, -4.0], [5.0, 3.2]])
    fitted = fit_outline(ring + np.array([0.3, 0.2]), EAVE_M, *cloud(ring))
    assert np.abs(fitted - ring).max() < 0.2


def test_without_points_the_reading_remains() -> None:
    point, classification = cloud(L_SHAPE)
    few = slice(0, 10)
    np.testing.assert_array_equal(
        fit_outline(L_SHAPE + 0.5, EAVE_M, point[few], classification[few]), L_SHAPE + 0.5
    )
