"""``p2wss inspect`` of the inputs of a run: the control houses, described right or refused as a run would."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import control_houses as houses
import numpy as np
import pyogrio
import pytest

from p2wss import cli

PLACE = "EPSG:26910"


@pytest.fixture
def footprints(tmp_path: Path) -> Path:
    """A layer of addresses beside both houses, one of which is there twice."""
    frame = houses.footprints(PLACE, height=[8.36, 6.0])
    frame.set_geometry(frame.centroid).to_file(tmp_path / "f.gpkg", layer="addresses")
    frame.iloc[[0, 1, 1]].to_file(tmp_path / "f.gpkg", layer="houses")
    return tmp_path / "f.gpkg"


def looked(capsys: pytest.CaptureFixture[str], *arguments: Any) -> tuple[int, dict[str, Any], str]:
    """(exit status, facts, standard error)."""
    status = cli.main(["inspect", "--json", *map(str, arguments)])
    output = capsys.readouterr()
    return status, json.loads(output.out or "{}"), output.err


@pytest.mark.parametrize("crs", [PLACE, "EPSG:3857", "EPSG:4326"])
def test_what_is_believed(
    footprints: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], crs: str
) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", PLACE, crs)
    terrain = houses.write_terrain(tmp_path / "t.tif", houses.heights_m().astype(np.float32) + 1, PLACE)
    status, facts, _ = looked(capsys, cloud, footprints, terrain)
    assert status == 0
    assert facts["footprints"]["layer"] == "houses" and facts["footprints"]["other layers"] == ["addresses"]
    assert facts["footprints"]["buildings by status"] == {"ok": 2, "duplicate": 1}
    assert facts["points"]["of these with points"] == facts["points"]["footprints looked at"] == 2
    # a point per 0.8 m x 0.8 m
    assert facts["points"]["points per m2 on footprints, median"] == pytest.approx(1 / 0.64, rel=0.1)
    assert set(facts["points"]["read, by class"]) == {"2", "6"}
    assert facts["heights"]["ground, median, m"] == pytest.approx(houses.GROUND_M, abs=0.1)
    # half of the gable roof is above 6.68 m, the other one is at 6 m
    assert facts["heights"]["roofs above the ground, median, m"] == pytest.approx(6.34, abs=0.2)
    assert facts["terrain"]["above the ground of the points, median, m"] == pytest.approx(1, abs=0.1)
    scale = facts["crs"].get("length of a metre on the ground in that CRS", "")
    assert {PLACE: "0.99960", "EPSG:3857": "1.25"}.get(crs, "") in scale and (crs == "EPSG:4326") == (
        not scale
    )


def test_a_format_without_a_number_of_features_states_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", PLACE, PLACE)
    houses.footprints(PLACE).to_file(tmp_path / "f.gml", driver="GML")
    assert pyogrio.read_info(tmp_path / "f.gml")["features"] == -1
    status, facts, _ = looked(capsys, cloud, tmp_path / "f.gml")
    assert status == 0 and "features" not in facts["footprints"]
    assert facts["footprints"]["buildings by status"] == {"ok": 2}


def test_inputs_that_a_run_would_refuse(
    footprints: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", PLACE, height_unit_m=houses.FOOT_M)
    status, facts, error = looked(capsys, cloud, footprints)
    assert status == 2 and "state --height-unit ft" in error
    assert facts["heights"]["roofs by stated heights, median ratio"] == pytest.approx(3, abs=0.1)
    assert facts["crs"]["unit of heights of clouds"] == "1 m, assumed"
    status, facts, _ = looked(capsys, "--height-unit", "ft", cloud, footprints)
    assert status == 0 and facts["crs"]["unit of heights of clouds"] == "0.3048 m, stated"
    status, facts, error = looked(capsys, "--height-unit", "ft", cloud, footprints, "--layer", "trees")
    assert status == 2 and "has no layer trees; its layers are" in error


def test_files_that_are_no_inputs_of_one_run_are_described_alone(
    footprints: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", PLACE)
    assert cli.main(["inspect", "--json", str(footprints), str(cloud)]) == 0
    kinds = [json.loads(line)["kind"] for line in capsys.readouterr().out.splitlines()]
    assert kinds == ["vector, GPKG", "point cloud, LAZ"]
