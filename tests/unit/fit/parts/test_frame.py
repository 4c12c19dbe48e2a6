"""The frame of the cuts follows the roof where the footprint's edges do not."""

import numpy as np
import pytest
import shapely

from p2wss.config import Reconstruct
from p2wss.data.building import Building
from p2wss.fit import fitting
from p2wss.fit.mesh.union import union
from p2wss.fit.parts.frame import roof_frame
from p2wss.fit.parts.parts import main_frame
from p2wss.fit.roof.fitter import FittedRoof
from p2wss.mesh.surface import distance_to_mesh

# a square out of a larger building, as the border of a map cuts it
SQUARE = np.array([[0, 0], [12, 0], [12, 12], [0, 12.0]])
TURN_DEG = 40.0


def survey(turn_deg: float, noise_m: float = 0.02) -> np.ndarray:
    """Points on a gable roof whose ridge runs through the middle of the square, with a step of 3 m across it."""
    rng = np.random.default_rng(3)
    xy_m = rng.uniform(0, 12, (1800, 2))
    turn = np.radians(turn_deg)
    along = (xy_m - 6) @ [np.cos(turn), np.sin(turn)]
    across = (xy_m - 6) @ [-np.sin(turn), np.cos(turn)]
    z = 10 - 0.6 * np.abs(across) - 3.0 * (along > 2)
    return np.column_stack([xy_m, z + noise_m * rng.standard_normal(len(z))])


def direction_deg(frame: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(frame[1, 0], frame[0, 0])) % 90)


def test_the_frame_follows_the_slopes() -> None:
    assert direction_deg(roof_frame([SQUARE], survey(TURN_DEG))) == pytest.approx(TURN_DEG, abs=1.0)


@pytest.mark.parametrize("turn_deg, noise_m", [(0.0, 0.02), (3.0, 0.02), (TURN_DEG, 0.3)])
def test_the_frame_stays_that_of_the_walls_where_roofs_do_not_show_another(turn_deg, noise_m) -> None:
    assert np.array_equal(roof_frame([SQUARE], survey(turn_deg, noise_m)), main_frame([SQUARE]))


def test_the_frame_is_that_of_a_wall_nearby() -> None:
    """The direction that points show is uncertain by a degree; that of a wall is not."""
    corner = np.array([[0, 0], [12, 0], [12, 12], [4, 12], [0, 12 - 4 * np.tan(np.radians(TURN_DEG + 2))]])
    frame = roof_frame([corner], survey(TURN_DEG))
    assert direction_deg(frame) == pytest.approx(TURN_DEG + 2, abs=1e-9)


def block() -> Building:
    point_m = survey(TURN_DEG)
    ground_m = np.column_stack([np.random.default_rng(0).uniform(-2, -1, (50, 2)), np.zeros(50)])
    classes = np.repeat([6, 2], [len(point_m), 50]).astype(np.uint8)
    return Building("a", "tile", (0.0, 0.0), [SQUARE], np.vstack([point_m, ground_m]), classes, 0.0)


def test_a_roof_across_the_footprint_is_fitted_with_few_parts() -> None:
    (reconstruction,) = fitting.fit([block()], Reconstruct())
    assert reconstruction.num_parts <= 3
    assert len(reconstruction.angle_deg) == sum(map(len, reconstruction.rings)) == len(SQUARE)
    assert reconstruction.mesh.is_closed
    mesh = reconstruction.mesh
    assert distance_to_mesh(survey(TURN_DEG), mesh.vertex_m, mesh.triangle).mean() < 0.06


def test_without_a_closed_union_the_roof_begins_at_the_footprint(monkeypatch) -> None:
    monkeypatch.setattr(fitting, "union", lambda *_: None)
    (reconstruction,) = fitting.fit([block()], Reconstruct())
    assert reconstruction.has_mesh and reconstruction.num_parts == 1


def test_parts_that_reach_beyond_the_footprint_end_there() -> None:
    """A gable roof over a rectangle, cut off by a triangle, one of whose corners lies below the eaves' height."""
    rectangle = np.array([[0, 0], [10, 0], [10, 10], [0, 10.0]])
    roof = FittedRoof([rectangle], np.array([40.0, 90, 40, 90]), -2.0, 0.0, 100)
    triangle = np.array([[0.5, 5.0], [8, 2.5], [7, 9.0]])
    mesh = union([roof], 1.0, 12.0, outline=[triangle])
    assert mesh is not None and mesh.is_closed
    assert shapely.Polygon(triangle).buffer(1e-6).covers(shapely.MultiPoint(mesh.vertex_m[:, :2]))
    assert mesh.vertex_m[:, 2].min() == pytest.approx(0, abs=1e-9)
    _, y, z = mesh.vertex_m[mesh.vertex_m[:, 2] > 0.5].T
    roof_z = np.maximum(-2 + np.tan(np.radians(40)) * np.minimum(y, 10 - y), 1.0)
    assert z == pytest.approx(roof_z, abs=1e-6) and z.max() > 2
