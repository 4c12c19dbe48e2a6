"""Rules on the files of the checkout."""

import tomllib
from collections import Counter
from fnmatch import fnmatch

from places import ROOT


def test_every_test_file_has_a_name_of_its_own():
    """pytest imports test files by their names: two of the same name cannot be collected together."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []


def test_files_beside_modules_are_listed_as_package_data():
    """A wheel lacks the templates and other files that pyproject.toml does not list."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    patterns = [f"{package.replace('.', '/')}/{name}" for package, names in listed.items() for name in names]
    paths = [path for path in (ROOT / "src" / "p2wss").rglob("*") if path.is_file()]
    names = [str(path.relative_to(ROOT / "src")) for path in paths if "__pycache__" not in path.parts]
    names = [name for name in names if not name.endswith((".py", ".pyc"))]
    assert {"p2wss/eval/templates/report.html.j2", "p2wss/formats/assets/viewer.js"} <= {*names}
    assert [name for name in names if not any(fnmatch(name, pattern) for pattern in patterns)] == []
