"""One list of reasons: complete, in one style, and each with a meaning."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from p2wss.data import reasons
from p2wss.skeleton.status import Status

ROOT = Path(reasons.__file__).parents[1]


def names() -> dict[str, str]:
    return {name: value for name, value in vars(reasons).items() if name.isupper() and isinstance(value, str)}


def test_every_reason_has_a_meaning_and_is_kebab_case() -> None:
    from_kernel = {status.reason for status in Status}
    meanings = reasons.MEANINGS | reasons.FLAGS
    assert set(meanings) == set(names().values()) | from_kernel
    assert not set(reasons.MEANINGS) & set(reasons.FLAGS)
    assert all(re.fullmatch(r"[a-z]+(-[a-z]+)*", reason) for reason in meanings)
    assert all(meaning and meaning[-1] != "." for meaning in meanings.values())
    assert len(set(names().values())) == len(names())


def test_every_reason_is_used_and_written_nowhere_else() -> None:
    used, written = set(), {}
    for path in ROOT.rglob("*.py"):
        if path.name in ("reasons.py", "status.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.value, ast.Name)
                and node.value.id == "reasons"
            ):
                used.add(node.attr)
            if isinstance(node, ast.Constant) and node.value in reasons.MEANINGS and "-" in str(node.value):
                written[path.name] = node.value
    assert not written
    assert used >= set(names())
