"""pytest imports test files by their names: two of the same name cannot be collected together."""

from collections import Counter

from places import ROOT


def test_every_test_file_has_a_name_of_its_own():
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []
