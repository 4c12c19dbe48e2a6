"""Footprints of simulated crops that lie wrong."""

import numpy as np
import pytest
import shapely

from p2wss.config import Crops
from p2wss.crops.footprint_errors import with_errors
from p2wss.data import polygon_arrays

ROW = [shapely.box(8 * k, 0, 8 * k + 8, 10) for k in range(3)]
APART = [shapely.box(40 + 20 * k, 0, 50 + 20 * k, 9) for k in range(200)]
NAMES = [f"b{k}" for k in range(len(ROW) + len(APART))]
POLYGONS = polygon_arrays.to_polygons([*ROW, *APART])


def moved(error_m, seed=0):
    result = with_errors(POLYGONS, NAMES, error_m, seed)
    assert np.array_equal(result.ring_offset, POLYGONS.ring_offset)
    return result.xy_m - POLYGONS.xy_m


def test_the_default_changes_nothing():
    assert Crops().footprint_error_m == (0, 0)
    assert with_errors(POLYGONS, NAMES, (0.0, 0.0), 0) is POLYGONS


def test_a_block_shifts_as_one_and_others_otherwise():
    shift = moved((1.0, 0.0))
    assert np.ptp(shift[:12], axis=0) == pytest.approx([0, 0], abs=1e-9)
    of_block = shift[12:].reshape(200, 4, 2)
    assert np.abs(np.ptp(of_block, axis=1)).max() < 1e-9
    assert of_block[:, 0].std(axis=0) == pytest.approx([1, 1], abs=0.15)
    assert not np.allclose(moved((1.0, 0.0), seed=1), shift)


def test_a_shared_vertex_moves_alike():
    noise = moved((0.0, 0.2))
    assert noise.std() == pytest.approx(0.2, abs=0.02)
    _, first, node = np.unique(np.round(POLYGONS.xy_m, 3), axis=0, return_index=True, return_inverse=True)
    assert np.allclose(noise, noise[first[node.ravel()]])
    assert len(first) < len(noise)


def test_a_block_moves_alike_with_other_footprints_around_it():
    """In the scene of the next tile the same errors are drawn."""
    part = with_errors(polygon_arrays.take(POLYGONS, np.arange(50)), NAMES[:50], (1.0, 0.2), 0)
    assert np.array_equal(part.xy_m, with_errors(POLYGONS, NAMES, (1.0, 0.2), 0).xy_m[: len(part.xy_m)])


def test_a_footprint_that_would_cross_itself_only_shifts():
    thin = polygon_arrays.to_polygons([shapely.box(k * 10, 0, k * 10 + 5, 0.2) for k in range(50)])
    names = [str(k) for k in range(50)]
    result = with_errors(thin, names, (1.0, 0.5), 0)
    assert shapely.is_valid(polygon_arrays.to_geometries(result)).all()
    spread = np.ptp((result.xy_m - thin.xy_m).reshape(50, 4, 2), axis=1).max(axis=1)
    assert 0 < (spread < 1e-9).sum() < 50
