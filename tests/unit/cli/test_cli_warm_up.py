"""``p2wss warm-up``: tasks in processes, and nothing to do the second time."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from numba import config

from p2wss import cli
from p2wss.reconstruct import warm_up as of_reconstruct

FOLDER = "P2WSS_TEST_FOLDER"


def first_a() -> None:
    (Path(os.environ[FOLDER]) / "a").touch()


def first_b() -> None:
    (Path(os.environ[FOLDER]) / "b").touch()


def last() -> None:
    folder = Path(os.environ[FOLDER])
    assert (folder / "a").exists() and (folder / "b").exists()
    (folder / "last").touch()


def fails() -> None:
    raise ValueError("no compiler")


def test_the_last_task_waits_for_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    progress: list[int] = []
    of_reconstruct.run_tasks((first_a, first_b), last, 2, progress.append)
    assert (tmp_path / "last").exists() and progress[-1] == 3 and progress == sorted(progress)


def test_a_task_that_fails_is_no_success(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    with pytest.raises(ValueError, match="no compiler"):
        of_reconstruct.run_tasks((first_a, fails), last, 1, lambda done: None)


def test_nothing_to_do_the_second_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv(FOLDER, str(tmp_path))
    monkeypatch.setattr(of_reconstruct, "TASKS", (first_a, first_b))
    monkeypatch.setattr(of_reconstruct, "warm_product", last)
    with caplog.at_level("INFO"):
        assert cli.main(["warm-up", "--jobs", "1"]) == 0
        assert "compiled in" in caplog.text and "all code is already compiled" not in caplog.text
        assert cli.main(["warm-up", "--jobs", "1"]) == 0
    assert "all code is already compiled" in caplog.text
