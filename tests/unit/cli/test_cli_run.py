"""Which buildings a run is of, how its files are called, and what its end says."""

from __future__ import annotations

import json
import logging
import re
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import geopandas as gpd
import pytest
import shapely

import p2wss
from p2wss import cli
from p2wss.cli import doctor
from p2wss.cli.demo import write_inputs
from p2wss.reconstruction import area
from p2wss.storage.arguments import EXTRAS


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    write_inputs(folder)
    return folder


def run(demo: Path, out: Path, *options: str) -> int:
    inputs = [str(demo / "lidar.laz"), str(demo / "footprints.gpkg"), str(out)]
    return cli.main(["reconstruct", *inputs, "--outputs", "cityjson", *options])


def test_buildings_are_chosen_by_id_and_by_a_box_in_metres_or_degrees(demo: Path, tmp_path: Path) -> None:
    footprints = gpd.read_file(demo / "footprints.gpkg").set_index("cleabs")
    first = footprints.index[5]
    assert run(demo, tmp_path, "--ids", first, "--name", "one") == 0
    assert list(p2wss.read(tmp_path / "one.city.json")) == [first]
    around = footprints.loc[[first]].buffer(1)
    for name, box in (("metres", around.total_bounds), ("degrees", around.to_crs(4326).total_bounds)):
        assert run(demo, tmp_path, "--bbox", *map(str, box), "--name", name) == 0
        assert first in p2wss.read(tmp_path / f"{name}.city.json")
    first_box, second_box = (p2wss.read(tmp_path / f"{name}.city.json") for name in ("metres", "degrees"))
    assert list(first_box) == list(second_box) and len(first_box) < 5


def test_an_unknown_id_and_an_empty_box_are_named(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for options, text in (
        (["--ids", "x"], "has no building x"),
        (["--bbox", "3", "45", "2", "46"], "is empty"),
    ):
        assert run(demo, tmp_path, *options) == 2
        error = capsys.readouterr().err.splitlines()
        assert text in error[-1] and not any("Traceback" in line for line in error)


@pytest.mark.parametrize("name", ["a/b", "../out", "/tmp/x", ".", ".."])
def test_a_name_of_files_with_a_folder_is_refused_before_anything_is_read(
    demo: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(demo, tmp_path / "new", "--name", name) == 2
    assert (
        capsys.readouterr().err
        == f"p2wss: error: name {name}: must be that of a file without ending, and no folder\n"
    )
    assert not (tmp_path / "new").exists()


def test_files_that_an_earlier_run_left_are_named(
    demo: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one = gpd.read_file(demo / "footprints.gpkg")["cleabs"][0]
    with caplog.at_level(logging.WARNING):
        assert run(demo, tmp_path, "--ids", one, "--outputs", "glb,gpkg") == 0
        assert "earlier run" not in caplog.text
        assert run(demo, tmp_path, "--ids", one) == 0
        assert "not of this one: lidar.glb, lidar.gpkg" in caplog.text
        caplog.clear()
        assert run(demo, tmp_path, "--ids", one) == 0
        assert "lidar.glb, lidar.gpkg" in caplog.text
        assert run(demo, tmp_path, "--ids", one, "--outputs", "sionna,obj") == 0
        caplog.clear()
        assert run(demo, tmp_path, "--ids", one) == 0
    assert caplog.text.endswith(".ply and 2 more\n")


def test_footprints_beyond_the_cloud_are_counted(
    demo: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    footprints = gpd.read_file(demo / "footprints.gpkg").iloc[:6].assign(hauteur=float("nan"))
    footprints.loc[footprints.index[2:], "geometry"] = footprints.geometry[2:].translate(900, 0)
    footprints.loc[footprints.index[4:], "geometry"] = [shapely.Polygon(), None]
    footprints.to_file(tmp_path / "footprints.gpkg")
    inputs = [str(demo / "lidar.laz"), str(tmp_path / "footprints.gpkg"), str(tmp_path / "out")]
    with caplog.at_level(logging.INFO):
        assert cli.main(["reconstruct", *inputs, "--outputs", "cityjson"]) == 0
    assert "warning: the cloud has no point at 2 of 6 footprints" in caplog.text
    counts = json.loads((tmp_path / "out/lidar.json").read_text(encoding="utf-8"))["buildings"]
    assert counts["without_points"] == 2 and {*footprints["cleabs"][2:]} <= {*counts["to_check"]}
    assert {*footprints["cleabs"][4:]} == {*counts["to_check"][:2]}  # without a mesh
    assert counts["doubts"] == {"height-from-attribute": 2, "empty": 2, "extended": 1}
    assert "1 need no look, 5 to check (2 empty, 2 height from attribute, 1 extended): " in caplog.text


def test_quiet_says_nothing_of_a_run_without_faults(
    demo: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one = gpd.read_file(demo / "footprints.gpkg")["cleabs"][0]
    assert run(demo, tmp_path, "--ids", one, "-q") == 0
    assert caplog.text == ""
    # of this command only
    with caplog.at_level(logging.INFO):
        assert run(demo, tmp_path, "--ids", one) == 0
    assert "1 buildings: 1 ok" in caplog.text


def test_verbose_names_buildings_and_files_with_times(
    demo: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one, two = gpd.read_file(demo / "footprints.gpkg")["cleabs"][:2]
    assert run(demo, tmp_path, "--ids", one, "-v") == 0
    (line,) = re.findall(f"{one}: ok, .*", caplog.text)
    assert re.fullmatch(r".*, \d+ points, 0\.\d+ m from the mesh, \d+\.\d+ s", line)
    assert f"{tmp_path / 'lidar.city.json'}: written, " in caplog.text
    assert run(demo, tmp_path, "--ids", two) == 0
    assert f"{two}: ok" not in caplog.text


def test_the_doctor_says_what_is_missing_for_what(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> str:
        if name.endswith("-slurm"):
            raise PackageNotFoundError
        return "1.0"

    monkeypatch.setattr(doctor, "version", missing)
    monkeypatch.setenv("PATH", "")
    assert cli.main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {line.split()[0] for line in lines} > {*EXTRAS, "p2wss", "cores", "pdal", "roofer"}
    slurm = next(line for line in lines if line.startswith("slurm"))
    assert slurm.endswith("invalid choice; pip install snakemake-executor-plugin-slurm")
    assert next(line for line in lines if line.startswith("pdal")).endswith("clouds that have no ground")


def test_an_interruption_is_one_line_also_within_compiled_code(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(path: Path) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise SystemError("CPUDispatcher returned a result with an exception set") from error

    monkeypatch.setattr(p2wss, "check", interrupted)
    assert cli.main(["check", "x.city.json"]) == 130
    assert capsys.readouterr().err == "p2wss: interrupted\n"


def test_a_mistyped_command_is_guessed_and_none_shows_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["recontruct"]) == 2
    assert "Did you mean 'reconstruct'?" in capsys.readouterr().err
    assert cli.main(["reconstruct", "--detial", "low"]) == 2
    assert "--detail" in capsys.readouterr().err
    assert cli.main([]) == 0
    assert capsys.readouterr().out.startswith("Usage: p2wss")


def test_a_budget_of_triangles_costs_the_least_accuracy(
    demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ids = ",".join(gpd.read_file(demo / "footprints.gpkg")["cleabs"][:12])

    def reconstructed(name: str, *options: str) -> dict[str, tuple[int, float, float]]:
        """Triangles, residual and area in plan of each building."""
        assert run(demo, tmp_path, "--ids", ids, "--name", name, *options) == 0
        names = ("num_triangles", "residual_m", "ground_area_m2")
        rows = p2wss.read(tmp_path / f"{name}.city.json").items()
        return {key: tuple(building.attributes[each] for each in names) for key, building in rows}

    high, low = reconstructed("high", "--detail", "high"), reconstructed("low", "--detail", "low")
    most, least = (sum(row[0] for row in rows.values()) for rows in (high, low))
    limit = (most + least) // 2
    # footprints beside the chosen ones are reconstructed, too, and not counted
    enough = reconstructed("enough", "--detail", "high", "--max-triangles", str(most))
    assert enough == high and least < limit < most
    with caplog.at_level(logging.INFO):
        options = ("--detail", "high", "--max-triangles", str(limit))
        some = reconstructed("some", *options, "--wedges")
        wedges = json.loads((tmp_path / "some.json").read_text(encoding="utf-8"))["wedges"]
        total = sum(row[0] for row in some.values())
        assert f"; {total} triangles, {wedges} wedges, in" in caplog.text and wedges > 4 * len(some)
        assert total <= limit and "remain" not in caplog.text
        monkeypatch.setattr(area, "MAX_FOOTPRINTS", 5)
        assert reconstructed("batches", *options, "--threads", "2") == some
        assert reconstructed("none", "--detail", "high", "--max-triangles", "1") == low
        assert f"warning: {least} triangles remain, more than reconstruct.max_triangles" in caplog.text
    # cubic metres per triangle saved, of the buildings that are simpler and of those that could be
    cost = {
        key: (low[key][1] - row[1]) * row[2] / (row[0] - low[key][0])
        for key, row in high.items()
        if row[0] > low[key][0]
    }
    simpler = {key for key, row in some.items() if row != high[key]}
    assert all(some[key] == low[key] for key in simpler) and 0 < len(simpler) < len(cost)
    dearest = max(simpler, key=lambda key: cost[key])
    # residuals in files have three digits
    assert cost[dearest] <= min(cost[key] for key in cost if key not in simpler) + 0.02
    assert total + high[dearest][0] - low[dearest][0] > limit
