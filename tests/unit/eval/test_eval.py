"""The evaluation on a hamlet with known buildings, with a predictor that knows the truth."""

from __future__ import annotations

import csv
import json
import re
import runpy
import stat
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trimesh
from all_cases import all_test_cases, reconstructed
from places import MINI
from truth_network import TruthNetwork

from p2wss import cli
from p2wss.config import Config, Eval, load, roofer_command
from p2wss.data.building import Reconstruction, no_mesh
from p2wss.data.manifest import Manifest, Shard, read_manifest
from p2wss.eval import cases, figures, measure, methods, report, tables
from p2wss.eval.cases import (
    RECONSTRUCTIONS,
    read_reconstructions,
    reconstruction_columns,
)
from p2wss.nets import predictor as predictor_module
from p2wss.nets import weights
from p2wss.storage import files
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.crops import CROPS
from p2wss.storage.schemas.measures import MEASURES

ROOFER = Path(__file__).with_name("toy_roofer.py")
CONFIG = Eval(num_resamples=50)
INPUTS = methods.Inputs(Config())
TITLES = {"simulated": "Simulated", "real": "Real"}


def measured(every: list[cases.Case], rows: dict, config: Eval = CONFIG) -> pa.Table:
    """The measures of reconstructions by method."""
    return pa.Table.from_pylist(list(measure.measure(every, rows, Config(eval=config))), MEASURES)


@pytest.fixture(scope="module")
def hamlet_cases(hamlet: Path) -> list[cases.Case]:
    return all_test_cases(hamlet)


def test_cases_are_the_test_split_and_all_real_lidar_in_metres(hamlet_cases: list[cases.Case]) -> None:
    assert [c.dataset for c in hamlet_cases] == ["simulated"] * 16 + ["real"] * 12
    first = hamlet_cases[0]
    assert first.building.building_id == "b24" and first.eave_height_m == 4.0
    assert first.building.rings[0].tolist() == [[-5, -5], [7, -5], [7, 3], [-5, 3]]
    on_ground = first.building.point_m[first.building.classification == 2]
    assert on_ground[:, 2].mean() == pytest.approx(0.0, abs=0.03)
    assert hamlet_cases[-1].angle_deg is None and hamlet_cases[-1].eave_height_m is None


def test_medians_are_of_the_train_split_above_the_clouds_ground(hamlet: Path) -> None:
    medians = cases.train_medians(read_manifest(hamlet))
    table = files.read_table(hamlet.parent / "a.parquet", CROPS).to_pylist()
    train = [row for row in table if row["split"] == "train"]
    assert medians.eave_height_m == pytest.approx(np.median([row["eave_height_m"] for row in train]))
    assert medians.angle_deg == np.median(np.concatenate([row["angle_deg"] for row in train]))


def test_without_a_train_split_medians_are_of_all_labels(hamlet: Path, tmp_path: Path) -> None:
    rows = files.read_table(hamlet.parent / "a.parquet", CROPS).to_pylist()
    for row in rows:
        row["split"] = "test"
    columns = {name: [row[name] for row in rows] for name in CROPS.names}
    files.write_table(tmp_path / "t.parquet", columns, CROPS, {})
    manifest = Manifest([Shard(tmp_path / "t.parquet", "simulated")])
    medians = cases.train_medians(manifest)
    assert medians.eave_height_m == pytest.approx(np.median([row["eave_height_m"] for row in rows]))
    assert np.isnan(cases.train_medians(Manifest([])).angle_deg)


def test_table_1_is_the_error_of_the_predictor(hamlet: Path, hamlet_cases: list[cases.Case]) -> None:
    medians = cases.train_medians(read_manifest(hamlet))
    # only upwards and from slopes: 0 and 90 would be clipped
    inputs = INPUTS._replace(predictor=TruthNetwork(hamlet_cases, wrong_m=0.25), medians=medians)
    rows = {}
    for method in ("point2wss", "masked", "constant"):
        rows |= reconstructed(method, hamlet_cases, inputs)
    measures = measured(hamlet_cases, rows)
    assert tables.num_left_out(measures) == 0
    table = tables.table_1(measures).set_index("Parameter")
    fixed, masked, signs = (
        {name: table[f"{setting} {name}"] for name in ("MAE", "std", "count")}
        for setting in (
            "Point2WSS, footprint given",
            "Point2WSS, all masked",
            "Point2WSS, signs masked too",
        )
    )
    assert fixed["MAE"]["Height (m)"] == pytest.approx(0.25) and fixed["std"]["Height (m)"] < 1e-5
    assert fixed["count"]["Height (m)"] == 16 and fixed["MAE"]["Angles (°)"] == pytest.approx(0, abs=1e-5)
    assert fixed["count"]["Footprint (m)"] == 0 and np.isnan(fixed["MAE"]["Footprint (m)"])
    assert masked["MAE"]["Footprint (m)"] == pytest.approx(0.15)  # 0.3 in x, 0 in y
    assert masked["MAE"]["Footprint, Euclidean (m)"] == pytest.approx(0.3)
    assert signs["MAE"]["Footprint, Euclidean (m)"] == pytest.approx(0.6)
    truth = np.array([case.eave_height_m for case in hamlet_cases[:16]], float)
    constant = np.abs(truth - medians.eave_height_m).mean()
    assert table["Constant predictor MAE"]["Height (m)"] == pytest.approx(constant)
    assert table.loc["Height (m)", ["Paper MAE", "Paper std"]].tolist() == [0.23, 0.9]


def test_a_building_too_large_for_the_numbers_is_left_out_of_table_1_and_counted(
    hamlet_cases: list[cases.Case], monkeypatch: pytest.MonkeyPatch
) -> None:
    network = TruthNetwork(hamlet_cases)
    whole = network.reconstruct_all_masked

    def without_one(*arguments: Any) -> tuple[Any, ...]:
        height_m, *others = whole(*arguments)
        return np.where(np.arange(16) == 3, np.nan, height_m), *others

    monkeypatch.setattr(network, "reconstruct_all_masked", without_one)
    rows = reconstructed("lod1", hamlet_cases[:16], INPUTS)
    rows |= reconstructed("masked", hamlet_cases[:16], INPUTS._replace(predictor=network))
    assert [len(rows[name]) for name in methods.MASKED] == [15, 15]
    assert tables.num_left_out(measured(hamlet_cases[:16], rows)) == 1


def test_the_truth_measures_better_than_a_flat_roof(hamlet_cases: list[cases.Case]) -> None:
    some = hamlet_cases[:16]
    rows = reconstructed("point2wss", some, INPUTS._replace(predictor=TruthNetwork(hamlet_cases)))
    rows |= reconstructed("lod1", some, INPUTS)
    table = measured(some, rows).to_pylist()
    for case, a, b in zip(some, table[:16], table[16:], strict=True):
        assert a["points_to_mesh_m"] < 0.04  # the noise is 0.03 m
        assert a["roof_chamfer_m"] < 0.4 and a["watertight"] and a["manifold"]
        assert a["height_error_m"] == pytest.approx(0, abs=1e-4)
        if case.roof_type != "flat":
            assert b["points_to_mesh_m"] > a["points_to_mesh_m"] and b["chamfer_m"] > a["chamfer_m"]


def test_measures_do_not_depend_on_order_or_on_the_rest(hamlet_cases: list[cases.Case]) -> None:
    rows = reconstructed("lod1", hamlet_cases, INPUTS)
    forth = measured(hamlet_cases, rows).to_pylist()
    back = measured(hamlet_cases[::-1][:9], rows).to_pylist()
    assert back == forth[::-1][:9]
    few = measure.subset(hamlet_cases[0], hamlet_cases[0].building.point_m, Eval(max_num_points=100))
    assert len(np.unique(few, axis=0)) == 100


def test_reconstructions_survive_the_file(hamlet_cases: list[cases.Case], tmp_path: Path) -> None:
    some = hamlet_cases[:16]
    rows = methods.reconstruct("lod1", some, INPUTS)
    rows[3] = no_mesh(some[3].building, "lod1", "no-height")
    path = tmp_path / "r.parquet"
    files.write_table(path, reconstruction_columns(rows, "simulated"), RECONSTRUCTIONS, {})
    back = read_reconstructions(path)["lod1"]
    for case, before in zip(some, rows, strict=True):
        after = back[case.key]
        assert before.has_mesh == after.has_mesh
        for name in ("vertex_m", "triangle", "kind", "label") if before.has_mesh else ():
            assert np.array_equal(getattr(before.mesh, name), getattr(after.mesh, name))
        assert (before.status, before.ground_z_m) == (after.status, after.ground_z_m)
        assert (before.eave_height_m is None) == (after.eave_height_m is None)
        assert all(map(np.array_equal, before.rings, after.rings))
    (row,) = measured(some[3:4], {"lod1": back}).to_pylist()
    assert row["status"] == "no-height" and row["chamfer_m"] is None and row["watertight"] is None
    (one,) = read_reconstructions(path, [some[5].key])["lod1"].values()
    assert one.building_id == some[5].building.building_id


def test_an_unknown_method_and_one_without_its_weights_are_refused(hamlet_cases: list[cases.Case]) -> None:
    for name in ("lod2", "point2wss", "constant"):
        with pytest.raises(InputError, match=f"cannot reconstruct by {name}: choose one of point2wss"):
            methods.reconstruct(name, hamlet_cases[:2], INPUTS)


def measures_of(rows: list[dict[str, object]]) -> pa.Table:
    base = {field.name: None for field in MEASURES}
    named = [base | {"tile": "t", "building_id": str(i)} | row for i, row in enumerate(rows)]
    return pa.Table.from_pylist(named, schema=MEASURES)


def test_table_2_has_the_papers_rows_and_figures() -> None:
    base = {"dataset": "simulated", "method": "point2wss", "status": "ok"}
    rows = [
        base | {"chamfer_m": cd, "num_triangles": t, "watertight": True}
        for cd, t in ((1.0, 10), (2.0, 20), (4.0, 60))
    ]
    rows.append(base | {"status": "no height"})
    fit = base | {"method": "fit", "num_triangles": 10}
    rows += [fit | {"building_id": str(i), "chamfer_m": 1.0 + i} for i in range(3)]
    # of the building without a mesh of the network: counted, but in no mean
    rows.append(fit | {"building_id": "3", "status": "too-few-points", "chamfer_m": 90.0})
    rows += [base | {"method": "roofer", "building_id": str(i), "status": "gone"} for i in range(4)]
    runs = [tables.Run(name, "ok") for name in ("point2wss", "fit")]
    runs += [tables.Run("roofer", "recorded"), tables.Run("lod1", "not run: switched off")]
    frame = tables.frame_of(measures_of(rows), runs)
    table = tables.table_2(frame, runs, TITLES)
    assert list(table["Statistic"]) == list(tables.ROWS_2)
    expected = [7 / 3, 1.5, 2.0, 3.0, np.std([1, 2, 4]), 30, np.std([10, 20, 60])]
    assert list(table["Simulated / Point2WSS"]) == pytest.approx(expected)
    assert list(table["HD LiDAR / paper: Ours"]) == [2.14, 0.98, 1.55, 2.45, 2.23, 17.3, 5.2]
    assert list(table["Simulated / Fit alone"][:2]) == [2.0, 1.5]
    assert table["Simulated / Roofer (gone)"].isna().all() and table["Real / Roofer (recorded)"].isna().all()
    assert table["Simulated / LoD1 (flat) (not run: switched off)"].isna().all()
    more = tables.table_2_more(frame, runs, TITLES, CONFIG)
    names = ["Simulated / Point2WSS", "Simulated / Fit alone", "Simulated / Roofer (gone)"]
    assert list(more) == ["Measure", *names]
    ours, fit, gone = (dict(zip(more["Measure"], more[name], strict=True)) for name in names)
    assert [str(ours[name]) for name in ("Buildings", "Without a mesh")] == ["4", "1"]
    assert [of["Buildings"] for of in (fit, gone)] == [4, 4] and gone["Without a mesh"] == 4
    assert [of["Compared"] for of in (ours, fit, gone)] == [3, 3, 0] and fit["CD (m)"] == 2.0
    assert ours["CD (m), 95 % low"] < ours["CD (m)"] < ours["CD (m), 95 % high"]
    assert ours["Watertight (%)"] == 100
    assert tables.without_mesh(frame, runs, TITLES).to_numpy().tolist() == [
        ["Simulated", "Point2WSS", "no mesh", "no height", 1],
        ["Simulated", "Fit alone", "flat roof", "too-few-points", 1],
        ["Simulated", "Roofer (recorded)", "no mesh", "gone", 4],
    ]


def test_the_interval_of_a_mean_covers_it() -> None:
    draw = np.random.default_rng(0)
    covered = 0
    for _ in range(100):
        low, high = tables.interval(draw.normal(3, 1, 30), draw, 200)
        covered += low < 3 < high
    assert covered > 85 and np.isnan(tables.interval(np.ones(1), draw, 10)).all()


def test_roofer_is_run_and_read_back(hamlet_cases: list[cases.Case], tmp_path: Path) -> None:
    """A toy program in place of Roofer: boxes up to the highest point, from the real input files."""
    program = tmp_path / "roofer"
    program.write_text(f"#!{sys.executable}\n{ROOFER.read_text()}")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    config = load({"eval": {"roofer_command": str(program)}})
    assert roofer_command.state(config.eval) == "toy 1.0"
    assert roofer_command.facts(config.eval) == {"status": "ok", "note": "toy 1.0"}
    rows = reconstructed("roofer", hamlet_cases, methods.Inputs(config, crs="EPSG:2154"))["roofer"]
    for case in hamlet_cases:
        reconstruction = rows[case.key]
        mesh = trimesh.Trimesh(reconstruction.mesh.vertex_m, reconstruction.mesh.triangle)
        top = case.building.point_m[:, 2].max()
        assert reconstruction.status == "ok" and mesh.is_watertight and mesh.volume > 0
        assert mesh.bounds[1, 2] == pytest.approx(top, abs=0.011)
        # the bounding box of the footprint, in the frame of the building
        assert mesh.bounds[0, :2] == pytest.approx(case.building.rings[0].min(axis=0), abs=0.011)


def test_recorded_outputs_count_for_the_points_that_they_were_made_from(
    hamlet: Path, hamlet_cases: list[cases.Case], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = f"{sys.executable} {ROOFER}"
    of_dataset = {name: [case for case in hamlet_cases if case.dataset == name] for name in TITLES}
    monkeypatch.setattr(
        sys, "argv", ["", "--command", command, "--manifest", str(hamlet), "--out", str(tmp_path)]
    )
    assert runpy.run_path(str(MINI / "roofer/record.py"))["main"]() == 0
    config = load({"eval": {"roofer_command": "", "roofer_recorded": str(tmp_path)}})
    ran = load({"eval": {"roofer_command": command}})
    assert roofer_command.state(config.eval).count("city.jsonl") == 2

    def of(chosen: list[cases.Case], config: Config = config) -> list[Reconstruction]:
        return methods.reconstruct("roofer", chosen, methods.Inputs(config, crs="EPSG:2154"))

    def changed(chosen: list[cases.Case], **change: Callable[[np.ndarray], np.ndarray]) -> set[str]:
        values = [{name: f(getattr(case.building, name)) for name, f in change.items()} for case in chosen]
        pairs = zip(chosen, values, strict=True)
        other = [replace(case, building=replace(case.building, **each)) for case, each in pairs]
        return {row.status for row in of(other)}

    for chosen in of_dataset.values():
        for one, other in zip(of(chosen), of(chosen, ran), strict=True):
            assert one.status == "ok" and np.array_equal(one.mesh.corner_m, other.mesh.corner_m)
        # another order of the buildings is the same cloud, and a few points less; moved by a centimetre, or of another
        # class, it is another: of a simulated building, other points of the same
        other = {"recorded-of-other-points" if chosen[0].is_labelled else "recorded-of-other-clouds"}
        assert {row.status for row in of(chosen[::-1])} == {"ok"}
        assert changed(chosen, point_m=lambda p: p[1:], classification=lambda c: c[1:]) == {"ok"}
        assert changed(chosen, point_m=lambda p: p + np.array([0, 0, 0.01])) == other
        assert changed(chosen, classification=lambda c: c + np.uint8(1)) == other
        # a tenth less of them is another survey
        few = changed(chosen, point_m=lambda p: p[::10] + 0.01, classification=lambda c: c[::10])
        assert few == {"recorded-of-other-clouds"}
    first, second, *_ = of_dataset["simulated"]
    assert first.eave_height_m is not None and first.angle_deg is not None
    truths = [
        replace(first, eave_height_m=first.eave_height_m + 0.02),
        replace(first, angle_deg=first.angle_deg + 1.0),
        replace(first, building=replace(first.building, rings=[first.building.rings[0] + 0.02])),
        replace(first, building=replace(first.building, building_id=second.building.building_id)),
    ]
    for truth in truths:
        # of other points, so that each building counts by its truth
        chosen = [truth, *of_dataset["simulated"][1:]]
        chosen = [
            replace(case, building=replace(case.building, point_m=case.building.point_m + 0.01))
            for case in chosen
        ]
        rows = of(chosen)
        assert (rows[0].status, rows[0].has_mesh) == ("recorded-of-other-clouds", False)
        assert {row.status for row in rows[1:]} == {"recorded-of-other-points"} and rows[1].has_mesh
    # of a tile that is not listed nothing is recorded
    (tmp_path / "clouds.json").write_text("{}")
    assert of(of_dataset["real"]) == [] and of(of_dataset["simulated"]) == []


def test_roofer_that_fails_or_is_absent_gives_no_reconstruction(
    hamlet_cases: list[cases.Case], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    program = tmp_path / "roofer"
    program.write_text("#!/bin/sh\necho no memory >&2\nexit 3\n")
    program.chmod(0o755)
    failing = load({"eval": {"roofer_command": str(program)}})
    rows = methods.reconstruct("roofer", hamlet_cases[:2], methods.Inputs(failing))
    assert [row.status for row in rows] == ["roofer-failed"] * 2 and not rows[0].has_mesh
    assert "failed with exit status 3 on tile" in caplog.text and "no memory" in caplog.text
    absent = load({"eval": {"roofer_command": str(tmp_path / "nothing"), "roofer_recorded": ""}})
    assert methods.reconstruct("roofer", hamlet_cases, methods.Inputs(absent)) == []
    assert roofer_command.facts(absent.eval)["status"].startswith("not run: cannot start")
    # outputs are recorded, but of none of these tiles
    elsewhere = absent.eval.model_copy(update={"roofer_recorded": str(MINI / "roofer")})
    assert roofer_command.facts(elsewhere)["status"] == "recorded"
    assert roofer_command.facts(elsewhere, False)["status"].startswith("not run: cannot start")


WEIGHTS_FACTS = {"version": "1", "code": "4567", "config": {}, "dvae_config": {}}


NAMES = ("point2wss", "masked", "fit", "lod1", "constant", "roofer")
SETTINGS = json.dumps(
    {
        "eval": {
            "roofer_command": "",
            "roofer_recorded": "",
            "num_samples": 200,
            "num_resamples": 50,
            "num_worst": 3,
            "lidar_name": "stand-in <LiDAR>",
        }
    }
)


def run(*arguments: object) -> None:
    settings = [] if arguments[0] == "medians" else ["--config", SETTINGS]
    assert cli.main(["eval", *map(str, arguments), *settings]) == 0


def evaluate(manifest: Path, groups: list[list[Path]], folder: Path) -> list[Path]:
    """The commands as the rules run them, per group of shards."""
    run("medians", "--manifest", manifest, "--out", folder / "medians.json")
    options = {name: ["--model", folder / "model.safetensors"] for name in NAMES[:2]}
    options["constant"] = ["--medians", folder / "medians.json"]
    parts = [folder / "parts" / f"{number:04d}" for number in range(len(groups))]
    for part, shards in zip(parts, groups, strict=True):
        of_group = ["--manifest", manifest, "--shards", *shards]
        for name in NAMES:
            out = ["--out", part / f"{name}.parquet"]
            run("reconstruct", "--method", name, *of_group, *options.get(name, []), *out)
        rows = [part / f"{name}.parquet" for name in NAMES]
        run("measure", *of_group, "--reconstructions", *rows, "--out", part / "measures.parquet")
    return parts


def report_of(manifest: Path, folder: Path, parts: list[Path], *others: object) -> None:
    measures = ["--measures", *(part / "measures.parquet" for part in parts)]
    rows = ["--reconstructions", *(part / f"{name}.parquet" for part in parts for name in NAMES)]
    run("report", "--out", folder, "--manifest", manifest, *measures, *rows, *others)


def use_true_weights(hamlet: Path, patch: pytest.MonkeyPatch) -> None:
    """Weights of a predictor that knows the truth."""
    predictor = TruthNetwork(all_test_cases(hamlet), 0.1)
    patch.setattr(predictor_module, "load_predictor", lambda path, device: predictor)
    patch.setattr(weights, "read_weights", lambda path, kind: ({}, WEIGHTS_FACTS))


@pytest.fixture
def true_weights(hamlet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_true_weights(hamlet, monkeypatch)


@pytest.fixture(scope="module")
def whole(hamlet: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The only part of an evaluation of both shards at once; not to be changed."""
    with pytest.MonkeyPatch.context() as patch:
        use_true_weights(hamlet, patch)
        shards = [hamlet.parent / "a.parquet", hamlet.parent / "b.parquet"]
        return evaluate(hamlet, [shards], tmp_path_factory.mktemp("whole"))


@pytest.mark.usefixtures("true_weights")
def test_groups_of_shards_give_the_same_tables_as_all_shards_at_once(
    hamlet: Path, whole: list[Path], tmp_path: Path
) -> None:
    shards = [hamlet.parent / "a.parquet", hamlet.parent / "b.parquet"]
    split = evaluate(hamlet, [[shard] for shard in shards], tmp_path / "split")
    folders = [tmp_path / "whole", tmp_path / "split"]
    for folder, parts in zip(folders, (whole, split), strict=True):
        report_of(hamlet, folder, parts, "--metrics")
    assert pq.read_metadata(whole[0] / "measures.parquet").num_rows == 4 * 28 + 2 * 16
    for name in report.CAPTIONS:
        at_once, by_shard = ((folder / f"{name}.csv").read_text() for folder in folders)
        assert at_once == by_shard, name


def test_results_state_the_settings_that_they_depend_on_and_no_others(whole: list[Path]) -> None:
    """The workflow passes no others to a command, which knows of them the defaults alone."""
    facts = files.read_metadata(whole[0] / "measures.parquet")
    of_roofer, of_fit = (json.loads(facts["methods"][name]["config"]) for name in ("roofer", "fit"))
    assert set(of_fit) == {"reconstruct"}
    assert {name: set(of) for name, of in of_roofer.items()} == {
        "eval": {"roofer_command", "roofer_recorded", "roofer_timeout_s"}
    }
    stated = json.loads(facts["config"])
    assert set(stated) == {"buildings", "eval"}
    assert stated["eval"] == {"max_num_points": 2048, "num_samples": 200, "seed": 0}


@pytest.mark.usefixtures("true_weights")
def test_a_group_without_a_test_building_changes_nothing(hamlet: Path, tmp_path: Path) -> None:
    rows = files.read_table(hamlet.parent / "a.parquet", CROPS).to_pylist()
    columns = {name: [row[name] for row in rows if row["split"] != "test"] for name in CROPS.names}
    for name in ("a", "b"):
        (tmp_path / f"{name}.parquet").symlink_to(hamlet.parent / f"{name}.parquet")
    files.write_table(tmp_path / "c.parquet", columns, CROPS, files.provenance(crs="EPSG:2154"))
    shards = [{"path": f"{name}.parquet", "dataset": "simulated"} for name in "ac"]
    files.write_json(tmp_path / "manifest.json", {"shards": shards})
    groups = [[tmp_path / "a.parquet"], [tmp_path / "c.parquet"]]
    parts = evaluate(tmp_path / "manifest.json", groups, tmp_path / "with")
    report_of(tmp_path / "manifest.json", tmp_path / "with", parts, "--metrics")
    assert [pq.read_metadata(part / "measures.parquet").num_rows for part in parts] == [6 * 16, 0]
    facts = files.read_metadata(parts[1] / "measures.parquet")["methods"]
    assert {name: of["status"] for name, of in facts.items() if name != "roofer"} == dict.fromkeys(
        NAMES[:-1], "ok"
    )


def test_a_method_that_ran_for_some_groups_was_run(hamlet: Path, whole: list[Path], tmp_path: Path) -> None:
    """Recorded outputs may be of the tiles of any group of shards, not of the first."""
    facts = files.read_metadata(whole[0] / "measures.parquet")
    columns = files.read_table(whole[0] / "measures.parquet", MEASURES).to_pydict()
    for name, status in (("first", "not run: no roofer"), ("second", "recorded")):
        of_roofer = facts["methods"]["roofer"] | {"status": status}
        metadata = facts | {"methods": facts["methods"] | {"roofer": of_roofer}}
        rows = columns if name == "first" else {key: [] for key in columns}
        files.write_table(tmp_path / f"{name}.parquet", rows, MEASURES, metadata)
    paths = [tmp_path / "first.parquet", tmp_path / "second.parquet"]
    for order in (paths, paths[::-1]):
        runs = report.read(Config(), hamlet, order, [], []).runs
        assert {run.method: run.status for run in runs}["roofer"] == "recorded"


def test_a_shard_that_the_manifest_does_not_list_is_one_clear_line(hamlet: Path) -> None:
    with pytest.raises(InputError, match=r"does not list .*manifest\.json; run the stage crops again"):
        read_manifest(hamlet, [hamlet])
    (only,) = read_manifest(hamlet, [hamlet.parent / "b.parquet"]).shards
    assert only.dataset == "real"


@pytest.mark.usefixtures("true_weights")
def test_report_from_files_is_one_self_contained_page(
    hamlet: Path, whole: list[Path], tmp_path: Path
) -> None:
    """The commands as the rules run them, with a predictor that knows the truth."""
    training = tmp_path / "model" / "metrics.jsonl"
    (tmp_path / "0652_6862.png").write_bytes(b"\x89PNG of a scan")
    training.parent.mkdir()
    training.write_text("".join(json.dumps({"step": i, "loss": 9 / (i + 1)}) + "\n" for i in range(5)))
    report_of(hamlet, tmp_path, whole, "--metrics", training, "--scans", tmp_path / "0652_6862.png")
    page = (tmp_path / "report.html").read_text()
    # nothing is loaded from elsewhere: scripts, style sheets and images are embedded in the page
    assert not re.search(r"<script[^>]* src|<link|@import|url\(", page)
    assert 'id="viewer-data"' in page
    sources = re.findall(r'src="([^"]{0,30})', page)
    assert [source.split(";")[0] for source in sources].count("data:image/png") == 1  # the scan
    assert len(sources) > 2 and {*(source.split(";")[0] for source in sources)} == {
        "data:image/png",
        "data:image/svg+xml",
    }
    numbers = [int(number) for number in re.findall(r"<figcaption>Figure (\d+)", page)]
    assert numbers == list(range(1, len(sources) + 1))
    assert "stand-in &lt;LiDAR&gt;" in page and "stand-in <LiDAR>" not in page
    assert "not run: cannot start" in page
    assert page.count("Simulated scan of tile 0652_6862") == 1
    assert "4567" in page and "Training curves of model" in page
    # distances before the paper's tables, and the best of each in bold
    heads = re.findall(r'<h2 id="(\w[\w-]*)"', page)
    assert heads[:5] == ["comparison", "distributions", "kinds", "table1", "table2"] and heads[-1] == "worst"
    assert {*re.findall(r'<a href="#([\w-]+)"', page)} <= {*re.findall(r' id="([\w-]+)"', page)}
    rows = re.findall(r"<tr><td>(.*?)</td>(.*?)</tr>", page.split('id="comparison"')[1].split("<h2")[0])
    bold = {name for name, cells in rows if "<strong>" in cells}
    assert "Fit alone" in bold and not bold & {"LoD1 (flat)", "Constant"}
    assert (tmp_path / "table1.csv").read_text().startswith("Parameter,Paper MAE")
    assert "mu_CD" in (tmp_path / "table2.csv").read_text()
    for name in report.CAPTIONS:
        lines = (tmp_path / f"{name}.tex").read_text().splitlines()
        rows = list(csv.reader((tmp_path / f"{name}.csv").open()))
        body = [line for line in lines if line.endswith(r"\\")]
        assert len(body) == len(rows), name
        assert {len(re.findall(r"(?<!\\)&", line)) for line in body} == {len(rows[0]) - 1}


def test_the_page_lists_only_buildings_that_are_off() -> None:
    worst = pd.DataFrame({"Building": list("abc"), "Points to mesh (m)": [np.nan, 0.4, 0.05]})
    assert list(report._off(worst, 0.25)["Building"]) == ["a", "b"]


def test_log_axes_have_plain_numbers() -> None:
    figure = figures.curves({"loss": pd.Series([30.0, 3.0, 0.3], [0, 1, 2])}, "step", "losses")
    figure.canvas.draw()
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels(which="both")]
    assert "10" in labels and not any("$" in label for label in labels)


def test_a_bad_method_squeezes_no_other_in_the_figure() -> None:
    good = {name: np.linspace(0, 0.1, 50) for name in ("fit", "roofer")}
    figure = figures.cumulative(
        {**good, "constant": np.linspace(0, 9, 50)}, {**tables.METHOD_NAMES}, "x", "t"
    )
    assert figure.axes[0].get_xlim()[1] == pytest.approx(0.095)
    uri = figures.data_uri(figure)
    again = figures.cumulative({**good, "constant": np.linspace(0, 9, 50)}, {**tables.METHOD_NAMES}, "x", "t")
    assert uri == figures.data_uri(again)


def test_buildings_without_a_record_are_not_failures() -> None:
    frame = pd.DataFrame(
        {
            "dataset": "real",
            "method": "roofer",
            "status": ["not-recorded", "recorded-of-other-clouds", "no-roofer-mesh", "ok"],
            "num_triangles": [np.nan, np.nan, np.nan, 20.0],
        }
    )
    runs = [tables.Run("roofer", "recorded")]
    rows = tables.without_mesh(frame, runs, {"real": "Real"})
    assert dict(zip(rows["Reason"], rows["Instead"], strict=True)) == {
        "not-recorded": "not run",
        "recorded-of-other-clouds": "not run",
        "no-roofer-mesh": "no mesh",
    }
    assert tables._title(runs[0], frame[:1]) == "Roofer (not run: not-recorded)"
    # meshes that count, of other points: neither a failure nor a flat roof, and the column says so
    frame.loc[3, "status"] = "recorded-of-other-points"
    assert tables.without_mesh(frame, runs, {"real": "Real"}).equals(rows)
    title = "Roofer (recorded, from other points of the same buildings)"
    assert [tables._title(runs[0], part) for part in (frame, frame[3:])] == [title, title]


HOSTILE = r"50 % & #1_{x} $\alpha$ ~ ^ <b>"


def test_latex_is_balanced_and_escaped() -> None:
    frame = pd.DataFrame({"Name": [HOSTILE, "x"], "A_b": [1.23456, None], "n": [7, 8]})
    text = report._latex(frame, "A caption", "tab:x")
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(body) == 3 and all(len(re.findall(r"(?<!\\)&", line)) == 2 for line in body)
    assert r"1.23 & 7 \\" in body[1] and body[2] == r"x & -- & 8 \\" and r"A\_b" in body[0]
    rules = [line for line in text.splitlines() if "rule" in line]
    assert rules == [r"\toprule", r"\midrule", r"\bottomrule"]
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}")
    assert not [c for c in "#%_" if re.search(rf"(?<!\\){re.escape(c)}", "\n".join(body))]


def test_real_clouds_and_sources_have_names() -> None:
    named = {
        "Drawn LiDAR": {},
        "LiDAR HD": {"fetch": {"source": "geoplateforme"}},
        "LiDAR of my/ahn3.laz": {"fetch": {"folder": {"lidar": "my/ahn3.laz"}}},
        "AHN3": {"fetch": {"source": "geoplateforme"}, "eval": {"lidar_name": "AHN3"}},
    }
    for title, config in named.items():
        assert report.titles(load(config))["real"] == title
    drawn, mine = report.attribution(load({"eval": {"attribution": ["mine"]}}))
    assert "Drawn by p2wss towns" in drawn and mine == "mine"
    member = {"name": "city", "region": {"vintage": "2026"}, "fetch": {"source": "geoplateforme"}}
    config = load({"dataset": {"members": [member, {"name": "mini"}]}})
    line, drawn = report.attribution(config)
    assert "Drawn" in drawn
    assert "IGN" in line and "(2026)" in line and "Licence Ouverte" in line


def test_manifest_that_names_a_missing_shard_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "manifest.json"
    path.write_text('{"shards": [{"path": "gone.parquet", "dataset": "simulated"}]}')
    with pytest.raises(InputError, match=r"gone\.parquet, which does not exist"):
        read_manifest(path)
    path.write_text("[]")
    with pytest.raises(InputError, match="not a manifest"):
        read_manifest(path)


def test_the_comparison_leaves_out_methods_and_measures_without_a_value_and_marks_the_best() -> None:
    rows = [*report.COMPARED, *(f"{name}, 95 % {end}" for name in report.LEAST for end in ("low", "high"))]
    more = pd.DataFrame({"Measure": rows, "Real / A": 1.0, "Real / B": 2.0, "Real / C": np.nan})
    more.loc[more["Measure"].str.contains("roof edges"), ["Real / A", "Real / B"]] = np.nan
    more.loc[more["Measure"] == "Buildings", "Real / C"] = 5.0
    (table,) = report._comparisons(more, {"simulated": "Simulated", "real": "Real"}).values()
    assert list(table["Method"]) == ["A", "B"]
    assert list(table) == ["Method", *(name for name in report.COMPARED if "roof edges" not in name)]
    assert list(table["CD (m)"]) == ["*1.000 (1.000 to 1.000)*", "2.000 (2.000 to 2.000)"]
