"""Make the batches of a training ahead of its steps, in other processes. Used by completion.py."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Generic, TypeVar

T = TypeVar("T")

# batches that a fork makes before the first of them is needed
_AHEAD = 2


class Forks(Generic[T]):
    """``make(step)`` for ascending steps, made ahead by ``num_processes`` forks of this process; with 0, by this
    process.

    Fork i makes the steps whose number divided by the number of forks leaves the remainder i. So the results do not
    depend on the number of forks. If a fork is killed, this process makes the further steps. To be created before
    threads.
    """

    def __init__(self, make: Callable[[int], T], num_processes: int) -> None:
        self._make, self._asked = make, -1
        self._forks: list[Connection] = []
        context = get_context("fork")
        for _ in range(num_processes):
            here, there = context.Pipe()
            # a daemon ends with this process
            context.Process(target=self._serve, args=(here, there), daemon=True).start()
            there.close()
            self._forks.append(here)

    def __getitem__(self, step: int) -> T:
        num = len(self._forks)
        if not num:
            return self._make(step)
        try:
            for each in range(max(self._asked + 1, step), step + _AHEAD * num):
                self._forks[each % num].send(each)
                self._asked = each
            fork = self._forks[step % num]
            while (message := fork.recv())[0] < step:
                pass
        except (EOFError, OSError):
            self.close()
            return self._make(step)
        if isinstance(message[1], Exception):
            raise message[1]
        return message[1]

    def close(self) -> None:
        """End the forks."""
        for fork in self._forks:
            fork.close()
        self._forks = []

    def _serve(self, here: Connection, there: Connection) -> None:
        # closes the inherited ends of the first process, so that this process ends with it
        for connection in (*self._forks, here):
            connection.close()
        # the first process decides: it may want the next batches before it stops
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)
        with suppress(EOFError, OSError):
            while True:
                step = there.recv()
                try:
                    there.send((step, self._make(step)))
                except (EOFError, OSError):
                    raise
                except Exception as error:
                    there.send((step, error))
