"""Sequences in a file, and sequences that are computed at each access."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from p2wss.reconstruction.running import spool
from p2wss.reconstruction.running.spool import Lazy, Spool


def test_values_of_a_file_in_any_order(tmp_path: Path) -> None:
    with Spool[str](3, tmp_path) as values:
        for number in (2, 0, 1):
            values[number] = f"value {number}"
        values[0] = "replaced by a longer value"
        assert os.listdir(tmp_path) == []
        assert list(values) == ["replaced by a longer value", "value 1", "value 2"]
        assert len(values) == 3 and list(values[1:]) == ["value 1", "value 2"] and values[-1] == "value 2"
        values[1] = "replaced after it was read"
        assert values[1] == "replaced after it was read"
    with Spool[int](1, tmp_path) as empty, pytest.raises(KeyError):
        _ = empty[0]


def test_only_the_first_values_stay_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spool, "_NUM_KEPT", 1)
    with Spool[list[int]](2, tmp_path) as values:
        values[0], values[1] = [0], [1]
        assert values[0] is values[0] and values[1] == [1] and values[1] is not values[1]
        values[0], values[1] = [2], [3]
        assert values[0] is values[0] and list(values) == [[2], [3]]


def test_computed_at_each_access() -> None:
    calls: list[int] = []
    doubled = Lazy(lambda value: calls.append(value) or 2 * value, [1, 2, 3])
    assert len(doubled) == 3 and calls == []
    assert doubled[1] == 4 and list(doubled[1:]) == [4, 6] and list(doubled) == [2, 4, 6]
    assert calls == [2, 2, 3, 1, 2, 3]
