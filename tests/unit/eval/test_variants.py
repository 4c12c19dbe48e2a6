"""Our variants on a hamlet with known buildings, Table 1 by visibility, groups, causes, and tables as text."""

from __future__ import annotations

import csv
import io as text_io
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pyarrow as pa
import pytest
import shapely
from all_cases import all_test_cases
from truth_network import TruthNetwork

from p2wss import skeleton
from p2wss.config import Eval, Reconstruct
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.eval import cases, figures, groups, measure, parameters, predict, tables, texts
from p2wss.eval.causes import cause_of_error
from p2wss.eval.clock import CpuClock
from p2wss.eval.gallery import Gallery
from p2wss.eval.roof_kinds import roof_kind
from p2wss.eval.samples import Samples, rows_by_key
from p2wss.reconstruct.flat import constant, lod1
from p2wss.reconstruct.product import FIT, NETWORK, NETWORK_AND_FIT
from p2wss.storage.schemas.crops import REAL, SIMULATED
from p2wss.storage.schemas.measures import MEASURES

CONFIG, RECONSTRUCT = Eval(num_resamples=50, num_samples=256), Reconstruct()


@pytest.fixture(scope="module")
def hamlet_cases(hamlet: Path) -> list[cases.Case]:
    return all_test_cases(hamlet)


@pytest.fixture(scope="module")
def reconstructions(hamlet_cases: list[cases.Case]) -> dict[str, dict[tuple[str, str, str], Reconstruction]]:
    """From a network whose heights are 40 cm too high and whose roofs are all hips of 30 degrees."""
    network = TruthNetwork(hamlet_cases, wrong_m=0.4, slope_deg=30.0)
    every = {
        NETWORK: predict.predict(hamlet_cases, network, RECONSTRUCT),
        NETWORK_AND_FIT: predict.fit(hamlet_cases, network, RECONSTRUCT),
        FIT: predict.fit(hamlet_cases, None, RECONSTRUCT),
    }
    return {
        method: {case.key: row for case, row in zip(hamlet_cases, rows, strict=True)}
        for method, rows in every.items()
    }


@pytest.fixture(scope="module")
def table(hamlet_cases: list[cases.Case], reconstructions: dict) -> pa.Table:
    return measures_of(hamlet_cases, reconstructions)


def measures_of(hamlet_cases: list[cases.Case], methods: dict[str, dict]) -> pa.Table:
    rows = list(measure.measure(hamlet_cases, methods, CONFIG))
    columns = {name: [row[name] for row in rows] for name in MEASURES.names}
    return pa.table({field.name: pa.array(columns[field.name], field.type) for field in MEASURES})


def test_each_variant_does_what_its_name_says(hamlet_cases: list[cases.Case], reconstructions: dict) -> None:
    for case in hamlet_cases[:16]:
        network, network_and_fit, fit = (
            reconstructions[name][case.key] for name in (NETWORK, NETWORK_AND_FIT, "fit")
        )
        assert [variant.method for variant in (network, network_and_fit, fit)] == [
            "point2wss",
            "point2wss+fit",
            "fit",
        ]
        # the confidence of the fit, not that of the network
        assert network.confidence == 0.5 and min(network_and_fit.confidence or 0, fit.confidence or 0) > 0.5
        assert network_and_fit.num_parts == fit.num_parts == 1, "one height on simulated buildings"
        assert case.eave_height_m is not None
        assert abs((network_and_fit.eave_height_m or 0) - case.eave_height_m) < 0.15
        assert (network.eave_height_m or 0) - case.eave_height_m == pytest.approx(0.4, abs=1e-5)


def test_only_real_buildings_may_have_parts_and_dormers() -> None:
    real = predict.for_dataset(RECONSTRUCT, REAL)
    simulated = predict.for_dataset(RECONSTRUCT, SIMULATED)
    assert real == RECONSTRUCT and real.max_parts > 1
    assert simulated == RECONSTRUCT.model_copy(update={"max_parts": 1, "dormers": False})


def test_the_clock_counts_every_building_and_no_warm_up(hamlet_cases: list[cases.Case]) -> None:
    clock, calls = CpuClock(), []

    def work(buildings: Sequence[Building], config: Reconstruct) -> list[Reconstruction]:
        calls.append(len(buildings))
        sum(i * i for i in range(200_000))
        return lod1(buildings, config)

    predict.by_dataset(hamlet_cases, work, RECONSTRUCT, clock)
    assert calls == [10, 16, 10, 12] and clock.num_buildings == {"simulated": 16, "real": 12}
    ms = clock.ms_per_building()
    assert 0 < ms["simulated"] < 500 and ms["simulated"] * 16 == pytest.approx(
        1e3 * clock.seconds["simulated"]
    )
    rows = [
        {"dataset": "real", "method": m, "num_triangles": 4} for m in ("point2wss", "point2wss+fit", "fit")
    ]
    base = {field.name: None for field in MEASURES}
    measured = pa.Table.from_pylist([base | row for row in rows], schema=MEASURES)
    cpu = {"point2wss": {"real": 3.0}, "point2wss+fit": {"real": 5.0}}
    cpu_by_method = {d.method: d.cpu_ms for d in tables.details(measured, CONFIG, cpu)}
    assert cpu_by_method == {"point2wss": 3.0, "point2wss+fit": 5.0, "fit": None}


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
    is_seen = parameters.seen_edges(thinned, truth)
    together = np.concatenate(is_seen)
    assert 0.1 < together.mean() < 0.95
    alone = [parameters.seen_edges([case], [angle])[0] for case, angle in zip(thinned, truth, strict=True)]
    assert all(map(np.array_equal, is_seen, alone))
    is_seen_of_tents = parameters.seen_edges(thinned, tents)
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
    hamlet_cases: list[cases.Case], reconstructions: dict
) -> None:
    parts = (hamlet_cases[:5], hamlet_cases[5:9], hamlet_cases[9:])
    errors = parameters.merged(parameters.variant_errors(part, reconstructions) for part in parts)
    settings = errors["settings"]
    assert settings["footprint_given"]["height_m"]["mean"] == pytest.approx(0.4, abs=1e-5)
    truth = np.concatenate([case.angle_deg for case in hamlet_cases[:16] if case.angle_deg is not None])
    assert settings["footprint_given"]["angle_deg"]["mean"] == pytest.approx(
        np.abs(truth - 30).mean(), abs=1e-4
    )
    assert settings["point2wss+fit"]["height_m"]["mean"] < 0.05 and settings["fit"]["height_m"]["mean"] < 0.05
    angles = [reconstructions["point2wss+fit"][case.key].angle_deg for case in hamlet_cases[:16]]
    is_seen = np.concatenate(parameters.seen_edges(hamlet_cases[:16], angles))
    assert settings["point2wss+fit"]["angle_seen_deg"]["count"] == is_seen.sum() <= len(truth)
    rows = tables.table_1(errors)
    assert [row[0] for row in rows[-2:]] == ["Height, roof seen (m)", "Angles, roof face seen (°)"]
    assert rows[1][rows[0].index("Point2WSS + fit MAE")] == settings["point2wss+fit"]["height_m"]["mean"]


def test_groups_hold_the_same_buildings_for_every_method(table: pa.Table) -> None:
    header, *rows = groups.table(table, ["simulated", "real"])
    records = [dict(zip(header, row, strict=True)) for row in rows]
    for dataset, size in (("simulated", 16), ("real", 12)):
        for by in {r["by"] for r in records if r["dataset"] == dataset}:
            for method in methods_of(table):
                groups_of_method = [
                    r for r in records if (r["dataset"], r["by"], r["method"]) == (dataset, by, method)
                ]
                assert sum(r["num_buildings"] for r in groups_of_method) == size
    # by hand: the median of flat roofs of one method
    plain = table.to_pylist()
    flat = [
        row["points_to_mesh_m"]
        for row in plain
        if row["dataset"] == "simulated" and row["method"] == "fit" and row["roof_type"] == "flat"
    ]
    (record,) = [
        r
        for r in records
        if (r["dataset"], r["by"], r["group"], r["method"]) == ("simulated", "kind", "flat", "fit")
    ]
    assert record["num_buildings"] == len(flat) == 4
    assert record["median_points_to_mesh_m"] == pytest.approx(np.median(flat))
    # the kinds of real buildings come from the best reconstruction, not from the network's hips
    kinds = {r["group"] for r in records if (r["dataset"], r["by"]) == ("real", "kind")}
    assert {"flat", "gable"} <= kinds


def methods_of(table: pa.Table) -> list[str]:
    return list(dict.fromkeys(table["method"].to_pylist()))


def test_calibration_is_the_share_within_half_a_metre_and_five_degrees(
    hamlet_cases: list[cases.Case], table: pa.Table
) -> None:
    """Of the network all heights count as correct (0.4 m off), and angles where the label is from 25 to 35 degrees."""
    scores = groups.calibration(table, "simulated", NETWORK)
    shares = [
        (1 + (np.abs(case.angle_deg - 30) <= 5).sum()) / (1 + len(case.angle_deg))
        for case in hamlet_cases[:16]
        if case.angle_deg is not None
    ]
    assert [(b.count, b.stated) for b in scores.bins] == [(16, 0.5)] and scores.count == 16
    assert scores.bins[0].observed == pytest.approx(np.mean(shares)) == scores.observed
    assert scores.gap == pytest.approx(abs(0.5 - np.mean(shares)))
    # a constant confidence does not rank
    assert scores.auc in (0.5, pytest.approx(np.nan, nan_ok=True)) and np.isnan(scores.correlation)
    rows = groups.calibration_table(table, ["simulated", "real"])
    assert rows[-1][:2] == ["simulated", NETWORK] and rows[-1][4] == 16
    assert {row[1] for row in rows[1:]} == {NETWORK, NETWORK_AND_FIT, FIT}


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


def scene(height_m: np.ndarray, mesh_height_m: float = 5.0) -> tuple[cases.Case, Reconstruction]:
    """A flat roof of 10 m by 10 m at ``mesh_height_m``, and points every half metre at the heights ``height_m``."""
    at = np.arange(0.25, 10, 0.5)
    x, y = (g.ravel() for g in np.meshgrid(at, at, indexing="ij"))
    ring = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    point = np.column_stack([x, y, np.broadcast_to(height_m, (20, 20)).ravel()])
    building = Building("a", "t", (0.0, 0.0), [ring], point, np.full(400, 6, np.uint8), 0.0)
    (flat,) = constant([building], np.array([mesh_height_m]), 0.0, RECONSTRUCT)
    return cases.Case(REAL, building, 1.0, None, None, None, None), flat


def test_each_cause_is_recognised() -> None:
    level = np.full((20, 20), 5.0)
    case, flat = scene(level + 1.3)
    cause = cause_of_error(case, flat)
    assert cause.kind == "height error" and "1.3 m too low" in cause.sentence
    annex = level.copy()
    annex[:6, :10] = 2.6  # 3 m by 5 m in a corner: 15 %
    cause = cause_of_error(*scene(annex))
    # points within half a metre of the outer walls could be on them: of 6 by 10, 5 by 9 remain
    assert cause.kind == "garage or annex" and "11% of the points (15 m²" in cause.sentence
    assert "2.4 m below" in cause.sentence
    dormer = level.copy()
    dormer[8:12, 8:12] = 6.1
    cause = cause_of_error(*scene(dormer))
    assert cause.kind == "dormer" and "4% of the points (4 m², inside) lie 1.1 m above" in cause.sentence
    facade = level.copy()
    facade[0] = 2.0  # 25 cm inside the footprint, like points on a wall
    assert cause_of_error(*scene(facade)).kind == "walls"
    tower = level.copy()
    tower[10:] = 9.0
    assert cause_of_error(*scene(tower)).kind == "higher part"
    assert cause_of_error(*scene(tower), num_parts=2).kind == "several heights"
    case, flat = scene(level)
    few = replace(case.building, point_m=case.building.point_m[:30], classification=np.full(30, 6, np.uint8))
    assert cause_of_error(replace(case, building=few), flat).sentence.startswith(
        "Sparse: 30 points on the building, 0.3"
    )
    assert cause_of_error(replace(case, visible_roof_share=0.3), flat).kind == "occluded"
    assert cause_of_error(case, flat).kind == "walls"
    missing = no_mesh(case.building, "x", "no-height")
    assert cause_of_error(case, missing).sentence == "No mesh: the method has no height for the building."


def test_the_gallery_shows_the_worst_buildings_and_the_counterparts(
    hamlet_cases: list[cases.Case], reconstructions: dict, table: pa.Table
) -> None:
    rows = table.to_pylist()
    gallery = Gallery(table, list(reconstructions))
    assert gallery.main == NETWORK_AND_FIT
    worst = gallery.worst("simulated", 5)
    value = {
        (r["dataset"], r["tile"], r["building_id"]): r["points_to_mesh_m"]
        for r in rows
        if r["method"] == NETWORK_AND_FIT
    }
    expected = sorted((v for key, v in value.items() if key[0] == "simulated"), reverse=True)[:5]
    assert [value[exhibit.key] for exhibit in worst] == expected
    by_key = {case.key: case for case in hamlet_cases}
    keys = [exhibit.key for exhibit in worst]
    samples = Samples(by_key, reconstructions, rows_by_key(table, keys))
    for exhibit in worst:
        cause = samples.cause(exhibit.key, exhibit.method)
        row = samples.rows[exhibit.key, exhibit.method]
        assert row["cause"] == (cause.kind if row["points_to_mesh_m"] > 0.25 else None)
        assert exhibit.sentence is None and cause.sentence.endswith(".")
    figures = {counterpart.figure: counterpart for counterpart in gallery.counterparts(2)}
    assert list(figures) == ["7 (1)", "7 (2)", "8", "9", "10", "11", "12", "13", "14"]
    # the network's hips are wrong by more than 5 degrees on every roof
    assert figures["7 (1)"].exhibits == [] and not figures["14"].exhibits, "Roofer was not run"
    assert figures["11"].exhibits and all(
        exhibit.method == NETWORK_AND_FIT for exhibit in figures["11"].exhibits
    )
    real = [r for r in rows if r["dataset"] == "real" and r["method"] in (NETWORK, NETWORK_AND_FIT)]
    assert all(row["cause"] for row in real) and not any(row["cause"] for row in rows if row["method"] == FIT)
    assert all(count > 0 for _, count in gallery.cause_counts("simulated"))


HOSTILE = r"50 % & #1_{x} $\alpha$ ~ ^ <b> ± ° ² μ σ – …"


def test_latex_is_balanced_and_escaped() -> None:
    rows = [["Name", "A_b", "n"], [HOSTILE, 1.23456, 7], ["x", None, float("nan")]]
    text = texts.to_latex(rows, HOSTILE, "tab:x")
    lines = text.splitlines()
    body = [line for line in lines if line.endswith(r"\\")]
    assert len(body) == 3 and all(len(re.findall(r"(?<!\\)&", line)) == 2 for line in body)
    assert r"1.23 & 7 \\" in body[1] and body[2] == r"x & -- & -- \\"
    assert [line for line in lines if "rule" in line] == [r"\toprule", r"\midrule", r"\bottomrule"]
    assert re.findall(r"\\(?:begin|end)\{\w+\}", text) == [
        r"\begin{table}", r"\begin{tabular}", r"\end{tabular}", r"\end{table}"
    ]  # fmt: skip
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}") and text.isascii()
    unescaped = [c for c in "#%_^~" if re.search(rf"(?<!\\){re.escape(c)}", "\n".join(body))]
    assert unescaped == ["^"], "only within the mathematics of ° and ²"
    assert "lrr" in text and next(csv.reader(text_io.StringIO(texts.to_csv(rows)))) == rows[0]


def test_the_template_names_recorded_outputs_everywhere() -> None:
    runs = [tables.Run("roofer", "recorded", "recorded outputs: a.city.jsonl"), tables.Run("fit", "ok")]
    base = {field.name: None for field in MEASURES}
    rows = [
        {"dataset": "real", "method": "roofer", "num_triangles": 10, "chamfer_m": 1.0},
        {"dataset": "real", "method": "roofer", "status": "no-roofer-mesh"},
        {
            "dataset": "simulated",
            "method": "fit",
            "num_triangles": 10,
            "chamfer_m": 1.0,
            "status": "too-few-points",
        },
    ]
    measured = pa.Table.from_pylist([base | row for row in rows], schema=MEASURES)
    details = tables.details(measured, CONFIG)
    columns = tables.columns_2(details, runs)
    names = {"simulated": "Simulated", "real": "Real"}
    titles = tables.table_2(columns, names)[0]
    assert "Real / Roofer (recorded)" in titles and "Simulated / Roofer (no outputs recorded)" in titles
    more = tables.table_2_more(columns, names)
    assert more[0] == ["Measure", "Simulated / Fit alone", "Real / Roofer (recorded)"]
    counts = {row[0]: row[1:] for row in more}
    assert counts["Buildings"] == [1, 2] and counts["Without a mesh"] == [0, 1]
    without = tables.without_mesh(details, runs, names)
    assert without[1:] == [
        ["Real", "Roofer (recorded)", "no mesh", "no-roofer-mesh", 1],
        ["Simulated", "Fit alone", "flat roof", "too-few-points", 1],
    ]


def test_small_faces_overshoot_and_bent_faces_are_counted() -> None:
    case, flat = scene(np.full((20, 20), 4.2))
    row = measure.measure_building(case, flat, CONFIG)
    assert (row["num_small_faces"], row["planar"], row["num_mesh_vertices"]) == (0, True, 8)
    assert row["overshoot_m"] == pytest.approx(0.8) and row["roof_kind"] == "flat"
    # the outermost row of points is 25 cm from a wall: 18 by 18 are left
    assert row["far_share"] == pytest.approx(324 / 400)
    assert row["height_bias_m"] == pytest.approx(-0.8) and row["density_per_m2"] == pytest.approx(4)
    top = np.flatnonzero(flat.mesh.vertex_m[:, 2] > 1)
    vertex = flat.mesh.vertex_m.copy()
    vertex[top[0], 2] += 0.05  # a corner: 12 mm out of the roof's plane
    bent = measure.measure_building(case, replace(flat, mesh=flat.mesh.moved(vertex.copy())), CONFIG)
    assert bent["watertight"] and not bent["planar"]
    vertex[top[0], 2] -= 0.02
    assert measure.measure_building(case, replace(flat, mesh=flat.mesh.moved(vertex.copy())), CONFIG)[
        "planar"
    ]
    # a corner cut off by 4 cm: one more wall, of 0.04 * sqrt(2) * 5 = 0.28 m2; by 3 cm: of 0.21 m2
    for cut, expected in ((0.04, 0), (0.03, 1)):
        ring = np.array([[0.0, 0], [10, 0], [10, 10 - cut], [10 - cut, 10], [0, 10]])
        building = replace(case.building, rings=[ring])
        (flat_roof,) = constant([building], np.array([5.0]), 0.0, RECONSTRUCT)
        row = measure.measure_building(replace(case, building=building), flat_roof, CONFIG)
        assert (row["num_small_faces"], row["num_mesh_vertices"]) == (expected, 10)


def test_a_picture_has_the_same_bytes_each_time_and_all_panels(
    hamlet_cases: list[cases.Case], reconstructions: dict
) -> None:
    case = hamlet_cases[3]
    panels = [(method, by_key[case.key]) for method, by_key in reconstructions.items()]
    first, second = (figures.data_uri(figures.building(case, panels), 60) for _ in range(2))
    assert first == second and len(figures.building(case, panels).axes) == 4
    bins = groups.calibration(
        measures_of(hamlet_cases[:4], {NETWORK: reconstructions[NETWORK]}), "simulated", NETWORK
    ).bins
    axes = figures.reliability_diagram({NETWORK: bins}, tables.METHOD_NAMES, "x").axes[0]
    dots = axes.collections[0].get_offsets()
    assert np.allclose(dots, [[b.stated, b.observed] for b in bins])
    plt.close("all")
