"""Buildings fitted to points: which of several candidates is the result, and that every mesh is closed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from toy_roofs import bent_ridge

from p2wss.config import Reconstruct
from p2wss.data.building import Building, Reconstruction
from p2wss.fit import fitting
from p2wss.fit.parametric import build_meshes
from p2wss.fit.settings import THRESHOLDS
from p2wss.reconstruction.product import with_fallback
from p2wss.skeleton import Polygons
from p2wss.skeleton import roof_points as roof

HOUSE = np.array([[0, 0], [9, 0], [9, 8], [0, 8.0]])
ANNEX = np.array([[9, 0], [13, 0], [13, 8], [9, 8.0]])
BOTH = np.array([[0, 0], [13, 0], [13, 8], [0, 8.0]])
GABLE = np.array([40, 90, 40, 90.0])
CONFIG = Reconstruct()


def on_roof(ring: np.ndarray, angle_deg: np.ndarray, eave_m: float, num_points: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(ring.min(axis=0) + 0.01, ring.max(axis=0) - 0.01, (num_points, 2))
    z = roof(Polygons.from_rings([[ring]]), angle_deg, eave_m, xy, np.zeros(num_points, int)).z_m
    return np.column_stack([xy, z + 0.02 * rng.standard_normal(num_points)])


def building(point_m: np.ndarray) -> Building:
    """In a frame at an angle to the axes, on ground at 100 m."""
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    point_m = np.column_stack([point_m[:, :2] @ turn, point_m[:, 2]])
    classes = np.full(len(point_m), 6, np.uint8)
    return Building("b", "t", (1000.0, 2000.0), [BOTH @ turn], point_m, classes, 100.0)


def one_gable(num_points: int = 300) -> Building:
    return building(on_roof(BOTH, GABLE, 6.0, num_points, 0))


def house_and_annex(num_points: int = 600) -> Building:
    house = on_roof(HOUSE, np.array([90, 40, 90, 40.0]), 6.0, num_points * 2 // 3, 0)
    return building(np.vstack([house, on_roof(ANNEX, np.zeros(4), 3.0, num_points // 3, 1)]))


def network(case: Building, angle_deg: np.ndarray, eave_height_m: float) -> Reconstruction:
    (reconstruction,) = build_meshes(
        [case], [case.rings], np.array([eave_height_m]), [angle_deg], "network",
        CONFIG, [""],
    )  # fmt: skip
    return reconstruction


@pytest.mark.parametrize(("drop_m", "num_parts"), [(0.02, 1), (0.4, 2)])
def test_the_height_of_the_ground_does_not_decide_whether_a_step_stays(drop_m, num_parts) -> None:
    """The case lies at 100 m. A step of a few centimetres is noise."""
    house = on_roof(HOUSE, np.zeros(4), 6.0, 400, 0)
    annex = on_roof(ANNEX, np.zeros(4), 6.0 - drop_m, 200, 1)
    case = building(np.vstack([house, annex]))
    (reconstruction,) = fitting.fit([case], CONFIG)
    assert reconstruction.num_parts == num_parts
    top_m = np.unique(reconstruction.mesh.vertex_m[reconstruction.mesh.vertex_m[:, 2] > 1, 2].round(2))
    assert top_m == pytest.approx([6.0 - drop_m, 6.0][2 - num_parts :], abs=0.02)


def test_few_points_and_the_model_of_the_paper_give_parametric_buildings():
    case = house_and_annex()
    (planes,) = fitting.fit([case], CONFIG)
    assert planes.num_parts == 2
    few = replace(case, point_m=case.point_m[::160], classification=case.classification[::160])
    any_number = CONFIG.model_copy(update={"min_num_points": 3})
    parametric = CONFIG.model_copy(update={"roofs": "parametric"})
    for chosen, config in ((few, any_number), (case, parametric)):
        (reconstruction,) = fitting.fit([chosen], config)
        assert reconstruction.num_parts == 1 and reconstruction.mesh.is_closed
        kernel_m = network(chosen, reconstruction.angle_deg, reconstruction.eave_height_m).mesh.vertex_m
        np.testing.assert_allclose(np.sort(reconstruction.mesh.vertex_m[:, 2]), np.sort(kernel_m[:, 2]))


def test_of_a_house_with_two_points_on_each_roof_the_row_shows_the_rest():
    whole = house_and_annex()
    # two on the annex, and two on each slope; with one, a building of the paper goes through all of them
    height_m = whole.point_m[:, 2]
    rows = [*np.flatnonzero(height_m < 4)[:2], *np.flatnonzero(np.abs(height_m - 8) < 0.3)[[1, 2, -3, -2]]]
    few = replace(whole, point_m=whole.point_m[rows], classification=whole.classification[rows])
    # the row goes on at both sides
    side_m = np.append(whole.rings[0][2] - whole.rings[0][1], 0.0)
    around_m = np.vstack([whole.point_m[::9] + side_m, whole.point_m[::9] - side_m])
    config = CONFIG.model_copy(update={"min_num_points": 3})
    (alone,) = fitting.fit([few], config)
    (in_row,) = fitting.fit([replace(few, around_m=around_m)], config)
    ridge_m = 6.0 + 4.5 * np.tan(np.radians(40))
    assert in_row.mesh.is_closed
    assert in_row.mesh.vertex_m[:, 2].max() == pytest.approx(ridge_m, abs=0.2)
    assert abs(alone.mesh.vertex_m[:, 2].max() - ridge_m) > 0.5


def test_without_a_closed_solid_of_planes_the_building_is_parametric(monkeypatch):
    case = house_and_annex()
    monkeypatch.setattr("p2wss.fit.planes.fit.solid_below", lambda *_: None)
    (reconstruction,) = fitting.fit([case], CONFIG)
    assert reconstruction.has_mesh and reconstruction.num_parts == 1 and reconstruction.mesh.is_closed


def test_a_building_is_the_same_whatever_is_fitted_beside_it():
    cases = [one_gable(), house_and_annex(), building(np.zeros((0, 3))), one_gable(40), house_and_annex(30)]
    together = fitting.fit(cases[::-1], CONFIG)[::-1]
    for case, reconstruction in zip(cases, together, strict=True):
        (alone,) = fitting.fit([case], CONFIG)
        assert alone.has_mesh == reconstruction.has_mesh
        if not alone.has_mesh:
            continue
        assert (alone.status, alone.num_parts, alone.eave_height_m) == (
            reconstruction.status, reconstruction.num_parts, reconstruction.eave_height_m,
        )  # fmt: skip
        assert np.array_equal(alone.mesh.vertex_m, reconstruction.mesh.vertex_m)
        assert np.array_equal(alone.mesh.triangle, reconstruction.mesh.triangle)


@pytest.mark.parametrize("num_points", [1, 2, 3, 5, 9, 10, 12, 20, 40, 80, 300])
def test_every_number_of_points_gives_a_closed_solid(num_points):
    whole = house_and_annex()
    chosen = np.random.default_rng(num_points).choice(len(whole.point_m), num_points, replace=False)
    case = replace(whole, point_m=whole.point_m[chosen], classification=whole.classification[chosen])
    (reconstruction,) = with_fallback(fitting.fit([case], CONFIG), [case], CONFIG)
    assert reconstruction.has_mesh and reconstruction.mesh.is_closed
    z = reconstruction.mesh.vertex_m[:, 2]
    assert z.min() == 0 and 2.5 < z.max() < 12
    ground = shapely.convex_hull(shapely.multipoints(reconstruction.mesh.vertex_m[z == 0][:, :2]))
    assert ground.area == pytest.approx(13 * 8, rel=1e-3)


def test_no_vertex_is_left_within_a_ridge_where_a_step_went():
    task = SimpleNamespace(thresholds=THRESHOLDS)
    mesh = fitting.remove_short_edges(task, bent_ridge(np.array([[0, 0], [12, 0], [12, 8], [0, 8.0]])))
    assert mesh.is_closed and mesh.num_planes_at.min() == 3 and len(mesh.vertex_m) == 10


def test_detail_is_the_price_of_a_face():
    """A strip of 1.3 m that is 25 cm lower: enough in detail, too little without."""
    noise_m = 0.02 * np.random.default_rng(1).standard_normal(900)
    xy_m = np.random.default_rng(2).uniform((0, 0), (13, 8), (900, 2))
    case = building(np.column_stack([xy_m, 6.0 + noise_m - 0.25 * (xy_m[:, 0] > 11.7)]))
    num_parts = []
    for detail in ("low", "high"):
        (reconstruction,) = fitting.fit([case], CONFIG.model_copy(update={"detail": detail}))
        num_parts.append(reconstruction.num_parts)
    assert num_parts == [1, 2]
