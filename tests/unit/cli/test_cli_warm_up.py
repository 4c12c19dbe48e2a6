"""``p2wss warm-up``: nothing to do the second time, and no mark of a failure."""

from __future__ import annotations

from pathlib import Path

import pytest
from numba import config

from p2wss import cli
from p2wss.reconstruction import warm_up as of_reconstruct


def test_nothing_to_do_the_second_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    done: list[str] = []
    monkeypatch.setattr(of_reconstruct, "warm_product", lambda *_: done.append("product"))
    with caplog.at_level("INFO"):
        assert cli.main(["warm-up"]) == 0
        assert "compiled in" in caplog.text and "all code is already compiled" not in caplog.text
        assert cli.main(["warm-up"]) == 0
    assert "all code is already compiled" in caplog.text and done == ["product"]


def test_a_failure_is_no_success(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise ValueError("no compiler")

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(of_reconstruct, "warm_product", fails)
    for _ in range(2):
        with pytest.raises(ValueError, match="no compiler"):
            cli.main(["warm-up"])
