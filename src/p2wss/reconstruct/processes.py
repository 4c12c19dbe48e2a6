"""One function over many values in several processes, which share the memory of the first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")


def in_processes(
    function: Callable[[Sequence[S]], list[T]], values: Sequence[S], num_processes: int
) -> list[T]:
    """``function(values)``, of which each value has one result, computed in ``num_processes`` shares: the first by this
    process, the others by forks of it, which have all that it has in memory. A fork lacks the threads of torch.

    An error of the function is raised here, too. Raises ``EOFError`` if a fork is killed.
    """
    result: list[T] = [None] * len(values)  # type: ignore[list-item]
    context = get_context("fork")
    receivers = {}
    for first in range(1, min(num_processes, len(values))):
        receivers[first], sender = context.Pipe(duplex=False)
        arguments = (receivers[first], sender, function, values[first::num_processes])
        # a daemon ends with this process
        context.Process(target=_send, args=arguments, daemon=True).start()
        sender.close()
    result[::num_processes] = function(values[::num_processes])
    for first, receiver in receivers.items():
        share = receiver.recv()
        if isinstance(share, Exception):
            raise share
        result[first::num_processes] = share
    return result


def _send(
    receiver: Connection, sender: Connection, function: Callable[[Sequence[S]], list[T]], values: Sequence[S]
) -> None:
    # without a reader, the pipe of a process that was killed is broken, and this one ends
    receiver.close()
    with suppress(KeyboardInterrupt, BrokenPipeError):
        try:
            sender.send(function(values))
        except Exception as error:
            sender.send(error)
