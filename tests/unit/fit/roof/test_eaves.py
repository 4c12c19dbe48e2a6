"""Eaves at different heights: a ridge that is not in the middle takes one part, and its solid ends at the walls."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from p2wss.config import Reconstruct
from p2wss.data.building import Building
from p2wss.fit import fitting
from p2wss.fit.mesh.union import is_sound, union
from p2wss.fit.parts.partition import fit_parts
from p2wss.fit.roof.eaves import moved_walls
from p2wss.fit.roof.fitter import FittedRoof, Fitter, flat_rings
from p2wss.fit.settings import Cutting, Effort, Limits

HOUSE = np.array([[0, 0], [12, 0], [12, 9], [0, 9.0]])
L_SHAPE = np.array([[0, 0], [12, 0], [12, 5], [6, 5], [6, 10], [0, 10.0]])
COURTYARD = np.array([[2, 2], [2, 3], [3, 3], [3, 2.0]])
SLOPE = np.tan(np.radians(40))


def catslide(xy_m: np.ndarray, ridge_m: float = 3.5) -> np.ndarray:
    """Heights of a gable roof of 40 degrees whose ridge runs along x at y = ``ridge_m``, 9 m high."""
    return 9.0 - SLOPE * np.abs(xy_m[:, 1] - ridge_m)


def points(ridge_m: float = 3.5, num: int = 600) -> np.ndarray:
    rng = np.random.default_rng(0)
    xy_m = rng.uniform((0, 0), (12, 9), (num, 2))
    return np.column_stack([xy_m, catslide(xy_m, ridge_m) + 0.02 * rng.standard_normal(num)])


def test_a_ridge_beside_the_middle_takes_one_part_with_two_eave_heights() -> None:
    (part,) = fit_parts(Fitter(Limits()), [HOUSE], points(), Effort(), Cutting())
    assert part.outward_m is not None
    assert part.angle_deg == pytest.approx([40, 90, 40, 90], abs=1)
    assert part.eave_z_m == pytest.approx(9 - 5.5 * SLOPE, abs=0.1)
    # the eave at y = 0 is 2 m · tan 40° higher
    assert part.outward_m == pytest.approx([2, 0, 0, 0], abs=0.15)
    assert part.loss_m < 0.03


def test_eaves_at_one_height_stay_so() -> None:
    (part,) = fit_parts(Fitter(Limits()), [HOUSE], points(ridge_m=4.5), Effort(), Cutting())
    assert part.outward_m is None and part.loss_m < 0.03


def test_the_model_of_the_paper_has_one_eave_height() -> None:
    (part,) = fit_parts(Fitter(Limits()), [HOUSE], points(), Effort(), Cutting(max_parts=1))
    assert part.outward_m is None


def test_the_solid_ends_at_the_walls_and_has_the_roof_of_the_points() -> None:
    building = Building("b", "t", (0.0, 0.0), [HOUSE], points(), np.full(600, 6, np.uint8), 0.0)
    (result,) = fitting.fit([building], Reconstruct())
    assert result.num_parts == 1 and result.mesh.is_closed
    assert result.mesh.vertex_m[:, :2].min(axis=0) == pytest.approx([0, 0], abs=1e-6)
    assert result.mesh.vertex_m[:, :2].max(axis=0) == pytest.approx([12, 9], abs=1e-6)
    high = result.mesh.vertex_m[result.mesh.vertex_m[:, 2] > 0.1]
    assert high[:, 2] == pytest.approx(catslide(high[:, :2]), abs=0.1)
    # a gable roof over a rectangle: 10 vertices
    assert len(result.mesh.triangle) == 16
    # the lowest eave
    assert result.eave_height_m == pytest.approx(9 - 5.5 * SLOPE, abs=0.1)


def test_the_height_over_a_point_is_that_of_the_solid() -> None:
    (part,) = fit_parts(Fitter(Limits()), [HOUSE], points(), Effort(), Cutting())
    mesh = union([part], 1.0, 12.0)
    assert mesh is not None and is_sound(mesh)
    xy_m = np.array([[1.0, 0.5], [6.0, 3.5], [11.0, 8.5]])
    height, _ = Fitter(Limits()).roof_over(part, np.column_stack([xy_m, np.zeros(3)]))
    assert height == pytest.approx(catslide(xy_m), abs=0.1)
    # slopes begin outside the walls, but the roof ends there
    outside = np.array([[6.0, -0.5, 0.0]])
    assert Fitter(Limits()).roof_over(part, outside)[0][0] == -np.inf
    top = mesh.vertex_m[:, 2].max()
    assert Fitter(Limits()).roof_over(part, np.array([[6.0, 3.5, 0]]))[0][0] == pytest.approx(top, abs=0.1)


def test_walls_move_outwards_by_what_is_asked() -> None:
    polygon = flat_rings([L_SHAPE, COURTYARD])
    xy_m = polygon.xy_m
    outward_m = np.array([0.5, 0, 0.25, 1, 0, 2, 0.1, 0, 0, 0.2])
    moved = moved_walls(polygon, outward_m)
    for first, last in ((0, 6), (6, 10)):
        ring, new = xy_m[first:last], moved[first:last]
        along = np.roll(ring, -1, axis=0) - ring
        along /= np.linalg.norm(along, axis=1)[:, None]
        outwards = np.column_stack([along[:, 1], -along[:, 0]])
        for end in (new, np.roll(new, -1, axis=0)):
            assert ((end - ring) * outwards).sum(axis=1) == pytest.approx(outward_m[first:last], abs=1e-12)
    bigger = shapely.Polygon(moved[:6]).difference(shapely.Polygon(L_SHAPE)).area
    assert bigger > 0 and shapely.Polygon(moved[:6]).contains(shapely.Polygon(L_SHAPE))


def test_slope_rings_are_the_rings_of_a_roof_with_level_eaves() -> None:
    roof = FittedRoof([HOUSE], np.array([40, 90, 40, 90.0]), 5.0, 0.0, 1)
    assert roof.slope_rings is roof.rings
