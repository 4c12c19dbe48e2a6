"""One function over many values in several processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from multiprocessing import get_context

import pytest

from p2wss.reconstruct.processes import in_processes


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
def test_results_are_in_order_and_come_from_so_many_processes(num_values: int, num_processes: int) -> None:
    wait = with_all(max(min(num_values, num_processes), 1))

    def function(values: Sequence[int]) -> list[tuple[int, int]]:
        wait()
        return [(2 * value, os.getpid()) for value in values]

    result = in_processes(function, range(num_values), num_processes)
    assert [value for value, _ in result] == [2 * value for value in range(num_values)]
    assert len({process for _, process in result}) == min(num_values, num_processes)


def test_a_process_takes_what_no_other_has_taken() -> None:
    wait, parent = with_all(2), os.getpid()
    slow_done = get_context("fork").Event()

    def function(values: Sequence[int]) -> list[int]:
        wait()
        if os.getpid() == parent:
            assert slow_done.wait(60)
        elif values[-1] == 6:
            slow_done.set()
        return [os.getpid()]

    # the other process does all but the first of this one
    assert in_processes(function, range(7), 2).count(parent) == 1


def test_more_than_a_pipe_holds() -> None:
    result = in_processes(lambda values: [bytes([value]) * 1_000_000 for value in values], range(4), 2)
    assert [content[-1] for content in result] == [0, 1, 2, 3]


def test_error_in_a_fork() -> None:
    wait, parent = with_all(2), os.getpid()

    def function(values: Sequence[int]) -> list[int]:
        wait()
        if os.getpid() != parent:
            raise ZeroDivisionError("of the fork")
        return list(values)

    with pytest.raises(ZeroDivisionError, match="of the fork"):
        in_processes(function, range(4), 2)


def test_killed_fork() -> None:
    wait, parent = with_all(2), os.getpid()

    def function(values: Sequence[int]) -> list[int]:
        wait()
        if os.getpid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)
        return list(values)

    with pytest.raises(EOFError):
        in_processes(function, range(4), 2)
