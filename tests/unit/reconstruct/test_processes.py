"""One function over many values in several processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence

import pytest

from p2wss.reconstruct.processes import in_processes


@pytest.mark.parametrize("num_values", [0, 1, 2, 7])
@pytest.mark.parametrize("num_processes", [1, 2, 3])
def test_results_are_in_order_and_come_from_so_many_processes(num_values: int, num_processes: int) -> None:
    def function(values: Sequence[int]) -> list[tuple[int, int]]:
        return [(2 * value, os.getpid()) for value in values]

    result = in_processes(function, range(num_values), num_processes)
    assert [value for value, _ in result] == [2 * value for value in range(num_values)]
    assert len({process for _, process in result}) == min(num_values, num_processes)


def test_more_than_a_pipe_holds() -> None:
    result = in_processes(lambda values: [bytes([value]) * 1_000_000 for value in values], range(4), 2)
    assert [content[-1] for content in result] == [0, 1, 2, 3]


def test_error_in_a_fork() -> None:
    def function(values: Sequence[int]) -> list[int]:
        if 1 in values:
            raise ZeroDivisionError("of the fork")
        return list(values)

    with pytest.raises(ZeroDivisionError, match="of the fork"):
        in_processes(function, range(4), 2)


def test_killed_fork() -> None:
    def function(values: Sequence[int]) -> list[int]:
        if 1 in values:
            os.kill(os.getpid(), signal.SIGKILL)
        return list(values)

    with pytest.raises(EOFError):
        in_processes(function, range(4), 2)
