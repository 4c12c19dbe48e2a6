"""Our variants on a hamlet with known buildings, Table 1 by visibility, and errors by kind of building."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import shapely
from all_cases import all_test_cases, reconstructed
from truth_network import TruthNetwork

from p2wss import skeleton
from p2wss.config import Config, Eval, load
from p2wss.data.building import Building, Reconstruction
from p2wss.eval import cases, measure, methods, report, tables
from p2wss.eval.cases import Key
from p2wss.eval.measure import roof_kind
from p2wss.reconstruction.product import FIT, NETWORK, constant
from p2wss.storage.schemas.crops import REAL, SIMULATED
from p2wss.storage.schemas.measures import MEASURES

CONFIG, RECONSTRUCT = Eval(num_resamples=50, num_samples=256), Config().reconstruct
RUNS = [tables.Run(name, "ok") for name in (NETWORK, FIT)]
TITLES = {SIMULATED: "Simulated", REAL: "Real"}


@pytest.fixture(scope="module")
def hamlet_cases(hamlet: Path) -> list[cases.Case]:
    return all_test_cases(hamlet)


@pytest.fixture(scope="module")
def reconstructions(hamlet_cases: list[cases.Case]) -> dict[str, dict[Key, Reconstruction]]:
    """From a network whose heights are 40 cm too high and whose roofs are all hips of 30 degrees."""
    inputs = methods.Inputs(Config(), TruthNetwork(hamlet_cases, wrong_m=0.4, slope_deg=30.0))
    every = [reconstructed(run.method, hamlet_cases, inputs) for run in RUNS]
    return every[0] | every[1]


@pytest.fixture(scope="module")
def table(hamlet_cases: list[cases.Case], reconstructions: dict) -> pa.Table:
    return pa.Table.from_pylist(
        list(measure.measure(hamlet_cases, reconstructions, Config(eval=CONFIG))), MEASURES
    )


@pytest.fixture(scope="module")
def frame(table: pa.Table) -> pd.DataFrame:
    return tables.frame_of(table, RUNS)


def test_each_variant_does_what_its_name_says(hamlet_cases: list[cases.Case], reconstructions: dict) -> None:
    for case in hamlet_cases[:16]:
        network, fit = (reconstructions[run.method][case.key] for run in RUNS)
        assert fit.num_parts == 1, "one height on simulated buildings"
        assert case.eave_height_m is not None
        assert abs((fit.eave_height_m or 0) - case.eave_height_m) < 0.15
        assert (network.eave_height_m or 0) - case.eave_height_m == pytest.approx(0.4, abs=1e-5)


def test_roof_edges_are_compared_with_the_labels(frame: pd.DataFrame) -> None:
    """The network is 0.4 m too high, and its angles are off."""
    shares = frame.groupby(["dataset", "method"], observed=True)[
        ["false_edge_share", "missing_edge_share"]
    ].mean()
    assert (shares.loc[("simulated", "fit")] == 0).all()
    assert shares.loc[("simulated", "point2wss")].between(0.1, 0.4).all() and shares.loc["real"].isna().all(
        axis=None
    )


def test_the_true_roof_does_not_depend_on_the_ground_of_the_cloud(hamlet_cases: list[cases.Case]) -> None:
    case = next(case for case in hamlet_cases if case.is_labelled)
    assert case.label_terrain_z_m is not None and case.eave_height_m is not None
    # as where the ground around a building on a slope is above its eaves
    high = replace(case, building=replace(case.building, ground_z_m=case.label_terrain_z_m + 50))
    one, other = measure.true_mesh(case), measure.true_mesh(high)
    assert one is not None and other is not None and len(one.triangle) > 4
    assert np.array_equal(one.vertex_m, other.vertex_m)
    assert one.vertex_m[:, 2].min() == case.label_terrain_z_m


def test_true_roofs_are_as_high_as_the_config_lets_them_be() -> None:
    """A hip of 20 m, by ``buildings.max_roof_height_m`` not cut off at the default of 12 m."""
    ring, angle_deg = np.array([[0.0, 0], [40, 0], [40, 40], [0, 40]]), np.full(4, 45.0)
    point = np.random.default_rng(0).uniform([0, 0, 0], [40, 40, 20], (200, 3))
    building = Building("a", "t", (0.0, 0.0), [ring], point, np.full(200, 6, np.uint8), 0.0)
    case = cases.Case(SIMULATED, building, 1.0, "hip", 5.0, 0.0, angle_deg)
    high = {"max_roof_height_m": 100}
    config = load({"buildings": high, "reconstruct": high})
    (whole,) = constant([building], np.array([5.0]), 45.0, config.reconstruct)
    assert whole.mesh.vertex_m[:, 2].max() == pytest.approx(25)
    row, cut = (measure.measure_building(case, whole, each) for each in (config, Config()))
    assert row["false_edge_share"] == row["missing_edge_share"] == 0 < cut["missing_edge_share"]


def test_only_real_buildings_are_of_planes() -> None:
    real = methods.for_dataset(RECONSTRUCT, REAL)
    simulated = methods.for_dataset(RECONSTRUCT, SIMULATED)
    assert real == RECONSTRUCT and real.roofs == "planes"
    assert simulated == RECONSTRUCT.model_copy(update={"roofs": "parametric"})


def test_seen_edges_are_those_with_points_over_a_sloped_face(hamlet_cases: list[cases.Case]) -> None:
    """An independent count: the faces of the label's mesh in plan, with points counted by shapely."""
    thinned = []
    for i, case in enumerate(hamlet_cases[:8]):
        x = case.building.point_m[:, 0]
        # points only left of the middle, or on the first 3 m of it
        left = x < (1.0 if i % 2 else -2.0)
        thinned.append(
            replace(
                case,
                building=replace(
                    case.building,
                    point_m=case.building.point_m[left],
                    classification=case.building.classification[left],
                ),
            )
        )
    truth = [case.angle_deg for case in thinned if case.angle_deg is not None]
    tents = [np.full(len(angle), 30.0) for angle in truth]
    is_seen = measure.seen_edges(thinned, truth)
    together = np.concatenate(is_seen)
    assert 0.1 < together.mean() < 0.95
    alone = [measure.seen_edges([case], [angle])[0] for case, angle in zip(thinned, truth, strict=True)]
    assert all(map(np.array_equal, is_seen, alone))
    is_seen_of_tents = measure.seen_edges(thinned, tents)
    assert np.concatenate(is_seen_of_tents).sum() > together.sum()
    for case, tent, mask, tent_mask in zip(thinned, tents, is_seen, is_seen_of_tents, strict=True):
        assert case.angle_deg is not None
        of_label, of_tent = num_points_over_faces(case, case.angle_deg), num_points_over_faces(case, tent)
        assert np.array_equal(mask, of_label >= 10)
        assert np.array_equal(tent_mask, np.maximum(of_label, of_tent) >= 10)


def num_points_over_faces(case: cases.Case, angle_deg: np.ndarray) -> np.ndarray:
    polygon = skeleton.Polygons.from_rings([list(case.building.rings)])
    built = skeleton.build(
        polygon, angle_deg, np.array([case.eave_height_m]), max_roof_height_m=RECONSTRUCT.max_roof_height_m
    )
    vertex_m, triangle, kind, edge = built.mesh(0)
    point = case.building.point_m[case.building.is_on_building]
    count = np.zeros(len(angle_deg), int)
    for e in np.flatnonzero((angle_deg > 0) & (angle_deg < 90)):
        faces = triangle[(edge == e) & (kind >= 2)]
        plan = shapely.union_all([shapely.Polygon(vertex_m[t][:, :2]) for t in faces])
        count[e] = shapely.contains_xy(plan.buffer(1e-9), point[:, 0], point[:, 1]).sum()
    return count


def test_table_1_has_the_variants_over_all_and_over_seen_values(
    hamlet_cases: list[cases.Case], reconstructions: dict, table: pa.Table
) -> None:
    errors = tables.table_1(table).set_index("Parameter")
    assert errors["Point2WSS, footprint given MAE"]["Height (m)"] == pytest.approx(0.4, abs=1e-5)
    truth = np.concatenate([case.angle_deg for case in hamlet_cases[:16] if case.angle_deg is not None])
    of_network = errors["Point2WSS, footprint given MAE"]["Angles (°)"]
    assert of_network == pytest.approx(np.abs(truth - 30).mean(), abs=1e-4)
    assert errors["Fit alone MAE"]["Height (m)"] < 0.05
    angles = [reconstructions[FIT][case.key].angle_deg for case in hamlet_cases[:16]]
    is_seen = np.concatenate(measure.seen_edges(hamlet_cases[:16], angles))
    assert errors["Fit alone count"]["Angles, roof face seen (°)"] == is_seen.sum() <= len(truth)
    assert errors["Point2WSS, all masked count"].sum() == 0


def test_groups_hold_the_same_buildings_for_every_method(table: pa.Table, frame: pd.DataFrame) -> None:
    groups = tables.by_group(frame, RUNS, TITLES)
    sums = groups.groupby(["Data set", "By", "Method"])["Buildings"].sum()
    assert set(sums["Simulated"]) == {16} and set(sums["Real"]) == {12}
    assert set(groups["By"]) == set(tables.GROUPS.values())
    # by hand: the median of flat roofs of one method
    flat = [
        row["points_to_mesh_m"]
        for row in table.to_pylist()
        if row["dataset"] == "simulated" and row["method"] == "fit" and row["roof_type"] == "flat"
    ]
    row = groups.set_index(["Data set", "By", "Group", "Method"]).loc[
        "Simulated", "Roof", "flat", "Fit alone"
    ]
    assert row["Buildings"] == len(flat) == 4
    assert row["Median Points to mesh (m)"] == pytest.approx(np.median(flat))
    # the kinds of real buildings come from the best reconstruction, not from the network's hips
    kinds = groups[(groups["Data set"] == "Real") & (groups["By"] == "Roof")]
    assert {"flat", "gable"} <= set(kinds["Group"])


def test_a_building_that_one_method_lacks_is_in_no_group_and_no_distribution(frame: pd.DataFrame) -> None:
    """The median of a method that fails at the difficult buildings would be that of the easy ones."""
    is_lost = (frame["method"] == NETWORK) & (frame["building_id"] == "b24")
    lacking = frame.assign(**{name: frame[name].mask(is_lost) for name in (*tables.MEANS, *tables.SHARES)})
    without = frame[frame["building_id"] != "b24"]
    of = [tables.by_group(each, RUNS, TITLES) for each in (lacking, without)]
    pd.testing.assert_frame_equal(*of)
    assert len(of[0]) and is_lost.sum() == 1
    names = {run.method: run.name for run in RUNS}
    assert report._distributions(lacking, names, TITLES) == report._distributions(without, names, TITLES)


def test_the_worst_buildings_come_first(frame: pd.DataFrame) -> None:
    assert tables.main_method(RUNS) == FIT
    ranked = tables.ranked(frame, RUNS)
    worst = tables.worst(ranked, TITLES, 5)
    assert list(worst["Data set"]).count("Simulated") == list(worst["Data set"]).count("Real") == 5
    for dataset, title in TITLES.items():
        rows = frame[(frame["dataset"] == dataset) & (frame["method"] == FIT)]
        expected = rows["points_to_mesh_m"].sort_values(ascending=False)[:5]
        assert list(worst.loc[worst["Data set"] == title, "Points to mesh (m)"]) == list(expected)
    without = frame.assign(points_to_mesh_m=frame["points_to_mesh_m"].where(frame["building_id"] != "b30"))
    assert tables.worst(tables.ranked(without, RUNS), TITLES, 1)["Building"].tolist()[0] == "b30"


SQUARE = [np.array([[0.0, 0], [8, 0], [8, 8], [0, 8]])]


@pytest.mark.parametrize(
    ("angle", "kind"),
    [
        ([0, 0, 0, 0], "flat"),
        ([90, 90, 90, 90], "flat"),
        ([30, 30, 31, 30], "hip"),
        ([30, 90, 31, 90], "gable"),
        ([90, 90, 31, 90], "shed"),
        ([30, 0, 31, 90], "mixed"),
    ],
)
def test_roof_kinds(angle: list[float], kind: str) -> None:
    assert roof_kind(SQUARE, np.array(angle)) == kind
    assert roof_kind(SQUARE, np.array(angle), 2) == "several heights"


def test_bent_faces_are_not_planar_and_densities_are_counted() -> None:
    at = np.arange(0.25, 10, 0.5)
    x, y = (g.ravel() for g in np.meshgrid(at, at, indexing="ij"))
    ring = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    point = np.column_stack([x, y, np.full(400, 4.2)])
    building = Building("a", "t", (0.0, 0.0), [ring], point, np.full(400, 6, np.uint8), 0.0)
    (flat,) = constant([building], np.array([5.0]), 0.0, RECONSTRUCT)
    case = cases.Case(REAL, building, 1.0, None, None, None, None)
    config = Config(eval=CONFIG)
    row = measure.measure_building(case, flat, config)
    assert row["planar"] and row["roof_kind"] == "flat" and row["density_per_m2"] == pytest.approx(4)
    assert row["height_rmse_m"] == pytest.approx(0.8)
    top = np.flatnonzero(flat.mesh.vertex_m[:, 2] > 1)
    vertex = flat.mesh.vertex_m.copy()
    vertex[top[0], 2] += 0.05  # a corner: 12 mm out of the roof's plane
    bent = measure.measure_building(case, replace(flat, mesh=flat.mesh.moved(vertex.copy())), config)
    assert bent["watertight"] and not bent["planar"]
    vertex[top[0], 2] -= 0.02
    assert measure.measure_building(case, replace(flat, mesh=flat.mesh.moved(vertex.copy())), config)[
        "planar"
    ]
