"""Our measures of Roofer's recorded outputs on real LiDAR against an independent judge."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import shapely
from places import SHARED
from scipy.spatial import cKDTree

from p2wss.config import Config, Eval, Reconstruct, load, roofer_command
from p2wss.crops.rows import crop_real
from p2wss.data.building import Reconstruction
from p2wss.eval import cases, measure, methods, tables
from p2wss.footprints import cleaning
from p2wss.mesh.surface import sample_surface
from p2wss.reconstruction.product import lod1
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.crops import CROPS, REAL, SIMULATED

DATA = SHARED / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no real data beside the checkout")
ABSENT = "no-such-program-as-roofer"


def real_cases(folder: str, cloud: str, tile: str, crs: int) -> list[cases.Case]:
    """The buildings of a folder of real data, as the stage crops writes and the evaluation reads them."""
    config = Config()
    features = cleaning.read_footprints(DATA / folder / "footprints.gpkg")
    moved = Features.of(features.to_frame().to_crs(crs))
    features = cleaning.clean_footprints(moved, config.scenes)
    columns, _ = crop_real(features, [DATA / folder / cloud], tile, 1000, config.crops)
    table = pa.table({field.name: pa.array(columns[field.name], field.type) for field in CROPS})
    return cases.from_crops(table, REAL)


def recorded(folder: str, of_shard: list[cases.Case]) -> list[Reconstruction]:
    """Roofer's outputs in a folder of real data, for cases of one data set."""
    path = DATA / folder / "roofer_lod22.city.jsonl"
    config = load({"eval": {"roofer_command": ABSENT, "roofer_recorded": str(path)}})
    return methods.reconstruct("roofer", of_shard, methods.Inputs(config))


@pytest.fixture(scope="module")
def delft() -> list[cases.Case]:
    return real_cases("delft_ahn3", "ahn3.laz", "0084_0448", 28992)


@pytest.fixture(scope="module")
def solids(delft: list[cases.Case]) -> list[Reconstruction]:
    return recorded("delft_ahn3", delft)


@pytest.fixture(scope="module")
def rows(delft: list[cases.Case], solids: list[Reconstruction]) -> list[dict]:
    return [
        measure.measure_building(case, solid, Config()) for case, solid in zip(delft, solids, strict=True)
    ]


@needs_data
def test_measures_of_roofer_on_delft_agree_with_the_judge(
    delft: list[cases.Case], rows: list[dict], solids: list[Reconstruction]
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
    sampled = []
    for case, row, solid in zip(delft, rows, solids, strict=True):
        point = case.building.point_m[case.building.is_on_building]
        point = point + (case.building.position_m - solid.position_m)
        sample = sample_surface(solid.mesh.vertex_m, solid.mesh.triangle, 40_000, np.random.default_rng(0))
        sampled.append(cKDTree(sample).query(point)[0].mean())
        assert row["points_to_mesh_m"] < sampled[-1] < row["points_to_mesh_m"] + 0.08
    assert np.mean(sampled) == pytest.approx(0.118, abs=0.003)


@needs_data
def test_recorded_outputs_are_named_as_such_and_cover_only_real_buildings(
    delft: list[cases.Case], solids: list[Reconstruction]
) -> None:
    assert [solid.status for solid in solids] == ["ok"] * 74
    assert recorded("delft_ahn3", [replace(case, dataset=SIMULATED) for case in delft[:3]]) == []
    file = DATA / "delft_ahn3/roofer_lod22.city.jsonl"
    config = Eval(roofer_command=ABSENT, roofer_recorded=str(file))
    assert roofer_command.facts(config) == {"status": "recorded", "note": f"recorded: {file.name}"}
    assert tables.Run("roofer", "recorded").name == "Roofer (recorded)"
    in_folder = config.model_copy(update={"roofer_recorded": str(file.parent)})
    assert roofer_command.recorded_files(in_folder) == [file]


@needs_data
def test_buildings_that_are_not_recorded_or_that_roofer_skips_are_without_a_mesh(
    delft: list[cases.Case],
) -> None:
    assert {row.status for row in recorded("bresse_ign", delft[:3])} == {"not-recorded"}
    bresse = recorded("bresse_ign", real_cases("bresse_ign", "lidar.laz", "0870_6618", 2154))
    assert len(bresse) == 6 and sum(row.has_mesh for row in bresse) == 5
    (skipped,) = [row for row in bresse if not row.has_mesh]
    assert skipped.status == "no-roofer-mesh"


def test_the_state_changes_when_roofer_is_installed_or_updated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rule has the state among its parameters: it runs again when the program, or its version, changes."""
    config = Eval(roofer_command="roofer-of-test")
    # the miniature's, by default
    tiles = ("0653_6861", "0652_6861", "0652_6862", "0653_6862")
    names = {*(f"{tile}.0.city.jsonl" for tile in tiles), "clouds.json"}
    assert set(roofer_command.state(config).removeprefix("recorded: ").split(", ")) == names
    # in a folder without them they are none
    monkeypatch.chdir(tmp_path)
    assert roofer_command.state(config) == "not run: cannot start 'roofer-of-test'"
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
def test_height_rmse_of_flat_roofs_on_delft(delft: list[cases.Case]) -> None:
    """The heights over a flat roof are differences from a single number."""
    few = delft[:8]
    for case, flat in zip(few, lod1([c.building for c in few], Reconstruct()), strict=True):
        row = measure.measure_building(case, flat, Config(eval=Eval(num_samples=64)))
        assert flat.eave_height_m is not None
        z = case.building.point_m[case.building.is_on_building][:, 2]
        above = z - flat.eave_height_m
        xy = case.building.point_m[case.building.is_on_building][:, :2]
        inner = shapely.distance(case.building.polygon.boundary, shapely.points(xy)) >= 0.5
        assert row["height_rmse_m"] == pytest.approx(np.sqrt((above[inner] ** 2).mean()), abs=1e-5)
        assert row["density_per_m2"] > 1 and row["planar"] and row["manifold"]
