"""The stated confidence of fitted buildings: monotone in the evidence of the points, and about right on average."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from p2wss.config import Reconstruct
from p2wss.data.building import Building
from p2wss.fit import fitting
from p2wss.fit.roof import confidence
from p2wss.fit.roof.evidence import Evidence, roof_evidence
from p2wss.fit.roof.fitter import FittedRoof, Fitter
from p2wss.fit.settings import Limits
from p2wss.skeleton import Polygons
from p2wss.skeleton import roof_points as roof

HOUSE = np.array([[0, 0], [12, 0], [12, 8], [0, 8.0]])
ELL = np.array([[0, 0], [14, 0], [14, 6], [6, 6], [6, 12], [0, 12.0]])
GABLE = np.array([40, 90, 40, 90.0])
CONFIG = Reconstruct(roofs="parametric")
EAVE_M = 5.0


def on_roof(ring, angle_deg, num_points, seed, noise_m=0.03):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(ring.min(axis=0), ring.max(axis=0), (8 * num_points + 50, 2))
    xy = xy[shapely.contains_xy(shapely.Polygon(ring), xy[:, 0], xy[:, 1])][:num_points]
    z = roof(
        Polygons.from_rings([[ring]]), np.asarray(angle_deg, float), EAVE_M, xy, np.zeros(len(xy), int)
    ).z_m
    return np.column_stack([xy, z + noise_m * rng.standard_normal(len(xy))])


def share(point_m, angle_deg=GABLE, eave_m=EAVE_M, ring=HOUSE, probability=None):
    roof_fit = FittedRoof([ring], np.asarray(angle_deg, float), eave_m, 0.0)
    return confidence.share(roof_evidence(Fitter(Limits()), roof_fit, point_m, probability))


def test_more_points_make_it_higher():
    point_m = on_roof(HOUSE, GABLE, 600, 0)
    shares = [share(point_m[:count]) for count in (0, 1, 3, 10, 30, 100, 600)]
    assert (np.diff(shares) > 0).all()
    assert shares[0] < 0.3 and shares[-1] > 0.95


def test_larger_residuals_make_it_lower():
    clean = on_roof(HOUSE, GABLE, 100, 0, noise_m=0.0)
    noise = np.random.default_rng(1).standard_normal(len(clean))
    noisy = [
        share(clean + np.column_stack([0 * noise, 0 * noise, off * noise])) for off in (0.0, 0.1, 0.3, 0.6)
    ]
    assert (np.diff(noisy) < 0).all()
    raised = [share(clean, eave_m=EAVE_M + up) for up in (0.0, 0.2, 0.5, 1.0)]
    assert (np.diff(raised) < 0).all()
    assert noisy[-1] < 0.9 and raised[-1] < 0.7


def test_a_face_without_points_makes_it_lower():
    point_m = on_roof(HOUSE, GABLE, 200, 0)
    half = point_m[point_m[:, 1] < 4]
    whole = roof_evidence(Fitter(Limits()), FittedRoof([HOUSE], GABLE, EAVE_M, 0.0), point_m[: len(half)])
    one_sided = roof_evidence(Fitter(Limits()), FittedRoof([HOUSE], GABLE, EAVE_M, 0.0), half)
    assert one_sided.margin_m[2] == 0.0 and one_sided.margin_m[0] > 10
    assert confidence.share(one_sided) < confidence.share(whole)


def test_the_margin_of_a_gable_is_what_a_hip_would_cost():
    """By the heights of the kernel instead of the residuals of the fit."""
    point_m = on_roof(HOUSE, GABLE, 50, 2)
    evidence = roof_evidence(Fitter(Limits()), FittedRoof([HOUSE], GABLE, EAVE_M, 0.0), point_m)

    def total(angle_deg):
        over = roof(
            Polygons.from_rings([[HOUSE]]),
            np.asarray(angle_deg, float),
            EAVE_M,
            point_m[:, :2],
            np.zeros(50, int),
        )
        tilt = np.where(over.edge >= 0, np.asarray(angle_deg)[over.edge], 0.0)
        return np.minimum(np.abs(over.z_m - point_m[:, 2]) * np.cos(np.radians(tilt)), 1.0).sum()

    # the next best answer for a gable is a hip of 38 degrees
    assert evidence.margin_m[1] == pytest.approx(total([40, 38, 40, 90]) - total(GABLE), rel=1e-6)
    assert evidence.residual_m == pytest.approx(total(GABLE) / 50, rel=1e-6)


def test_a_network_that_agrees_makes_it_higher():
    point_m = on_roof(HOUSE, GABLE, 12, 3)
    agrees, differs = np.full((4, 3), 0.02), np.full((4, 3), 0.02)
    agrees[[0, 1, 2, 3], [2, 1, 2, 1]] = differs[[0, 1, 2, 3], [1, 2, 1, 2]] = 0.96
    assert share(point_m, probability=differs) < share(point_m) < share(point_m, probability=agrees)


def test_only_some_of_very_many_edges_are_evaluated():
    turn = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    ring = 10 * np.column_stack([np.cos(turn), np.sin(turn)])
    hip_roof = FittedRoof([ring], np.full(90, 30.0), EAVE_M, 0.0)
    evidence = roof_evidence(Fitter(Limits()), hip_roof, on_roof(ring, hip_roof.angle_deg, 400, 0))
    assert 12 <= len(evidence.margin_m) <= 24
    assert 0.5 < confidence.share(evidence) < 1


def drawn(num_buildings: int) -> list[tuple[Building, np.ndarray]]:
    """Houses with random roofs and 8 to 200 points, some of them with a tree or a dormer, and their angles."""
    rng = np.random.default_rng(7)
    buildings = []
    for i in range(num_buildings):
        ring = (HOUSE if rng.random() < 0.5 else ELL) * rng.uniform(0.7, 1.3, 2)
        slope = float(rng.integers(20, 46))
        angle = np.where(rng.random(len(ring)) < 0.4, 90.0, slope)
        angle[rng.integers(len(ring))] = slope
        if rng.random() < 0.1:
            angle[:] = 0.0
        point_m = on_roof(ring, angle, int(rng.choice([8, 15, 30, 80, 200])), i, 0.05)
        point_m = point_m[np.isfinite(point_m[:, 2])]
        if rng.random() < 0.4:
            # a tree or a dormer
            middle, reach = point_m[rng.integers(len(point_m)), :2], rng.uniform(1, 4)
            near = np.linalg.norm(point_m[:, :2] - middle, axis=1) < reach
            point_m[near, 2] += rng.uniform(0.3, 3)
        if rng.random() < 0.3:
            # one side is hidden
            is_visible = point_m[:, rng.integers(2)] < rng.uniform(0.4, 0.9) * ring[:, 0].max()
            point_m = point_m[is_visible] if is_visible.sum() >= 5 else point_m
        classes = np.full(len(point_m), 6, np.uint8)
        buildings.append((Building(str(i), "t", (0.0, 0.0), [ring], point_m, classes, 0.0), angle))
    return buildings


def test_stated_confidence_is_about_the_observed_share():
    """On buildings of another kind than those that the coefficients were chosen on."""
    config = CONFIG.model_copy(update={"min_num_points": 3})
    cases = drawn(400)
    reconstructions = fitting.fit([building for building, _ in cases], config)
    stated, right = [], []
    for fit, (_, angle_deg) in zip(reconstructions, cases, strict=True):
        if fit.angle_deg is None or fit.confidence is None:
            continue
        hits = np.append(
            np.abs(fit.angle_deg - angle_deg) <= 5, abs((fit.eave_height_m or 0) - EAVE_M) <= 0.5
        )
        stated.append(fit.confidence)
        right.append(hits.mean())
    stated, right = np.array(stated), np.array(right)
    assert len(stated) > 380 and np.std(stated) > 0.05
    assert stated.mean() == pytest.approx(right.mean(), abs=0.08)
    quarters = np.array_split(np.argsort(stated), 4)
    assert max(abs(stated[part].mean() - right[part].mean()) for part in quarters) < 0.15
    good, bad = stated[right == 1], stated[right < 1]
    assert (good[:, None] > bad).mean() > 0.75 and np.corrcoef(stated, right)[0, 1] > 0.5


def test_a_building_that_no_roof_fits_has_a_low_confidence():
    ramp = on_roof(HOUSE, GABLE, 200, 0)
    ramp[:, 2] = 5 + np.random.default_rng(0).uniform(0, 4, len(ramp))
    building = Building("a", "t", (0.0, 0.0), [HOUSE], ramp, np.full(200, 6, np.uint8), 0.0)
    (rough,) = fitting.fit([building], CONFIG)
    (clean,) = fitting.fit([replace(building, point_m=on_roof(HOUSE, GABLE, 200, 0))], CONFIG)
    assert rough.confidence is not None and clean.confidence is not None
    assert rough.confidence < 0.8 < 0.97 < clean.confidence


def of_planes(residual_m: float, num_points: int) -> float:
    return confidence.share(Evidence(num_points, residual_m, np.zeros(0), False))


def test_the_confidence_of_planes_falls_with_their_residual_and_rises_with_points():
    by_residual = [of_planes(residual_m, 300) for residual_m in (0.05, 0.2, 0.4, 0.8)]
    assert (np.diff(by_residual) <= 0).all() and by_residual[0] > 0.95 and by_residual[-1] == 0.0
    by_points = [of_planes(0.1, num_points) for num_points in (3, 10, 30, 300)]
    assert (np.diff(by_points) > 0).all()
