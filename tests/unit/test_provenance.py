"""A fingerprint follows the code that can change a result, and nothing else."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import p2wss
from p2wss.provenance import fingerprint

PACKAGE = Path(p2wss.__file__).parent


@pytest.fixture
def copy(tmp_path):
    """A copy of the package and a function that fingerprints a stage of it in a fresh interpreter."""
    root = tmp_path / "p2wss"
    shutil.copytree(PACKAGE, root, ignore=shutil.ignore_patterns("__pycache__"))

    def of(stage: str) -> str:
        code = f"from p2wss.provenance import fingerprint; print(fingerprint({stage!r}))"
        run = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return run.stdout.strip()

    return root, of


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def test_docstrings_comments_and_config_do_not_count(copy):
    root, of = copy
    before = of("buildings")
    edit(root / "buildings" / "build.py", '"""', '"""Another text. ')
    edit(root / "data" / "polygon_arrays.py", "import numpy as np", "# a comment\nimport numpy as np\n")
    edit(root / "config" / "region.py", "gt=0, le=10000", "gt=0, le=20000")
    assert of("buildings") == before


def test_code_counts_also_where_it_is_imported_from(copy):
    root, of = copy
    before = of("buildings")
    edit(root / "data" / "seeds.py", "digest_size=8", "digest_size=16")
    assert of("buildings") == before, "buildings draws nothing at random"
    edit(root / "data" / "polygon_arrays.py", "np.round((low + high) / 2)", "np.floor((low + high) / 2)")
    after = of("buildings")
    assert after != before
    (root / "skeleton" / "new_module.py").write_text("X = 1\n")
    assert of("buildings") == after, "a module that nothing imports changes no result"
    edit(root / "skeleton" / "__init__.py", "from", "from p2wss.skeleton import new_module\nfrom")
    assert of("buildings") != after


def test_a_stage_that_is_a_package_counts_with_all_its_modules(copy):
    root, of = copy
    before, predict = of("eval"), of("eval.predict")
    edit(root / "eval" / "report.py", "import", "import this_is_new\nimport")
    assert of("eval") != before and of("eval.predict") == predict


def test_lazy_imports_and_data_files_count(copy):
    root, of = copy
    (root / "stage").mkdir()
    (root / "stage" / "__init__.py").write_text("def run():\n    from .inner import f\n    return f\n")
    (root / "stage" / "inner.py").write_text("from ..data.seeds import derive_seed\nf = derive_seed\n")
    (root / "stage" / "templates").mkdir()
    (root / "stage" / "templates" / "page.html").write_text("one")
    before, page = of("stage"), of("stage.templates")
    edit(root / "data" / "seeds.py", "digest_size=8", "digest_size=16")
    assert of("stage") != before and of("stage.templates") == page
    (root / "stage" / "templates" / "page.html").write_text("two")
    assert of("stage.templates") != page


def test_unknown_stage():
    with pytest.raises(ModuleNotFoundError, match="no_such_stage"):
        fingerprint("no_such_stage")
