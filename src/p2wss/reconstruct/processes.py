"""One function over many values in several processes, which share the memory of the first."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import TypeVar

import numpy as np

S = TypeVar("S")
T = TypeVar("T")


def in_processes(
    function: Callable[[Sequence[S]], list[T]], values: Sequence[S], num_processes: int
) -> list[T]:
    """``function(values)``, of which each value has one result, computed by this process and forks of it, which have
    all that it has in memory: ``num_processes`` in all, each of which takes the next value that none has taken. A fork
    lacks the threads of torch.

    An error of the function is raised here, too. Raises ``EOFError`` if a fork is killed.
    """
    num_processes = min(num_processes, len(values))
    if num_processes < 2:
        return function(values)
    context = get_context("fork")
    # a pipe gives each of its numbers to one reader, whichever comes first
    numbers, source = os.pipe()
    os.write(source, np.arange(len(values), dtype="<u2").tobytes())
    os.close(source)
    receivers = []
    for _ in range(1, num_processes):
        receiver, sender = context.Pipe(duplex=False)
        # a daemon ends with this process
        context.Process(target=_send, args=(receiver, sender, function, values, numbers), daemon=True).start()
        sender.close()
        receivers.append(receiver)
    result = _taken(function, values, numbers)
    os.close(numbers)
    for receiver in receivers:
        share = receiver.recv()
        if isinstance(share, Exception):
            raise share
        result |= share
    return [result[number] for number in range(len(values))]


def _taken(function: Callable[[Sequence[S]], list[T]], values: Sequence[S], numbers: int) -> dict[int, T]:
    """The results of the values that this process takes, by their numbers."""
    taken = (int.from_bytes(content, "little") for content in iter(partial(os.read, numbers, 2), b""))
    return {number: function([values[number]])[0] for number in taken}


def _send(
    receiver: Connection,
    sender: Connection,
    function: Callable[[Sequence[S]], list[T]],
    values: Sequence[S],
    numbers: int,
) -> None:
    # without a reader, the pipe of a process that was killed is broken, and this one ends
    receiver.close()
    with suppress(KeyboardInterrupt, BrokenPipeError):
        try:
            sender.send(_taken(function, values, numbers))
        except Exception as error:
            sender.send(error)
