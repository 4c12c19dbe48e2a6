"""What is installed without extras, and what is said where a package of an extra is missing."""

from __future__ import annotations

import gc
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import geopandas as gpd
import pytest
import shapely
from places import ROOT
from test_api import footprints, gable_points

import p2wss
from p2wss import cli
from p2wss.cli import importing
from p2wss.config.generate import default_yaml, json_schema
from p2wss.storage.arguments import EXTRAS
from p2wss.storage.messages import InputError

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def names(requirements: list[str]) -> set[str]:
    return {requirement.split(">")[0].split("[")[0] for requirement in requirements}


def test_a_missing_package_is_named_with_its_extra() -> None:
    extras = {name: names(needs) for name, needs in PROJECT["optional-dependencies"].items()}
    for package, extra in EXTRAS.items():
        distribution = {"PIL": "pillow"}.get(package, package)
        assert distribution in extras[extra] and distribution not in names(PROJECT["dependencies"])


def test_without_torch_a_network_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    assert cli.main(["model", "--manifest", str(tmp_path / "m"), "--dvae", "d", "--out", "o", *REST]) == 2
    assert capsys.readouterr().err == "p2wss: error: needs torch; type: pip install 'p2wss[network]'\n"


def test_without_pyarrow_a_run_with_parquet_ends_before_it_begins(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    cloud, footprints = ROOT / "tests/mini/lidar", ROOT / "tests/mini/bdtopo/BDTOPO_mini.gpkg"
    run = ["reconstruct", str(cloud), str(footprints), str(tmp_path / "out")]
    scene = [
        "scene",
        "--source",
        "folder",
        "--bbox",
        "653100",
        "6860700",
        "653110",
        "6860710",
        str(tmp_path / "out"),
    ]
    table = tmp_path / "a.parquet"
    gpd.GeoDataFrame(geometry=[shapely.box(0, 0, 9, 9)], crs=2154).to_parquet(table)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    for words in (
        [*run, "--format", "glb,geoparquet"],
        [*run, "--wedges"],
        [*scene, "--format", "geoparquet"],
        [*run[:2], str(table), run[3]],
        ["inspect", str(table)],
    ):
        assert cli.main(words) == 2
        end = capsys.readouterr().err.splitlines()[-1]
        assert end == "p2wss: error: needs pyarrow; type: pip install 'p2wss[parquet]'", words
    assert not (tmp_path / "out").exists()


def test_a_scene_in_python_needs_pyarrow_for_parquet_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    run = {"crs": "EPSG:2154", "model": "none", "progress": False}
    scene = p2wss.reconstruct(gable_points(), footprints()[:1], **run)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(InputError, match=r"needs pyarrow; type: pip install 'p2wss\[parquet\]'"):
        scene.write(tmp_path, ["glb", "geoparquet"])
    assert list(tmp_path.iterdir()) == []
    scene.write(tmp_path, ["cityjson", "gpkg", "glb", "report"])
    assert len(list(tmp_path.iterdir())) > 4


REST = ["--checkpoints", "c", "--out-metrics", "m"]


def test_reconstruction_imports_nothing_of_the_extras() -> None:
    # None: an import of it fails
    blocked = f"import sys; sys.modules.update(dict.fromkeys({[*EXTRAS]}))"
    modules = "reconstruction.run", "reconstruction.outputs.exports", "formats.outputs", "eval.files"
    imports = "\n".join(f"import p2wss.{module}" for module in modules)
    subprocess.run([sys.executable, "-c", f"{blocked}\n{imports}"], check=True)


def test_the_settings_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["config"]) == 0
    assert capsys.readouterr().out == default_yaml() == (ROOT / "config/default.yaml").read_text()
    assert cli.main(["config", "--schema"]) == 0
    assert capsys.readouterr().out == json_schema() == (ROOT / "config/schema.json").read_text()


def test_a_project_of_the_workflow_is_begun_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project = tmp_path / "project"
    assert cli.main(["workflow", "init", str(project)]) == 0
    for name in (
        "Snakefile",
        "workflow/rules/common.smk",
        "config/default.yaml",
        "profiles/slurm/config.yaml",
    ):
        assert (project / name).read_bytes() == (ROOT / name).read_bytes()
    # what the page of the pipeline names is there
    page = (ROOT / "docs/manual/pipeline.md").read_text(encoding="utf-8")
    commands = re.findall("`([^`]*(?:snakemake|p2wss) [^`]*)`", page)
    named = {
        path
        for each in commands
        for path in re.findall(r"\b(?:config|models|profiles|tests)/[\w./-]*\w", each)
    }
    assert {"models/point2wss.safetensors", "tests/mini/dataset.yaml", "config/paper.yaml"} <= named
    assert [path for path in named if not (project / path).exists()] == []
    # and a wheel has the miniature
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["data-files"]
    packed = {path for patterns in data.values() for pattern in patterns for path in ROOT.glob(pattern)}
    miniature = {ROOT / path.relative_to(project) for path in (project / "tests").rglob("*.*")}
    assert len(miniature) > 8 and sorted(path for path in miniature - packed if path.is_file()) == []
    assert cli.main(["workflow", "init", str(project)]) == 2
    assert "Snakefile: exists" in capsys.readouterr().err


def test_imports_of_a_command_are_not_searched_for_garbage() -> None:
    before = gc.get_freeze_count()
    with importing():
        assert not gc.isenabled()
    assert gc.isenabled() and gc.get_freeze_count() > before
    gc.unfreeze()


def test_a_command_imports_without_what_it_does_not_need(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "wave", raising=False)
    with importing("wave"), pytest.raises(ImportError):
        import wave
    import wave

    with importing("wave"):
        assert wave is sys.modules["wave"]
    assert wave is sys.modules["wave"]
    gc.unfreeze()
