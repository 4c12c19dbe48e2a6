"""Our measures of Roofer's recorded outputs on real LiDAR against an independent judge."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import shapely
from places import SHARED
from scipy.spatial import cKDTree

from p2wss import crops, scenes
from p2wss.config import Config, Eval, Reconstruct
from p2wss.errors import InputError
from p2wss.eval import baselines, cases, measure, roofer, roofer_command, tables
from p2wss.eval.recording import Recording, write_recording
from p2wss.mesh.surface import sample_surface
from p2wss.reconstruct.flat import lod1
from p2wss.storage.schemas.crops import CROPS, REAL, SIMULATED
from p2wss.storage.schemas.manifest import Manifest

DATA = SHARED / "data"
JUDGE = SHARED / "tools" / "evaluate_cityjson.py"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no real data beside the checkout")
ABSENT = "no-such-program-as-roofer"


def real_cases(folder: str, cloud: str, tile: str, crs: int) -> list[cases.Case]:
    """The buildings of a folder of real data, as the stage crops writes and the evaluation reads them."""
    config = Config()
    frame = scenes.read_footprints(DATA / folder / "footprints.gpkg")
    frame = scenes.clean_footprints(frame.to_crs(crs), config.scenes)
    columns, _ = crops.crop_real(frame, [DATA / folder / cloud], tile, 1000, config.crops)
    table = pa.table({field.name: pa.array(columns[field.name], field.type) for field in CROPS})
    return cases.from_crops(table, REAL)


def recording(folder: str, tmp_path: Path, evaluated: bool = True) -> Recording:
    """Roofer's outputs in a folder of real data. evaluated: whether they are of the data set, which has no manifest."""
    path = DATA / folder / "roofer_lod22.city.jsonl"
    return replace(
        write_recording([path], Manifest([]), tmp_path / f"{folder}.parquet"), num_evaluated=int(evaluated)
    )


@pytest.fixture(scope="module")
def delft() -> list[cases.Case]:
    return real_cases("delft_ahn3", "ahn3.laz", "0084_0448", 28992)


@pytest.fixture(scope="module")
def rows(delft: list[cases.Case], tmp_path_factory: pytest.TempPathFactory) -> list[dict]:
    tmp_path = tmp_path_factory.mktemp("recording")
    recorded = roofer.recorded(recording("delft_ahn3", tmp_path), delft)
    return list(measure.measure(delft, {"roofer": recorded}, Eval()))


@needs_data
def test_measures_of_roofer_on_delft_agree_with_the_judge(
    delft: list[cases.Case], rows: list[dict], tmp_path: Path
) -> None:
    """The judge: CD 0.914, roof CD 0.243, points to mesh 0.118 m, 62.5 triangles, 74 of 74 meshes closed."""
    assert len(rows) == 74 and all(row["status"] == "ok" and row["watertight"] for row in rows)
    mean = {
        name: np.mean([row[name] for row in rows])
        for name in ("chamfer_m", "roof_chamfer_m", "num_triangles")
    }
    assert mean["chamfer_m"] == pytest.approx(0.914, abs=0.012)  # three seeds of the judge: 0.907 to 0.914
    assert mean["roof_chamfer_m"] == pytest.approx(0.243, abs=0.005)
    assert mean["num_triangles"] == pytest.approx(62.486, abs=0.001)
    # the judge measures the distance to 40,000 samples of the mesh, as is done here; ours is exact, so smaller
    recorded = roofer.recorded(recording("delft_ahn3", tmp_path), delft)
    sampled = []
    for case, row in zip(delft, rows, strict=True):
        solid = recorded[case.key]
        point = measure.local_points(case, solid)[case.building.is_on_building]
        sample = sample_surface(solid.mesh.vertex_m, solid.mesh.triangle, 40_000, np.random.default_rng(0))
        sampled.append(cKDTree(sample).query(point)[0].mean())
        assert row["points_to_mesh_m"] < sampled[-1] < row["points_to_mesh_m"] + 0.08
    assert np.mean(sampled) == pytest.approx(0.118, abs=0.003)


@needs_data
@pytest.mark.slow
@pytest.mark.skipif(not JUDGE.is_file(), reason="no judge beside the checkout")
def test_measures_of_every_building_agree_with_the_judge(rows: list[dict]) -> None:
    folder = DATA / "delft_ahn3"
    files = [folder / name for name in ("roofer_lod22.city.jsonl", "footprints.gpkg", "ahn3.laz")]
    command = [sys.executable, JUDGE, *files, "--json"]
    completed = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=True)
    judged = {row["id"]: row for row in json.loads(completed.stdout)["rows"]}
    assert len(judged) == len(rows)
    difference_m: list[float] = []
    for row in rows:
        other = judged[row["building_id"]]
        assert row["num_triangles"] == other["tri"] and row["watertight"] == other["watertight"]
        # two draws of 2048 samples
        assert row["chamfer_m"] == pytest.approx(other["cd"], abs=0.06)
        difference_m.append(abs(row["roof_chamfer_m"] - other["roof"]))
    # at one house the cleaned footprint excludes points that the judge counts
    assert sorted(difference_m)[-2] < 0.01 and max(difference_m) < 0.04


@needs_data
def test_recorded_outputs_are_named_as_such_and_cover_only_real_buildings(
    delft: list[cases.Case], tmp_path: Path
) -> None:
    simulated = [cases.Case(SIMULATED, *list(vars(case).values())[1:]) for case in delft[:3]]
    file = DATA / "delft_ahn3/roofer_lod22.city.jsonl"
    config = Eval(roofer_command=ABSENT, roofer_recorded=str(file))
    reconstructions, facts = baselines.baseline(
        "roofer",
        [*simulated, *delft],
        Manifest([]),
        config,
        Reconstruct(),
        recording=recording("delft_ahn3", tmp_path),
    )
    assert set(reconstructions) == {case.key for case in delft}
    assert facts["status"] == "recorded" and file.name in facts["roofer"]
    assert tables.Run("roofer", facts["status"]).name == "Roofer (recorded)"
    assert roofer_command.state(config) == f"recorded: {file.name}"
    assert roofer_command.recorded_files(Eval(roofer_command=ABSENT, roofer_recorded=str(file.parent))) == [
        file
    ]


@needs_data
def test_recorded_outputs_of_another_place_do_not_count_as_failures(
    delft: list[cases.Case], tmp_path: Path
) -> None:
    elsewhere = recording("bresse_ign", tmp_path, evaluated=False)
    config = Eval(roofer_command=ABSENT)
    reconstructions, facts = baselines.baseline(
        "roofer", delft, Manifest([]), config, Reconstruct(), recording=elsewhere
    )
    assert reconstructions == {} and facts["status"].startswith("not run, and none of the buildings")


@needs_data
def test_a_building_that_roofer_skips_counts_as_without_a_mesh(tmp_path: Path) -> None:
    bresse = real_cases("bresse_ign", "lidar.laz", "0870_6618", 2154)
    recorded = roofer.recorded(recording("bresse_ign", tmp_path), bresse)
    assert len(recorded) == len(bresse) == 6
    assert sum(row.has_mesh for row in recorded.values()) == 5
    (skipped,) = [row for row in recorded.values() if not row.has_mesh]
    assert skipped.status == "no-roofer-mesh"


def test_the_state_changes_when_roofer_is_installed_or_updated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rule has the state among its parameters: it runs again when the program, or its version, changes."""
    config = Eval(roofer_command="roofer-of-test")
    assert roofer_command.state(config) == "not run: program roofer-of-test not found"
    program = tmp_path / "roofer-of-test"
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    states = []
    for version in ("1.0", "1.1"):
        program.write_text(f"#!/bin/sh\necho roofer {version}\n")
        program.chmod(0o755)
        states.append(roofer_command.state(config))
    assert states == ["roofer 1.0", "roofer 1.1"]
    # where Roofer can be run, recorded outputs are ignored
    with_program = config.model_copy(update={"roofer_recorded": str(tmp_path / "nothing")})
    assert roofer_command.recorded_files(with_program) == []
    with pytest.raises(InputError, match=r"roofer_recorded: .*nothing: no such file"):
        roofer_command.recorded_files(with_program.model_copy(update={"roofer_command": ABSENT}))


@needs_data
def test_height_rmse_and_far_share_of_flat_roofs_on_delft(delft: list[cases.Case]) -> None:
    """The heights over a flat roof are differences from a single number."""
    few = delft[:8]
    for case, flat in zip(few, lod1([c.building for c in few], Reconstruct()), strict=True):
        row = measure.measure_building(case, flat, Eval(num_samples=64))
        assert flat.eave_height_m is not None
        z = case.building.point_m[case.building.is_on_building][:, 2]
        above = z - flat.ground_z_m - flat.eave_height_m
        xy = case.building.point_m[case.building.is_on_building][:, :2]
        inner = shapely.distance(case.building.polygon.boundary, shapely.points(xy)) >= 0.5
        assert row["height_rmse_m"] == pytest.approx(np.sqrt((above[inner] ** 2).mean()), abs=1e-5)
        assert row["height_bias_m"] == pytest.approx(np.median(above[inner]), abs=1e-5)
        assert row["density_per_m2"] > 1 and row["planar"] and row["manifold"]
        # a point may be nearer to a wall than to the roof
        assert row["far_share"] <= (np.abs(above) > 0.5).mean() + 1e-9
