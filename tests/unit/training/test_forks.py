"""What forks make for the steps of a training: in order, also when one is killed or fails."""

from __future__ import annotations

import os
import signal
import time
from contextlib import closing

import pytest
from completion_forks import Forks


def made(step: int) -> tuple[int, int]:
    return step, os.getpid()


@pytest.mark.parametrize("num", [0, 1, 3])
def test_each_step_has_its_own_result(num: int) -> None:
    with closing(Forks(made, num)) as forks:
        results = [forks[step] for step in range(4, 20)]
    assert [step for step, _ in results] == [*range(4, 20)]
    makers = {process for _, process in results}
    assert makers == {os.getpid()} if not num else len(makers) == num and os.getpid() not in makers


def test_this_process_makes_what_a_killed_one_had_to() -> None:
    with closing(Forks(made, 2)) as forks:
        _, process = forks[0]
        os.kill(process, signal.SIGKILL)
        results = [forks[step] for step in range(1, 9)]
    assert [step for step, _ in results] == [*range(1, 9)]
    assert results[-1][1] == os.getpid()


def test_an_error_is_raised_here() -> None:
    def fails(step: int) -> int:
        if step == 2:
            raise ValueError("step two")
        return step

    with closing(Forks(fails, 2)) as forks:
        assert [forks[0], forks[1]] == [0, 1]
        with pytest.raises(ValueError, match="step two"):
            forks[2]
        assert forks[3] == 3


def test_forks_outlast_a_request_to_stop_but_not_their_end() -> None:
    """The training writes a checkpoint first, for which it may need the next batch."""
    forks = Forks(made, 1)
    _, process = forks[0]
    os.kill(process, signal.SIGTERM)
    assert forks[1] == (1, process) and forks[5] == (5, process)
    forks.close()
    for _ in range(100):
        if os.waitpid(process, os.WNOHANG)[0]:
            return
        time.sleep(0.02)
    pytest.fail("the fork is still there")
