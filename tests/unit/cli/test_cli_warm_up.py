"""``p2wss warm-up``: its tasks, and nothing to do the second time."""

from __future__ import annotations

from pathlib import Path

import pytest
from numba import config

from p2wss import cli
from p2wss.reconstruct import warm_up as of_reconstruct


def test_a_task_that_fails_is_no_success(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails() -> None:
        raise ValueError("no compiler")

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(of_reconstruct, "TASKS", (fails,))
    for _ in range(2):
        with pytest.raises(ValueError, match="no compiler"):
            cli.main(["warm-up"])


def test_nothing_to_do_the_second_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    done = []
    monkeypatch.setattr(of_reconstruct, "TASKS", (lambda: done.append("a"), lambda: done.append("b")))
    with caplog.at_level("INFO"):
        assert cli.main(["warm-up"]) == 0
        assert "compiled in" in caplog.text and "all code is already compiled" not in caplog.text
        assert cli.main(["warm-up"]) == 0
    assert "all code is already compiled" in caplog.text and done == ["a", "b"]
