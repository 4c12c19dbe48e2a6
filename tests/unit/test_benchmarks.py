"""Every script of benchmarks/ goes with the package as it is, and says what it needs."""

from __future__ import annotations

import ast
import hashlib
import importlib
import re
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import geopandas as gpd
import laspy
import numpy as np
import pytest
import shapely
from places import ROOT

FOLDER = ROOT / "benchmarks"
SCRIPTS = {path.stem: path for path in sorted(FOLDER.glob("*.py"))}


@pytest.fixture
def beside_scripts(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Imports as in a script of benchmarks/, whose modules are gone afterwards: tests have some of the same names."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "path", [*sys.path])
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(str(FOLDER)):
            del sys.modules[name]


def programs(source: str) -> Iterator[ast.Module]:
    """A script, and the programs in its strings that it gives to other processes."""
    tree = ast.parse(source)
    yield tree
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and "import " in node.value:
            try:
                yield ast.parse(node.value)
            except SyntaxError:  # prose
                continue


def missing_names(tree: ast.Module) -> list[str]:
    """What is imported from the package, anywhere in a program, or read from its modules, that is not there."""
    missing, modules = [], {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "p2wss":
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                if not hasattr(module, alias.name):
                    try:
                        importlib.import_module(f"{node.module}.{alias.name}")
                    except ImportError:
                        missing.append(f"{node.module}.{alias.name}")
                        continue
                value = getattr(module, alias.name)
                if isinstance(value, ModuleType):
                    modules[alias.asname or alias.name] = value
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            module = modules[node.value.id]
            if not hasattr(module, node.attr):
                missing.append(f"{module.__name__}.{node.attr}")
    return missing


@pytest.mark.usefixtures("beside_scripts")
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_benchmark_starts(name):
    runpy.run_path(str(SCRIPTS[name]), run_name=name)


@pytest.mark.usefixtures("beside_scripts")
@pytest.mark.parametrize("name", SCRIPTS)
def test_what_a_benchmark_uses_of_the_package_exists(name):
    trees = programs(SCRIPTS[name].read_text(encoding="utf-8"))
    assert [missing for tree in trees for missing in missing_names(tree)] == []


@pytest.mark.parametrize(
    ("program", "missing"),
    [
        ("from p2wss.storage import integrity, gone", ["p2wss.storage.gone"]),
        ("def f():\n    from p2wss.fit.fitting import gone", ["p2wss.fit.fitting.gone"]),
        ("from p2wss.fit import fitting\nfitting.gone()\nfitting.fit()", ["p2wss.fit.fitting.gone"]),
    ],
)
def test_a_name_that_is_gone_is_found(program, missing):
    assert missing_names(ast.parse(program)) == missing


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_benchmark_says_how_to_run_it_and_what_it_needs(name):
    docstring = ast.get_docstring(ast.parse(SCRIPTS[name].read_text(encoding="utf-8")))
    if not re.search(r"\b(Used|Shared) by\b", docstring):
        assert f"benchmarks/{name}.py" in docstring
        assert re.search(r"\b[Nn]eeds?\b", docstring)


@pytest.mark.usefixtures("beside_scripts")
def test_the_houses_of_delft_are_cut_out_of_files_with_the_stated_digests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    delft = importlib.import_module("delft")
    source, folder = tmp_path / "source", tmp_path / "delft"
    for name in (delft.CLOUD, delft.FOOTPRINTS):
        (source / name).parent.mkdir(parents=True)
    las = laspy.create(point_format=1)
    las.x, las.y, las.z = np.array([[84835.5, 84854.5, 84855.5], [447500.0] * 3, [1.0, 2.0, 3.0]])
    las.write(source / delft.CLOUD)
    # the second house is beside the box
    houses = [shapely.box(x, 447500, x + 10, 447510) for x in (84840, 84960)]
    gpd.GeoDataFrame({"gml_id": ["a", "b"]}, geometry=houses, crs=28992).to_file(
        source / delft.FOOTPRINTS, driver="SQLite"
    )
    digests = {name: hashlib.sha256((source / name).read_bytes()).hexdigest() for name in delft.DIGESTS}
    assert list(delft.DIGESTS.values()) != list(digests.values())
    with pytest.raises(SystemExit, match=r"ahn3_cropped_1.laz: its SHA-256 is .*, not 0f55.*remove it"):
        delft.downloaded(folder, source.as_uri())
    monkeypatch.setattr(delft, "DIGESTS", digests)
    assert delft.downloaded(folder, source.as_uri()) == folder
    # up to 5 m around the houses
    assert np.array(laspy.read(folder / "ahn3.laz").z).tolist() == [1.0, 2.0]
    kept = gpd.read_file(folder / "footprints.gpkg")
    assert kept["building_id"].tolist() == ["a"] and kept.geometry[0].equals(houses[0])
    (folder / Path(delft.CLOUD).name).unlink()
    with pytest.raises(SystemExit, match=r"cannot be fetched: .*put the file into"):
        delft.downloaded(folder, (tmp_path / "gone").as_uri())
