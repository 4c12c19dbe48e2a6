"""There is no building over open ground within a footprint, or a floor where the building would fall apart."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from p2wss.config import Reconstruct
from p2wss.data.building import Building, Reconstruction
from p2wss.fit import fitting
from p2wss.fit.fitting import with_floors
from p2wss.mesh import Mesh
from p2wss.skeleton.types import FaceKind

CONFIG = Reconstruct()
FOOTPRINT = np.array([[0, 0], [20, 0], [20, 8], [0, 8.0]])
GROUND, BUILDING = 2, 6


def level(low: tuple[float, float], high: tuple[float, float], z_m: float, seed: int) -> np.ndarray:
    """Four points per m² of a level rectangle, with noise of 2 cm."""
    rng = np.random.default_rng(seed)
    num = int(4 * (high[0] - low[0]) * (high[1] - low[1]))
    return np.column_stack([rng.uniform(low, high, (num, 2)), z_m + 0.02 * rng.standard_normal(num)])


def fitted(*surfaces: tuple[np.ndarray, int]) -> Reconstruction:
    """The building on ground at 100 m whose points are ``surfaces`` with their classes."""
    point_m = np.vstack([point_m for point_m, _ in surfaces])
    classes = np.concatenate([np.full(len(point_m), number, np.uint8) for point_m, number in surfaces])
    building = Building("b", "t", (1000.0, 2000.0), [FOOTPRINT], point_m, classes, 100.0)
    (reconstruction,) = fitting.fit([building], CONFIG)
    assert reconstruction.mesh.is_closed
    return reconstruction


def area_and_height_m(reconstruction: Reconstruction, kind: FaceKind) -> tuple[float, float]:
    """(area in plan, mean height) of the faces of a kind."""
    corner = reconstruction.mesh.vertex_m[reconstruction.mesh.triangle[reconstruction.mesh.kind == kind]]
    area_m2 = shapely.area(np.asarray(shapely.polygons(corner[:, :, :2])))
    return float(area_m2.sum()), float(corner[:, :, 2].mean())


@pytest.mark.parametrize("yard_m", [1.4, 0.2, -0.4])
def test_a_yard_is_outside_the_building(yard_m: float) -> None:
    """The yard is larger than the house, and does not determine the height of its eaves."""
    house, yard = level((0, 0), (8, 8), 5.0, 0), level((8, 0), (20, 8), yard_m, 1)
    reconstruction = fitted((house, BUILDING), (yard, GROUND))
    mesh = reconstruction.mesh
    assert not (mesh.kind == FaceKind.FLOOR).any() and len(mesh.triangle) == 12
    for kind, z_m in ((FaceKind.FLAT, 5.0), (FaceKind.GROUND, 0.0)):
        area_m2, height_m = area_and_height_m(reconstruction, kind)
        assert area_m2 == pytest.approx(64, abs=4) and height_m == pytest.approx(z_m, abs=0.03)
    assert mesh.vertex_m[:, 0].max() == pytest.approx(8, abs=0.3)
    assert reconstruction.eave_height_m == pytest.approx(5.0, abs=0.03)
    assert reconstruction.status == "ok" and reconstruction.num_parts == 1


def test_a_patio_in_the_middle_is_a_hole() -> None:
    around = level((0, 0), (20, 8), 4.0, 0)
    is_patio = (np.abs(around[:, :2] - [10, 4]) < [3, 2]).all(axis=1)
    patio = level((7, 2), (13, 6), 0.2, 1)
    reconstruction = fitted((around[~is_patio], BUILDING), (patio, GROUND))
    for kind in (FaceKind.FLAT, FaceKind.GROUND):
        assert area_and_height_m(reconstruction, kind)[0] == pytest.approx(160 - 24, abs=5)


@pytest.mark.parametrize("yard_m", [1.4, 0.2])
def test_a_yard_between_two_houses_has_a_floor(yard_m: float) -> None:
    """A solid is in one piece."""
    houses = level((0, 0), (6, 8), 5.0, 0), level((14, 0), (20, 8), 5.0, 2)
    reconstruction = fitted((np.vstack(houses), BUILDING), (level((6, 0), (14, 8), yard_m, 1), GROUND))
    area_m2, height_m = area_and_height_m(reconstruction, FaceKind.FLOOR)
    assert area_m2 == pytest.approx(64, abs=4) and height_m == pytest.approx(max(yard_m, 1.0), abs=0.03)
    assert area_and_height_m(reconstruction, FaceKind.FLAT)[0] == pytest.approx(96, abs=4)


@pytest.mark.parametrize("low_m", [0.4, 1.5])
def test_a_low_annex_has_a_roof_of_at_least_the_minimum(low_m: float) -> None:
    house, annex = level((0, 0), (12, 8), 5.0, 0), level((12, 0), (20, 8), low_m, 1)
    reconstruction = fitted((house, BUILDING), (annex, BUILDING), (level((14, 2), (16, 4), 0.0, 2), GROUND))
    assert set(reconstruction.mesh.kind.tolist()) == {FaceKind.GROUND, FaceKind.WALL, FaceKind.FLAT}
    flat = reconstruction.mesh.vertex_m[
        reconstruction.mesh.triangle[reconstruction.mesh.kind == FaceKind.FLAT], 2
    ]
    assert flat.min() == pytest.approx(max(low_m, CONFIG.min_eave_height_m), abs=0.05)


def test_high_ground_is_a_roof() -> None:
    """Points on a terrace above the street may have the class of the ground."""
    house, terrace = level((0, 0), (12, 8), 5.0, 0), level((12, 0), (20, 8), 2.5, 1)
    reconstruction = fitted((house, BUILDING), (terrace, GROUND))
    assert not (reconstruction.mesh.kind == FaceKind.FLOOR).any()
    assert area_and_height_m(reconstruction, FaceKind.FLAT)[0] == pytest.approx(160)


def test_a_building_keeps_a_roof() -> None:
    """A mesh whose only upper face is over open ground is of a building that the cloud does not show."""
    vertex_m = np.array([[0, 0, 0.5], [4, 0, 0.5], [4, 4, 0.5], [0, 4, 0.5], [8, 0, 5], [8, 4, 5.0]])
    triangle, label = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5]]), np.array([0, 0, 1])
    kind = np.array([FaceKind.FLAT, FaceKind.FLAT, FaceKind.ROOF], np.uint8)
    over_m = np.array([[3, 1, 0.4]])
    mesh = Mesh(vertex_m, triangle, kind, label)
    with_floor = with_floors(mesh, over_m, 1).kind
    assert (
        with_floor.tolist() == [FaceKind.FLOOR, FaceKind.FLOOR, FaceKind.ROOF]
        and with_floor.dtype == np.uint8
    )
    only = with_floors(mesh.part(np.arange(2)), over_m, 1)
    assert only.kind.tolist() == [FaceKind.FLAT, FaceKind.FLAT]
