"""The evaluation on a hamlet with known buildings, with a predictor that knows the truth."""

from __future__ import annotations

import csv
import io as text_io
import json
import re
import stat
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trimesh
from all_cases import all_test_cases
from truth_network import TruthNetwork

from p2wss import cli
from p2wss.config import Eval, Reconstruct
from p2wss.data.building import no_mesh
from p2wss.errors import InputError
from p2wss.eval import (
    baselines,
    cases,
    measure,
    parameters,
    predict,
    report,
    roofer,
    roofer_command,
    tables,
    texts,
)
from p2wss.eval.recording import write_recording
from p2wss.nets import predictor as predictor_module
from p2wss.nets import weights
from p2wss.reconstruct.flat import lod1
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS, REAL, SIMULATED
from p2wss.storage.schemas.manifest import Manifest, Shard, read_manifest
from p2wss.storage.schemas.measures import MEASURES
from p2wss.storage.schemas.reconstructions import (
    RECONSTRUCTIONS,
    read_reconstructions,
    reconstruction_columns,
)

ROOFER = Path(__file__).with_name("toy_roofer.py")
CONFIG, RECONSTRUCT = Eval(num_resamples=50, num_pictures=1), Reconstruct()


@pytest.fixture(scope="module")
def hamlet_cases(hamlet: Path) -> list[cases.Case]:
    return all_test_cases(hamlet)


def test_cases_are_the_test_split_and_all_real_lidar_in_metres(hamlet_cases: list[cases.Case]) -> None:
    assert [c.dataset for c in hamlet_cases] == ["simulated"] * 16 + ["real"] * 12
    first = hamlet_cases[0]
    assert first.building.building_id == "b24" and first.eave_height_m == 4.0
    assert first.building.rings[0].tolist() == [[-5, -5], [7, -5], [7, 3], [-5, 3]]
    on_ground = first.building.point_m[first.building.classification == 2]
    assert on_ground[:, 2].mean() == pytest.approx(first.building.ground_z_m, abs=0.03)
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
    predictor = TruthNetwork(hamlet_cases, wrong_m=0.25)
    rows = predict.predict(hamlet_cases, predictor, RECONSTRUCT)
    errors = parameters.masked_errors(hamlet_cases, rows, predictor, medians, RECONSTRUCT)
    fixed, masked = errors["settings"]["footprint_given"], errors["settings"]["all_masked"]
    assert (errors["num_buildings"], errors["num_left_out"]) == (16, 0)
    assert fixed["height_m"]["mean"] == pytest.approx(0.25) and fixed["height_m"]["std"] < 1e-5
    assert fixed["height_m"]["count"] == 16 and fixed["angle_deg"]["mean"] == pytest.approx(0, abs=1e-5)
    assert masked["coordinate_m"]["mean"] == pytest.approx(0.15)  # 0.3 in x, 0 in y
    assert masked["vertex_m"]["mean"] == pytest.approx(0.3)
    assert errors["settings"]["all_masked_signs"]["vertex_m"]["mean"] == pytest.approx(0.6)
    fitted = errors["settings"]["all_masked_fit"]
    assert (
        fitted["coordinate_m"]["mean"] < 0.2
        and fitted["coordinate_m"]["count"] == masked["coordinate_m"]["count"]
    )
    assert fitted["height_m"]["mean"] < 0.05 and fitted["angle_deg"]["mean"] < 3
    truth = [case.eave_height_m for case in hamlet_cases[:16]]
    assert errors["settings"]["constant"]["height_m"]["mean"] == pytest.approx(
        np.abs(np.array(truth) - medians.eave_height_m).mean()
    )
    table = tables.table_1(errors)
    assert table[1][:4] == ["Height (m)", 0.23, 0.9, pytest.approx(0.25)]


def test_the_truth_measures_better_than_a_flat_roof(hamlet_cases: list[cases.Case]) -> None:
    ours = predict.predict(hamlet_cases[:16], TruthNetwork(hamlet_cases), RECONSTRUCT)
    flat = predict.by_dataset(hamlet_cases[:16], lod1, RECONSTRUCT)
    for case, good, bad in zip(hamlet_cases, ours, flat, strict=False):
        a, b = (measure.measure_building(case, reconstruction, CONFIG) for reconstruction in (good, bad))
        assert a["points_to_mesh_m"] < 0.04  # the noise is 0.03 m
        assert a["roof_chamfer_m"] < 0.4 and a["watertight"] and a["oriented"]
        assert a["height_error_m"] == pytest.approx(0, abs=1e-4)
        if case.roof_type != "flat":
            assert b["points_to_mesh_m"] > a["points_to_mesh_m"] and b["chamfer_m"] > a["chamfer_m"]


def test_measures_do_not_depend_on_order_or_on_the_rest(hamlet_cases: list[cases.Case]) -> None:
    flat = predict.by_dataset(hamlet_cases, lod1, RECONSTRUCT)
    methods = {"lod1": {case.key: row for case, row in zip(hamlet_cases, flat, strict=True)}}
    forth = list(measure.measure(hamlet_cases, methods, CONFIG))
    back = list(measure.measure(hamlet_cases[::-1][:9], methods, CONFIG))
    assert back == forth[::-1][:9]
    few = measure.subset(hamlet_cases[0], hamlet_cases[0].building.point_m, Eval(max_num_points=100))
    assert len(np.unique(few, axis=0)) == 100


def test_reconstructions_survive_the_file(hamlet_cases: list[cases.Case], tmp_path: Path) -> None:
    reconstructions = predict.by_dataset(hamlet_cases, lod1, RECONSTRUCT)
    reconstructions[3] = no_mesh(hamlet_cases[3].building, "lod1", "no-height")
    probability = np.random.default_rng(0).dirichlet([1, 1, 1], sum(map(len, reconstructions[4].rings)))
    reconstructions[4] = replace(reconstructions[4], class_probability=probability)
    path = tmp_path / "r.parquet"
    files.write_table(
        path, reconstruction_columns(reconstructions, [c.dataset for c in hamlet_cases]), RECONSTRUCTIONS, {}
    )
    back = read_reconstructions(path)
    for case, before in zip(hamlet_cases, reconstructions, strict=True):
        after = back[case.key]
        assert before.has_mesh == after.has_mesh
        for name in ("vertex_m", "triangle", "kind", "label") if before.has_mesh else ():
            assert np.array_equal(getattr(before.mesh, name), getattr(after.mesh, name))
        assert (before.status, before.ground_z_m) == (after.status, after.ground_z_m)
        assert all(map(np.array_equal, before.rings, after.rings))
        if before.class_probability is None:
            assert after.class_probability is None
        else:
            assert np.allclose(before.class_probability, after.class_probability, atol=1e-6)
    row = measure.measure_building(hamlet_cases[3], back[hamlet_cases[3].key], CONFIG)
    assert row["status"] == "no-height" and row["chamfer_m"] is None and row["watertight"] is None


def measures(rows: list[dict[str, object]]) -> pa.Table:
    base = {field.name: None for field in MEASURES}
    return pa.Table.from_pylist([base | row for row in rows], schema=MEASURES)


def test_table_2_has_the_papers_rows_and_figures() -> None:
    rows = [
        {
            "dataset": "simulated",
            "method": "point2wss",
            "chamfer_m": cd,
            "num_triangles": t,
            "watertight": True,
        }
        for cd, t in ((1.0, 10), (2.0, 20), (4.0, 60))
    ]
    rows.append({"dataset": "simulated", "method": "point2wss", "status": "no height"})
    details = tables.details(measures(rows), CONFIG)
    runs = [tables.Run("point2wss", "ok"), tables.Run("roofer", "not run: program roofer not found")]
    table = tables.table_2(tables.columns_2(details, runs), report.dataset_names(CONFIG))
    assert (details[0].num_buildings, details[0].num_without_mesh) == (4, 1)
    assert [row[0] for row in table] == ["Statistic", *tables.ROWS_2]
    ours = [row[table[0].index("Simulated / Point2WSS")] for row in table[1:]]
    expected = [7 / 3, 1.5, 2.0, 3.0, np.std([1, 2, 4]), 30, np.std([10, 20, 60])]
    assert ours == pytest.approx(expected)
    paper = [row[table[0].index("HD LiDAR / paper: Ours")] for row in table[1:]]
    assert paper == [2.14, 0.98, 1.55, 2.45, 2.23, 17.3, 5.2]
    not_run = next(i for i, name in enumerate(table[0]) if "not run" in name)
    assert all(row[not_run] is None for row in table[1:])
    read = list(csv.reader(text_io.StringIO(texts.to_csv(table))))
    assert len({len(row) for row in read}) == 1 and read[1][not_run] == ""


def test_roofer_is_run_and_read_back(hamlet_cases: list[cases.Case], tmp_path: Path) -> None:
    """A toy program in place of Roofer: boxes up to the highest point, from the real input files."""
    program = tmp_path / "roofer"
    program.write_text(f"#!{sys.executable}\n{ROOFER.read_text()}")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    tool = roofer_command.find(str(program))
    assert isinstance(tool, roofer_command.Roofer) and tool.version == "toy 1.0"
    reconstructions = roofer.run(tool, hamlet_cases, {"simulated": "EPSG:2154", "real": "EPSG:2154"}, CONFIG)
    for case, reconstruction in zip(hamlet_cases, reconstructions, strict=True):
        mesh = trimesh.Trimesh(reconstruction.mesh.vertex_m, reconstruction.mesh.triangle)
        top = case.building.point_m[:, 2].max() - case.building.ground_z_m
        assert reconstruction.status == "ok" and mesh.is_watertight and mesh.volume > 0
        assert mesh.bounds[1, 2] == pytest.approx(top, abs=0.011)
        # the bounding box of the footprint, in the frame of the building
        assert mesh.bounds[0, :2] == pytest.approx(case.building.rings[0].min(axis=0), abs=0.011)


def test_kept_outputs_of_roofer_can_be_read_as_recorded(
    hamlet: Path, hamlet_cases: list[cases.Case], tmp_path: Path
) -> None:
    program = tmp_path / "roofer"
    program.write_text(f"#!{sys.executable}\n{ROOFER.read_text()}")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    folder = tmp_path / "kept"
    config = CONFIG.model_copy(update={"roofer_command": str(program), "roofer_keep": str(folder)})
    crs = {"simulated": "EPSG:2154", "real": "EPSG:2154"}
    tool = roofer_command.find(str(program))
    assert isinstance(tool, roofer_command.Roofer)
    runs = [roofer.run(tool, hamlet_cases, crs, config) for _ in range(2)]
    without_program = Eval(roofer_command="no-such-program-as-roofer", roofer_recorded=str(folder))
    paths = roofer_command.recorded_files(without_program)
    assert len(paths) == 1  # a second run replaces the output of the first
    real = [case for case in hamlet_cases if case.dataset == REAL]
    recording = write_recording(paths, read_manifest(hamlet), tmp_path / "recording.parquet")
    assert recording.num_evaluated == len(real) and recording.names == paths[0].name
    assert not recording.solids(["no such building"])
    # parsed and judged once for all groups of shards: one of them without any recorded building is no other place
    recorded = roofer.recorded(recording, hamlet_cases)
    assert real and set(recorded) == {case.key for case in real}
    for case, reconstruction in zip(hamlet_cases, runs[1], strict=True):
        if case.dataset == REAL:
            np.testing.assert_array_equal(recorded[case.key].mesh.vertex_m, reconstruction.mesh.vertex_m)
            np.testing.assert_array_equal(recorded[case.key].mesh.triangle, reconstruction.mesh.triangle)
    # those of simulated buildings, which may have the same ids, are in a folder of their own
    assert len(list((folder / SIMULATED).glob("*.city.jsonl"))) == 1


def test_roofer_that_fails_or_is_absent_gives_no_reconstruction(
    hamlet: Path, hamlet_cases: list[cases.Case], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    program = tmp_path / "roofer"
    program.write_text("#!/bin/sh\necho no memory >&2\nexit 3\n")
    program.chmod(0o755)
    manifest = read_manifest(hamlet)
    tool = roofer_command.Roofer([str(program)], "x")
    reconstructions = roofer.run(tool, hamlet_cases[:2], manifest.crs(), CONFIG)
    assert [row.status for row in reconstructions] == ["roofer-failed"] * 2
    assert not reconstructions[0].has_mesh
    assert "failed with exit status 3 on tile" in caplog.text and "no memory" in caplog.text
    absent = Eval(roofer_command=str(tmp_path / "nothing"))
    rows, facts = baselines.baseline("roofer", hamlet_cases, manifest, absent, RECONSTRUCT)
    assert rows == {} and facts["status"].startswith("not run: program")
    assert roofer_command.find("") == "not run: eval.roofer_command is empty"
    with pytest.raises(InputError, match="choose lod1"):
        baselines.baseline("lod2", hamlet_cases, manifest, CONFIG, RECONSTRUCT)


WEIGHTS_FACTS = {"version": "1", "code": "4567", "config": {}, "dvae_config": {}}


NAMES = ("point2wss", "point2wss+fit", "fit", "lod1", "constant", "roofer")
SETTINGS = json.dumps(
    {"eval": {"roofer_command": "", "num_pictures": 1, "num_worst": 3, "lidar_name": "stand-in <LiDAR>"}}
)


def run(*arguments: object) -> None:
    settings = [] if arguments[0] == "medians" else ["--config", SETTINGS]
    assert cli.main(["eval", *map(str, arguments), *settings]) == 0


def evaluate(manifest: Path, groups: list[list[Path]], folder: Path) -> list[Path]:
    """The commands as the rules run them, per group of shards, and their merge into ``folder``."""
    run("medians", "--manifest", manifest, "--out", folder / "medians.json")
    medians, model = ["--medians", folder / "medians.json"], ["--model", folder / "model.safetensors"]
    parts = [folder / "parts" / f"{number:04d}" for number in range(len(groups))]
    for part, shards in zip(parts, groups, strict=True):
        of_group = ["--manifest", manifest, "--shards", *shards]

        def outputs(name: str, part: Path = part) -> list[object]:
            return ["--out", part / f"{name}.parquet", "--out-cpu", part / "cpu" / f"{name}.json"]

        errors = ["--out-errors", part / "masked_errors.json"]
        run("predict", *of_group, *model, *medians, *outputs("point2wss"), *errors)
        run("fit", *of_group, *model, *outputs("point2wss+fit"))
        run("fit", *of_group, *outputs("fit"))
        for name in ("lod1", "constant", "roofer"):
            run("baseline", "--name", name, *of_group, *medians, *outputs(name))
        rows = [part / f"{name}.parquet" for name in NAMES]
        errors = ["--out-errors", part / "variant_errors.json"]
        run("measure", *of_group, "--reconstructions", *rows, "--out", part / "measures.parquet", *errors)
    merged = [f(name) for name in ("measures.parquet", "parameters.json", "methods.json")
              for f in (lambda name: f"--out-{name.split('.')[0]}", lambda name: folder / name)]  # fmt: skip
    run("merge", "--parts", *parts, "--methods", *NAMES, *merged)
    return parts


def report_of(manifest: Path, folder: Path, parts: list[Path], *others: object) -> None:
    merged = ["--measures", folder / "measures.parquet", "--parameters", folder / "parameters.json"]
    merged += ["--methods", folder / "methods.json"]
    run("report", "--out", folder, "--manifest", manifest, *merged, "--parts", *parts, *others)


@pytest.fixture
def true_weights(hamlet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights of a predictor that knows the truth."""
    predictor = TruthNetwork(all_test_cases(hamlet), 0.1)
    monkeypatch.setattr(predictor_module, "load_predictor", lambda path, device: predictor)
    monkeypatch.setattr(weights, "read_weights", lambda path, kind: ({}, WEIGHTS_FACTS))


@pytest.mark.usefixtures("true_weights")
def test_groups_of_shards_give_the_same_tables_as_all_shards_at_once(hamlet: Path, tmp_path: Path) -> None:
    shards = [hamlet.parent / "a.parquet", hamlet.parent / "b.parquet"]
    folders = [tmp_path / "whole", tmp_path / "split"]
    for folder, groups in zip(folders, ([shards], [[shard] for shard in shards]), strict=True):
        parts = evaluate(hamlet, groups, folder)
        report_of(hamlet, folder, parts, "--metrics")
    whole, split = (pq.read_table(folder / "measures.parquet") for folder in folders)
    assert whole.equals(split) and len(whole) == 5 * 28
    whole, split = (files.read_json(folder / "parameters.json") for folder in folders)
    assert whole["num_buildings"] == split["num_buildings"] == 16
    for setting, errors in whole["settings"].items():
        for name, error in errors.items():
            assert split["settings"][setting][name] == pytest.approx(error)
    for name in report.CAPTIONS:
        whole, split = ((folder / f"{name}.csv").read_text() for folder in folders)
        timeless = [[line for line in text.splitlines() if "CPU" not in line] for text in (whole, split)]
        assert timeless[0] == timeless[1], name


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
    measured = pq.read_table(tmp_path / "with" / "measures.parquet")
    assert measured["dataset"].unique().to_pylist() == ["simulated"] and len(measured) == 5 * 16
    methods = {m["method"]: m for m in files.read_json(tmp_path / "with" / "methods.json")["methods"]}
    assert {name: m["status"] for name, m in methods.items() if name != "roofer"} == dict.fromkeys(
        NAMES[:-1], "ok"
    )
    assert list(methods["fit"]["cpu_ms"]) == ["simulated"]


def test_a_shard_that_the_manifest_does_not_list_is_one_clear_line(hamlet: Path) -> None:
    with pytest.raises(InputError, match=r"does not list .*manifest\.json; run the stage crops again"):
        read_manifest(hamlet, [hamlet])
    (only,) = read_manifest(hamlet, [hamlet.parent / "b.parquet"]).shards
    assert only.dataset == "real"


@pytest.mark.usefixtures("true_weights")
def test_report_from_files_is_one_self_contained_page(hamlet: Path, tmp_path: Path) -> None:
    """The commands as the rules run them, with a predictor that knows the truth."""
    parts = evaluate(hamlet, [[hamlet.parent / "a.parquet", hamlet.parent / "b.parquet"]], tmp_path)
    training = tmp_path / "model" / "metrics.jsonl"
    (tmp_path / "0652_6862.png").write_bytes(b"\x89PNG of a scan")
    training.parent.mkdir()
    training.write_text("".join(json.dumps({"step": i, "loss": 9 / (i + 1)}) + "\n" for i in range(5)))
    report_of(hamlet, tmp_path, parts, "--metrics", training, "--scans", tmp_path / "0652_6862.png")
    page = (tmp_path / "report.html").read_text()
    # nothing is loaded from elsewhere: scripts, style sheets and images are embedded in the page
    assert not re.search(r"<script[^>]* src|<link|@import|url\(", page)
    assert 'id="viewer-data"' in page
    sources = re.findall(r'src="([^"]{0,30})', page)
    assert sources and all(source.startswith("data:image/png;base64,") for source in sources)
    assert "stand-in &lt;LiDAR&gt;" in page and "stand-in <LiDAR>" not in page
    assert "not run: eval.roofer_command is empty" in page
    assert page.count("Simulated scan of tile 0652_6862") == 1
    assert "no real data" in page and "4567" in page
    assert (tmp_path / "table1.csv").read_text().startswith("Parameter,Paper MAE")
    assert "mu_CD" in (tmp_path / "table2.csv").read_text()


def test_manifest_that_names_a_missing_shard_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "manifest.json"
    path.write_text('{"shards": [{"path": "gone.parquet", "dataset": "simulated"}]}')
    with pytest.raises(InputError, match=r"gone\.parquet, which does not exist"):
        read_manifest(path)
    path.write_text("[]")
    with pytest.raises(InputError, match="not a manifest"):
        read_manifest(path)
