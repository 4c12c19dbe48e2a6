"""One function of many values in several processes, which share the memory of the first."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

import numpy as np

# numbers in a pipe, of 4 bytes each: a quarter of what one holds
_MAX_PIPED = 4096

log = logging.getLogger("p2wss")

S = TypeVar("S")
T = TypeVar("T")


class Shared(Generic[S, T]):
    """``function`` of each value: by forks of this process from now on, and by this one where it iterates over the
    results; ``num_processes`` in all, each of which takes the next value, or few values, that none has taken.

    The iteration is for once. It gives the numbers of values and their results, its own ascending, then those of the
    forks. These have all that this process has in memory, but lack the threads of torch. An error of the function is
    raised here, too. What a fork that is killed had taken, this process does at last.
    """

    def __init__(self, function: Callable[[S], T], values: Sequence[S], num_processes: int) -> None:
        self._function, self._values = function, values
        context = get_context("fork")
        # a pipe gives each of its numbers to one reader, whichever comes first, and holds all of them before that
        self._numbers, source = os.pipe()
        self._step = len(values) // _MAX_PIPED + 1
        os.write(source, np.arange(0, len(values), self._step, dtype="<u4").tobytes())
        os.close(source)
        self._receivers: list[Connection] = []
        for _ in range(1, min(num_processes, len(values))):
            receiver, sender = context.Pipe(duplex=False)
            # a daemon ends with this process
            context.Process(target=self._send, args=(receiver, sender), daemon=True).start()
            sender.close()
            self._receivers.append(receiver)

    def __iter__(self) -> Iterator[tuple[int, T]]:
        missing = set(range(len(self._values)))
        for number, result in chain(self._own(), self._of_forks()):
            missing.remove(number)
            yield number, result
        if missing:
            log.warning("warning: a process was killed, perhaps for want of memory; its buildings follow")
        for number in sorted(missing):
            yield number, self._function(self._values[number])

    def _of_forks(self) -> Iterator[tuple[int, T]]:
        os.close(self._numbers)
        for receiver in self._receivers:
            while (message := _received(receiver)) is not None:
                if isinstance(message, Exception):
                    raise message
                yield message

    def _own(self) -> Iterator[tuple[int, T]]:
        """The numbers of the values that this process takes, and their results."""
        for content in iter(partial(os.read, self._numbers, 4), b""):
            first = int.from_bytes(content, "little")
            for number in range(first, min(first + self._step, len(self._values))):
                yield number, self._function(self._values[number])

    def _send(self, receiver: Connection, sender: Connection) -> None:
        # without a reader, the pipe of a process that was killed is broken, and this one ends
        receiver.close()
        with suppress(KeyboardInterrupt, BrokenPipeError):
            try:
                # all before the first is sent, as nobody may read them before the end
                for result in list(self._own()):
                    sender.send(result)
                sender.send(None)
            except Exception as error:
                sender.send(error)


def _received(receiver: Connection) -> Any:
    """The next message, None after the last: a process that was killed has closed its pipe, perhaps within one."""
    with suppress(EOFError, OSError):
        return receiver.recv()
    return None
