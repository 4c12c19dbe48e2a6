"""A fingerprint follows the code that can change a result, and nothing else."""

import ast
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest

import p2wss
from p2wss.storage import provenance, sources
from p2wss.storage.provenance import fingerprint

PACKAGE = Path(p2wss.__file__).parent


def fingerprint_by(python: str, folder: Path, *stages: str) -> list[str]:
    """Fingerprints of the package in ``folder``, in a fresh interpreter that need not have the libraries."""
    code = (
        "from p2wss.storage import provenance; provenance._version = str;"
        f"print(*map(provenance.fingerprint, {stages!r}))"
    )
    run = subprocess.run([python, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    return run.stdout.split()


@pytest.fixture
def copy(tmp_path: Path) -> tuple[Path, Callable[[str], str]]:
    """A copy of the package and a function that fingerprints a stage of it in a fresh interpreter."""
    root = tmp_path / "p2wss"
    shutil.copytree(PACKAGE, root, ignore=shutil.ignore_patterns("__pycache__", "weights"))
    return root, lambda stage: fingerprint_by(sys.executable, tmp_path, stage)[0]


@pytest.fixture
def digest_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """A function that fingerprints a stage whose module holds the given code."""
    monkeypatch.setattr(sources, "ROOT", tmp_path)

    def digest(code: str) -> str:
        (tmp_path / "stage.py").write_text(code)
        forget()
        return provenance.fingerprint("stage")

    yield digest
    forget()


def forget() -> None:
    """As in a new process."""
    sources.modules.cache_clear()
    sources.digest.cache_clear()
    provenance.fingerprint.cache_clear()


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")


def test_docstrings_comments_and_config_do_not_count(copy):
    root, of = copy
    before = of("scenes.buildings")
    edit(root / "scenes" / "buildings.py", '"""', '"""Another text. ')
    edit(root / "data" / "polygon_arrays.py", "import numpy as np", "# a comment\nimport numpy as np\n")
    edit(root / "config" / "region.py", "ge=10, le=10000", "ge=10, le=20000")
    assert of("scenes.buildings") == before


def test_code_counts_also_where_it_is_imported_from(copy):
    root, of = copy
    before = of("scenes.buildings")
    edit(root / "data" / "seeds.py", "digest_size=8", "digest_size=16")
    assert of("scenes.buildings") == before, "buildings draws nothing at random"
    edit(root / "data" / "polygon_arrays.py", "np.nan_to_num(np.round(", "np.nan_to_num(np.floor(")
    after = of("scenes.buildings")
    assert after != before
    (root / "skeleton" / "new_module.py").write_text("X = 1\n")
    assert of("scenes.buildings") == after, "a module that nothing imports changes no result"
    edit(root / "skeleton" / "__init__.py", "from", "from p2wss.skeleton import new_module\nfrom")
    assert of("scenes.buildings") != after


def test_a_stage_that_is_a_package_counts_with_all_its_modules(copy):
    root, of = copy
    before, measure = of("eval"), of("eval.measure")
    edit(root / "eval" / "report.py", "import", "import this_is_new\nimport")
    assert of("eval") != before and of("eval.measure") == measure


def test_lazy_imports_and_data_files_count(copy):
    root, of = copy
    (root / "stage").mkdir()
    (root / "stage" / "__init__.py").write_text(
        "def run():\n    from p2wss.stage.inner import f\n    return f\n"
    )
    (root / "stage" / "inner.py").write_text("from p2wss.data.seeds import derive_seed\nf = derive_seed\n")
    (root / "stage" / "templates").mkdir()
    (root / "stage" / "templates" / "page.html").write_text("one")
    before, page = of("stage"), of("stage.templates")
    edit(root / "data" / "seeds.py", "digest_size=8", "digest_size=16")
    assert of("stage") != before and of("stage.templates") == page
    (root / "stage" / "templates" / "page.html").write_text("two")
    assert of("stage.templates") != page


def test_the_config_counts_only_where_it_is_named(copy):
    """As for the age of figures that depend on nothing else; the rules pass its values as parameters."""
    root, of = copy
    before, buildings = of("config"), of("scenes.buildings")
    edit(root / "config" / "region.py", "ge=10, le=10000", "ge=10, le=20000")
    assert of("config") != before and of("scenes.buildings") == buildings


@pytest.mark.parametrize(
    ("library", "in_scenes", "in_crops", "in_training"),
    [
        ("numpy", True, True, True),
        ("numba", True, True, True),
        ("shapely", True, True, True),
        ("torch", False, False, True),
    ],
)
def test_another_version_of_a_library_counts_for_the_stages_that_use_it(
    library: str, in_scenes: bool, in_crops: bool, in_training: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def of(version: str) -> list[str]:
        monkeypatch.setattr(metadata, "version", lambda name: version if name == library else "1.0")
        forget()
        return [fingerprint(stage) for stage in ("scenes.buildings", "crops", "training.model")]

    before, after, on_gpu = of("1.0"), of("1.1"), of("1.0+cu130")
    forget()
    changed = [old != new for old, new in zip(before, after, strict=True)]
    assert changed == [in_scenes, in_crops, in_training]
    assert before == on_gpu


def test_a_library_that_is_not_installed_is_no_error() -> None:
    assert provenance._version("no-such-library") == "" != provenance._version("numpy")


def test_the_package_has_no_relative_imports():
    """A fingerprint follows imports by their full names."""
    relative = [path for path in PACKAGE.rglob("*.py") if re.search(r"^\s*from \.", path.read_text(), re.M)]
    assert relative == []


def test_unknown_stage():
    with pytest.raises(ModuleNotFoundError, match="no_such_stage"):
        fingerprint("no_such_stage")


CODE = '''
"""A stage."""
import logging
log = logging.getLogger("p2wss")
SCHEMA = [field("status", pa.string(), "why the building was rejected", True)]

def run(rows, path):
    """Runs."""
    log.info("%d rows", len(rows))
    if not rows:
        raise InputError(f"{path}: no rows; run the stage before")
    assert path, "a path is needed"
    if len(rows) == 1:
        raise Rejected("too-few-rows")
    return Field("ok", description="what came out")
'''


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"""Runs."""', '"""Another text."""'),
        ('    """Runs."""\n', ""),
        ("import logging\n", "import logging  # a comment\n\n\n"),
    ],
)
def test_layout_comments_and_docstrings_do_not_count(
    digest_of: Callable[[str], str], old: str, new: str
) -> None:
    assert old in CODE
    assert digest_of(CODE.replace(old, new)) == digest_of(CODE)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("no rows; run", "no row; run"),
        ('log.info("%d rows", len(rows))', 'log.warning("%d rows", len(rows))'),
        ('field("status"', 'field("state"'),
        ("pa.string()", "pa.int8()"),
        ('rejected", True)', 'rejected", False)'),
        ("too-few-rows", "too-small"),
        ('Field("ok"', 'Field("fine"'),
        ('description="what came out"', "description=what"),
        ('description="what came out"', 'title="what came out"'),
        ("raise InputError(", "raise ValueError("),
        ("assert path,", "assert not path,"),
        ("len(rows) == 1", "len(rows) == 2"),
        ("len(rows) == 1", "len(rows) == True"),
        ('log.info("%d rows", len(rows))', 'log.info("%d rows", num := len(rows))'),
        ('log.info("%d rows", len(rows))', 'log.append(("%d rows", len(rows)))'),
        ("run(rows, path)", "run(rows, path, /)"),
        ("run(rows, path)", "run(rows, path=None)"),
    ],
)
def test_what_a_result_can_depend_on_counts(digest_of: Callable[[str], str], old: str, new: str) -> None:
    assert old in CODE
    assert digest_of(CODE.replace(old, new)) != digest_of(CODE)


def test_an_empty_field_is_not_taken_for_another(digest_of: Callable[[str], str]) -> None:
    """Fields that are empty are skipped: what stays must still say which field it is."""
    variants = [
        "def f(a, b): return x",
        "def f(a, *, b): return x",
        "def f(a, /, b): return x",
        "def f(*a, **b): return x",
        "def f(a, b): return [x]",
        "def f(a, b): return None",
        "def f(a, b): return",
        "def f(a, b): yield",
        "{None: x}",
        "{**x}",
        "x[1:]",
        "x[:1]",
        "x[::1]",
        "f'{x}'",
        "f'{x!r}'",
        "f'{x:1}'",
        "y = 1",
        "y = '1'",
        "y = b'1'",
        "y = 1.0",
    ]
    assert len({digest_of(code) for code in variants}) == len(variants)


def test_a_version_of_a_module_is_parsed_once(
    copy: tuple[Path, Callable[[str], str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, _ = copy
    monkeypatch.setattr(sources, "ROOT", root)
    parse, texts = ast.parse, []

    def counted(text: bytes, *arguments: str) -> ast.Module:
        texts.append(text)
        return parse(text, *arguments)

    monkeypatch.setattr(ast, "parse", counted)
    # of few modules, but more than one that share some
    stages = "training.dvae", "scenes.cut", "crops"
    forget()
    before = [fingerprint(stage) for stage in stages]
    kept = root / provenance._KEPT
    assert len(texts) > 50 and len(texts) == len(json.loads(kept.read_text()))
    assert "p2wss.crops" in json.loads(kept.read_text())
    for content in ("", "[]", '{"p2wss.crops": 1}', '{"p2wss.crops": ["", ""]}', kept.read_text()):
        texts.clear()
        kept.write_text(content)
        forget()
        assert [fingerprint(stage) for stage in stages] == before, "whatever the file holds"
    assert texts == []
    edit(root / "data" / "polygon_arrays.py", "np.nan_to_num(np.round(", "np.nan_to_num(np.floor(")
    forget()
    changed = fingerprint("crops")
    assert changed != before[-1] and len(texts) == 1
    kept.unlink()
    kept.mkdir()  # nothing can be kept
    forget()
    assert [fingerprint(stage) for stage in stages][-1] == changed and len(texts) > 50
    forget()


@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13", "3.14"])
def test_the_version_of_python_does_not_count(
    copy: tuple[Path, Callable[[str], str]], monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    """The machine that submits the jobs need not have the Python of the one that runs them."""
    python = shutil.which(f"python{version}")
    if python is None or subprocess.run([python, "--version"], capture_output=True).returncode:
        pytest.skip(f"no Python {version}")
    stages = (
        "towns",
        "fetching",
        "scenes",
        "scenes.buildings",
        "scans",
        "crops",
        "training.dvae",
        "training.model",
        "reconstruction",
        "eval",
    )
    folder = copy[0].parent  # where nothing is kept yet
    monkeypatch.setattr(provenance, "_version", str)
    forget()
    assert fingerprint_by(python, folder, *stages) == [fingerprint(stage) for stage in stages]
    forget()
