"""Progress on a terminal and in a log."""

from __future__ import annotations

import io
import logging

import pytest

from p2wss.storage.progress import Progress


def test_a_log_gets_a_line_every_two_seconds() -> None:
    now, lines = [0.0], []
    with Progress("reconstruct", 2560, "buildings", report=lines.append, clock=lambda: now[0]) as progress:
        for num_done in range(256, 2561, 256):
            now[0] += 0.8
            progress.update(num_done)
    # after 2.4, 4.8 and 7.2 seconds; not at the end, where a summary follows
    assert lines == [
        "reconstruct: 768 of 2560 buildings, about 6 s left",
        "reconstruct: 1536 of 2560 buildings, about 3 s left",
        "reconstruct: 2304 of 2560 buildings, about 1 s left",
    ]


def test_what_was_before_the_first_items_does_not_count_for_the_time_left() -> None:
    now, lines = [0.0], []
    with Progress("training", 1000, "steps", 400, report=lines.append, clock=lambda: now[0]) as progress:
        now[0] += 60
        progress.update(450)
        now[0] += 6
        progress.update(500, "loss 0.25")
    assert lines == [
        "training: 450 of 1000 steps",
        "training: 500 of 1000 steps, about 60 s left, loss 0.25",
    ]


def test_a_log_of_a_night_has_some_hundred_lines() -> None:
    now, lines = [0.0], []
    with Progress("training", 57_600, "steps", report=lines.append, clock=lambda: now[0]) as progress:
        for num_done in range(57_600):
            now[0] += 0.5
            progress.update(num_done)
    assert 50 < len(lines) < 150


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_a_bar_and_log_lines_stand_above_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("tqdm")
    caplog.set_level(logging.INFO, "p2wss")
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    handlers: list[logging.Handler] = [logging.StreamHandler(terminal)]
    monkeypatch.setattr(logging.getLogger(), "handlers", handlers)
    with Progress("training", 3, "steps") as progress:
        progress.update(1, "loss 0.5")
        logging.getLogger("p2wss").info("a message")
        progress.update(3)
    text = terminal.getvalue()
    assert "3/3" in text and "training: 100%" in text
    assert "a message\n" in text and logging.getLogger().handlers == handlers


def test_a_terminal_gets_no_bar_among_details(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "p2wss")
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setattr(logging.getLogger(), "handlers", [logging.StreamHandler(terminal)])
    with Progress("training", 3, "steps") as progress:
        progress.update(1, "loss 0.5")
    assert terminal.getvalue() == ""


def test_a_terminal_whose_log_hides_information_gets_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "p2wss")
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with Progress("training", 3, "steps") as progress:
        progress.update(3)
    assert terminal.getvalue() == ""
