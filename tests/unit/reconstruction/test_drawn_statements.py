"""A hundred drawn combinations of statements of benchmarks/statements.py: none is wrong without a word."""

from __future__ import annotations

import importlib.util
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from places import ROOT


@pytest.mark.parametrize("seed", range(4))
def test_no_statement_is_misread_without_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    path = ROOT / "benchmarks" / "statements.py"
    spec = importlib.util.spec_from_file_location("statements_of_benchmarks", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    files, counts = module.Files(tmp_path), Counter[str]()
    for number in range(25):
        case = module.drawn(np.random.default_rng([7, seed, number]))
        outcome, why = module.looked_at(case, files)
        assert outcome != module.WRONG, f"{case}: {why}"
        counts[outcome] += 1
    assert counts[module.RIGHT] >= 5
