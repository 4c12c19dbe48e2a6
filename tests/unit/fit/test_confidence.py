"""The stated confidence of fitted buildings: monotone in what the points say, and about right on average."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from p2wss.config import Reconstruct
from p2wss.data.building import Building
from p2wss.fit import confidence, fitting
from p2wss.fit.evidence import evidence
from p2wss.fit.one_height import Fitter, Limits, OneHeight
from p2wss.metrics.calibration import calibration
from p2wss.skeleton import Polygons
from p2wss.skeleton import roof_points as roof

HOUSE = np.array([[0, 0], [12, 0], [12, 8], [0, 8.0]])
ELL = np.array([[0, 0], [14, 0], [14, 6], [6, 6], [6, 12], [0, 12.0]])
GABLE = np.array([40, 90, 40, 90.0])
CONFIG = Reconstruct(max_parts=1, simplify_m=0)
EAVE_M = 5.0


def on_roof(ring, angle_deg, num_points, seed, noise_m=0.03):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(ring.min(axis=0), ring.max(axis=0), (8 * num_points + 50, 2))
    xy = xy[shapely.contains_xy(shapely.Polygon(ring), xy[:, 0], xy[:, 1])][:num_points]
    z = roof(
        Polygons.from_rings([[ring]]), np.asarray(angle_deg, float), EAVE_M, xy, np.zeros(len(xy), int)
    ).z_m
    return np.column_stack([xy, z + noise_m * rng.standard_normal(len(xy))])


def share(point_m, angle_deg=GABLE, eave_m=EAVE_M, ring=HOUSE, odds=None):
    one = OneHeight([ring], np.asarray(angle_deg, float), eave_m, np.inf, 0.0, len(point_m))
    return confidence.expected_share(Fitter(Limits()), [one], point_m, odds)


def test_more_points_make_it_no_lower():
    point_m = on_roof(HOUSE, GABLE, 600, 0)
    told = [share(point_m[:count]) for count in (0, 1, 3, 10, 30, 100, 600)]
    assert (np.diff(told) > 0).all()
    assert told[0] < 0.3 and told[-1] > 0.95


def test_points_further_off_make_it_lower():
    clean = on_roof(HOUSE, GABLE, 100, 0, noise_m=0.0)
    noise = np.random.default_rng(1).standard_normal(len(clean))
    told = [
        share(clean + np.column_stack([0 * noise, 0 * noise, off * noise])) for off in (0.0, 0.1, 0.3, 0.6)
    ]
    assert (np.diff(told) < 0).all()
    raised = [share(clean, eave_m=EAVE_M + up) for up in (0.0, 0.2, 0.5, 1.0)]
    assert (np.diff(raised) < 0).all()
    assert told[-1] < 0.9 and raised[-1] < 0.7


def test_a_face_without_points_is_less_sure():
    point_m = on_roof(HOUSE, GABLE, 200, 0)
    half = point_m[point_m[:, 1] < 4]
    whole = evidence(
        Fitter(Limits()), OneHeight([HOUSE], GABLE, EAVE_M, np.inf, 0.0, 0), point_m[: len(half)]
    )
    seen = evidence(Fitter(Limits()), OneHeight([HOUSE], GABLE, EAVE_M, np.inf, 0.0, 0), half)
    assert seen.margin_m[2] == 0.0 and seen.margin_m[0] > 10
    assert confidence.share(seen) < confidence.share(whole)


def test_a_margin_is_what_another_gable_costs():
    """By the kernel's own heights instead of the fit's residuals."""
    point_m = on_roof(HOUSE, GABLE, 50, 2)
    found = evidence(Fitter(Limits()), OneHeight([HOUSE], GABLE, EAVE_M, np.inf, 0.0, 0), point_m)

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

    # of a gable: a hip, with 38 degrees
    assert found.margin_m[1] == pytest.approx(total([40, 38, 40, 90]) - total(GABLE), rel=1e-6)
    assert found.residual_m == pytest.approx(total(GABLE) / 50, rel=1e-6)


def test_a_network_that_agrees_makes_it_higher():
    point_m = on_roof(HOUSE, GABLE, 12, 3)
    agrees, differs = np.full((4, 3), 0.02), np.full((4, 3), 0.02)
    agrees[[0, 1, 2, 3], [2, 1, 2, 1]] = differs[[0, 1, 2, 3], [1, 2, 1, 2]] = 0.96
    assert share(point_m, odds=differs) < share(point_m) < share(point_m, odds=agrees)


def test_several_parts_are_weighed_by_their_points():
    left, right = HOUSE, HOUSE + np.array([12.0, 0.0])
    many, few = on_roof(left, GABLE, 300, 0), on_roof(right, GABLE, 5, 1)
    fitter = Fitter(Limits())
    parts = [OneHeight([ring], GABLE, EAVE_M, np.inf, 0.0, 0) for ring in (left, right)]
    told = confidence.expected_share(fitter, parts, np.vstack([many, few]))
    one, other = share(many), share(few, ring=right)
    assert told == pytest.approx((301 * one + 6 * other) / 307)


def test_edges_without_number_cost_no_more():
    """Of a ring of many edges every k-th is looked at."""
    turn = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    ring = 10 * np.column_stack([np.cos(turn), np.sin(turn)])
    one = OneHeight([ring], np.full(90, 30.0), EAVE_M, np.inf, 0.0, 0)
    found = evidence(Fitter(Limits()), one, on_roof(ring, one.angle_deg, 400, 0))
    assert 12 <= len(found.margin_m) <= 24
    assert 0.5 < confidence.share(found) < 1


def drawn(num_buildings: int) -> list[tuple[Building, np.ndarray]]:
    """Houses with a roof of some kind, 8 to 200 points, some under trees, some a dormer; with their angles."""
    rng = np.random.default_rng(7)
    found = []
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
            kept = point_m[:, rng.integers(2)] < rng.uniform(0.4, 0.9) * ring[:, 0].max()
            point_m = point_m[kept] if kept.sum() >= 5 else point_m
        classes = np.full(len(point_m), 6, np.uint8)
        found.append((Building(str(i), "t", (0.0, 0.0), [ring], point_m, classes, 0.0), angle))
    return found


def test_stated_is_about_what_comes_true():
    """On buildings that no coefficient has seen, of another kind than those that chose them."""
    config = CONFIG.model_copy(update={"min_num_points": 3})
    listed = drawn(400)
    made = fitting.fit([building for building, _ in listed], config)
    stated, right = [], []
    for one, (_, angle_deg) in zip(made, listed, strict=True):
        if one.angle_deg is None or one.confidence is None:
            continue
        hits = np.append(
            np.abs(one.angle_deg - angle_deg) <= 5, abs((one.eave_height_m or 0) - EAVE_M) <= 0.5
        )
        stated.append(one.confidence)
        right.append(hits.mean())
    found = calibration(np.array(stated), np.array(right))
    assert found.count > 380 and np.std(stated) > 0.05
    assert found.stated == pytest.approx(found.observed, abs=0.08)
    assert found.gap < 0.1
    assert found.auc > 0.75 and found.correlation > 0.5


def test_a_building_that_no_roof_fits_is_not_sure():
    ramp = on_roof(HOUSE, GABLE, 200, 0)
    ramp[:, 2] = 5 + np.random.default_rng(0).uniform(0, 4, len(ramp))
    building = Building("a", "t", (0.0, 0.0), [HOUSE], ramp, np.full(200, 6, np.uint8), 0.0)
    (made,) = fitting.fit([building], CONFIG)
    (easy,) = fitting.fit([replace(building, point_m=on_roof(HOUSE, GABLE, 200, 0))], CONFIG)
    assert made.confidence is not None and easy.confidence is not None
    assert made.confidence < 0.8 < 0.97 < easy.confidence
