"""Every script of benchmarks/ goes with the package as it is, and says what it needs."""

from __future__ import annotations

import ast
import importlib
import re
import runpy
import sys
from collections.abc import Iterator
from types import ModuleType

import pytest
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
