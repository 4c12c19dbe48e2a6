"""One function over many values in several processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from multiprocessing import current_process, get_context

import pytest

from p2wss.reconstruction.running.processes import Shared


def with_all(num_processes: int) -> Callable[[], object]:
    """What waits, when a process calls it for the first time, until all have called it."""
    barrier, seen = get_context("fork").Barrier(num_processes), set[int]()

    def wait() -> None:
        if os.getpid() not in seen:
            seen.add(os.getpid())
            barrier.wait(60)

    return wait


@pytest.mark.parametrize("num_values", [0, 1, 2, 7])
@pytest.mark.parametrize("num_processes", [1, 2, 3])
def test_each_value_has_one_result_and_they_come_from_so_many_processes(
    num_values: int, num_processes: int
) -> None:
    wait = with_all(max(min(num_values, num_processes), 1))

    def function(value: int) -> tuple[int, int]:
        wait()
        return 2 * value, os.getpid()

    results = list(Shared(function, range(num_values), num_processes))
    assert sorted((number, twice) for number, (twice, _) in results) == [
        (value, 2 * value) for value in range(num_values)
    ]
    assert len({process for _, (_, process) in results}) == min(num_values, num_processes)


def test_a_process_takes_what_no_other_has_taken() -> None:
    wait, slow_done = with_all(2), get_context("fork").Event()

    def function(value: int) -> int:
        wait()
        if value == 0:
            assert slow_done.wait(60)
        elif value == 6:
            slow_done.set()
        return os.getpid()

    # the other process does all but the first
    processes = dict(Shared(function, range(7), 2))
    assert list(processes.values()).count(processes[0]) == 1


def test_forks_do_all_while_this_process_does_something_else() -> None:
    all_done = get_context("fork").Event()

    def function(value: int) -> int:
        if value == 6:
            all_done.set()
        return os.getpid()

    shared = Shared(function, range(7), 2)
    assert all_done.wait(60)
    assert len(set(dict(shared).values()) - {os.getpid()}) == 1


def test_without_forks_this_process_does_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """With no process asked for, within a daemon of another program, and without memory for a fork."""

    def no_fork(process: object) -> None:
        raise BlockingIOError

    def processes(num: int) -> set[int]:
        return set(dict(Shared(lambda value: os.getpid(), range(4), num)).values())

    assert processes(0) == {os.getpid()}
    with monkeypatch.context() as patch:
        patch.setitem(current_process()._config, "daemon", True)  # type: ignore[attr-defined]
        assert processes(2) == {os.getpid()}
    monkeypatch.setattr(get_context("fork").Process, "start", no_fork)
    assert processes(2) == {os.getpid()}


def test_more_than_a_pipe_holds() -> None:
    result = dict(Shared(lambda value: bytes([value]) * 1_000_000, range(4), 2))
    assert [result[number][-1] for number in range(4)] == [0, 1, 2, 3]


def test_more_values_than_a_pipe_holds_numbers() -> None:
    assert dict(Shared(lambda value: -value, range(70_000), 2)) == {n: -n for n in range(70_000)}


@pytest.mark.parametrize("error", [ZeroDivisionError, OSError, EOFError])
def test_error_in_a_fork(error: type[Exception]) -> None:
    def function(value: int) -> int:
        if value == 2:
            raise error("of the fork")
        return value

    with pytest.raises(error, match="of the fork") as raised:
        list(Shared(function, range(4), 2))
    assert "in function" in raised.value.__notes__[0]  # where it was


@pytest.mark.parametrize("num_processes", [1, 2])
def test_what_a_killed_fork_had_in_hand_is_tried_again_alone(
    num_processes: int, caplog: pytest.LogCaptureFixture
) -> None:
    tried = get_context("fork").Value("i", 0)

    def function(value: int) -> tuple[int, int]:
        if value == 3 and not tried.value:
            tried.value = 1
            os.kill(os.getpid(), signal.SIGKILL)
        return value, os.getpid()

    results = dict(Shared(function, range(7), num_processes))
    assert sorted(results) == list(range(7)) and all(results[n][0] == n for n in results)
    processes = {number: process for number, (_, process) in results.items()}
    assert list(processes.values()).count(processes[3]) == 1 and os.getpid() not in processes.values()
    # nothing that was finished is done again
    assert "a process was killed" in caplog.text and len(set(processes.values())) <= num_processes + 2


@pytest.mark.parametrize("num_processes", [1, 2])
def test_a_value_that_kills_each_process_ends_none_of_the_others(num_processes: int) -> None:
    def function(value: int) -> str:
        if value in (0, 3, 6):
            os.kill(os.getpid(), signal.SIGSEGV)
        return str(value)

    def instead(value: int, ending: str) -> str:
        if value == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return f"{os.getpid() == parent} {ending.splitlines()[-1]}"

    def last(value: int, ending: str) -> str:
        return f"{os.getpid() == parent} last"

    parent = os.getpid()
    results = dict(Shared(function, range(7), num_processes, [instead, last]))
    by = "False its process was killed by SIGSEGV"
    assert [results[n] for n in range(7)] == [by, "1", "2", "True last", "4", "5", by]
    with pytest.raises(ChildProcessError, match=r"test_processes.py.*in function(.|\n)*SIGSEGV"):
        list(Shared(function, range(7), num_processes))
