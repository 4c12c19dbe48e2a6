"""One function over many values in several processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from multiprocessing import get_context

import pytest

from p2wss.reconstruct.processes import Shared


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
    wait, parent = with_all(2), os.getpid()
    slow_done = get_context("fork").Event()

    def function(value: int) -> int:
        wait()
        if os.getpid() == parent:
            assert slow_done.wait(60)
        elif value == 6:
            slow_done.set()
        return os.getpid()

    # the other process does all but the first of this one
    assert list(dict(Shared(function, range(7), 2)).values()).count(parent) == 1


def test_forks_do_all_while_this_process_does_something_else() -> None:
    all_done = get_context("fork").Event()

    def function(value: int) -> int:
        if value == 6:
            all_done.set()
        return os.getpid()

    shared = Shared(function, range(7), 2)
    assert all_done.wait(60)
    assert os.getpid() not in dict(shared).values()


def test_more_than_a_pipe_holds() -> None:
    result = dict(Shared(lambda value: bytes([value]) * 1_000_000, range(4), 2))
    assert [result[number][-1] for number in range(4)] == [0, 1, 2, 3]


def test_more_values_than_a_pipe_holds_numbers() -> None:
    assert dict(Shared(lambda value: -value, range(70_000), 2)) == {n: -n for n in range(70_000)}


@pytest.mark.parametrize("error", [ZeroDivisionError, OSError, EOFError])
def test_error_in_a_fork(error: type[Exception]) -> None:
    wait, parent = with_all(2), os.getpid()

    def function(value: int) -> int:
        wait()
        if os.getpid() != parent:
            raise error("of the fork")
        return value

    with pytest.raises(error, match="of the fork"):
        list(Shared(function, range(4), 2))


def test_what_a_killed_fork_had_taken_is_done_by_this_process(caplog: pytest.LogCaptureFixture) -> None:
    wait, parent = with_all(2), os.getpid()

    def function(value: int) -> tuple[int, int]:
        wait()
        if os.getpid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)
        return value, os.getpid()

    results = list(Shared(function, range(7), 2))
    assert sorted(results) == [(value, (value, parent)) for value in range(7)]
    assert "a process was killed" in caplog.text
