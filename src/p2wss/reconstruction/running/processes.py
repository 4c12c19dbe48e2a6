"""One function applied to many values by several processes, which share the memory of the first process."""

from __future__ import annotations

import faulthandler
import gc
import os
import pickle
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from multiprocessing import current_process, get_all_start_methods, get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from signal import Signals
from typing import Any, Generic, TypeVar

import numpy as np

from p2wss.storage.messages import InputError, log
from p2wss.storage.temporary import Scratch

# most numbers in a pipe, of 4 bytes each: a quarter of what a pipe holds
_MAX_PIPED = 4096
# sent in place of the number of a value where an error follows
_ERROR = -1


S = TypeVar("S")
T = TypeVar("T")


def can_fork() -> bool:
    """Whether this process can fork: not on all systems, and not in a daemon."""
    return "fork" in get_all_start_methods() and not current_process().daemon


class Shared(Generic[S, T]):
    """``function`` of each value, computed by forks of this process. All forks but one start now; the last one starts
    with the iteration over the results, when this process only waits. Each fork takes the next value, or the next few
    values, that no fork has taken. With ``num_processes`` 0, or where forking fails, this process computes all.

    It can be iterated once, and yields (number of the value, result) in the order in which they are done. Forks have
    all that this process has in memory, but lack the threads of torch. Without ``instead``, an error of the function in
    a fork is raised here.

    A fork may be killed by the system or by an error of compiled code. What it had finished is kept, and each value it
    had in hand is tried once more by a fork of its own. If that fails, a further fork calls the first function of
    ``instead`` with the value and with how the fork had ended, and so on; the last of ``instead`` is called by this
    process. Without ``instead``, a ChildProcessError is raised. With ``instead``, an error of the function in a fork
    counts as a killed fork, unless it is an :class:`InputError`. folder: for a temporary file with the results of each
    fork.
    """

    def __init__(
        self,
        function: Callable[[S], T],
        values: Sequence[S],
        num_processes: int,
        instead: Sequence[Callable[[S, str], T]] = (),
        folder: Path | None = None,
    ) -> None:
        self._function, self._values, self._instead = function, values, instead
        self._folder = folder or Path(tempfile.gettempdir())
        # the pipe is a queue: it holds all numbers from the start, and gives each to the first process that reads
        self._numbers, source = os.pipe()
        self._step = len(values) // _MAX_PIPED + 1
        os.write(source, np.arange(0, len(values), self._step, dtype="<u4").tobytes())
        os.close(source)
        self._num_processes = min(num_processes, len(values)) if can_fork() else 0
        self._forks: dict[Connection, _Fork[T]] = {}
        for _ in range(1, self._num_processes):
            self._start()

    def __iter__(self) -> Iterator[tuple[int, T]]:
        missing = set(range(len(self._values)))
        try:
            for number, result in chain(self._of_forks(), self._own()):
                missing.remove(number)
                yield number, result
        finally:
            os.close(self._numbers)
            for fork in self._forks.values():
                fork.close()
        for number in sorted(missing):
            yield number, self._alone(number)

    def _start(self) -> None:
        # if there is no memory for a fork, this process does what is left
        with suppress(OSError):
            fork = _Fork(self._own(), self._folder)
            self._forks[fork.receiver] = fork

    def _of_forks(self) -> Iterator[tuple[int, T]]:
        if self._num_processes:
            self._start()
        # a limit, as otherwise forks that are killed before they take a value would be replaced for ever
        num_more = len(self._values)
        while self._forks:
            for fork in [self._forks[receiver] for receiver in wait(self._forks)]:  # type: ignore[index]
                yield from fork.received()
                if fork.is_running:
                    continue
                del self._forks[fork.receiver]
                fork.close()
                self._raise_if_strict(fork)
                if fork.ending and num_more:
                    log.warning("warning: a process was killed, perhaps for want of memory; another goes on")
                    num_more -= 1
                    self._start()

    def _own(self) -> Iterator[tuple[int, T]]:
        """Take values that no process has taken until none is left; yield their numbers and results."""
        for content in iter(partial(os.read, self._numbers, 4), b""):
            first = int.from_bytes(content, "little")
            for number in range(first, min(first + self._step, len(self._values))):
                yield number, self._function(self._values[number])

    def _alone(self, number: int) -> T:
        """The result of a value at which a process was killed."""
        ending = ""
        for attempt in (lambda value, ending: self._function(value), *self._instead[:-1]):
            results = ((number, function(self._values[number], ending)) for function in [attempt])
            fork = _Fork(results, self._folder)
            done = [result for received in iter(fork.received, []) for _, result in received]
            fork.close()
            if done:
                return done[0]
            self._raise_if_strict(fork)
            ending = ending or fork.ending
        if not self._instead:
            raise ChildProcessError(ending)
        return self._instead[-1](self._values[number], ending)

    def _raise_if_strict(self, fork: _Fork[T]) -> None:
        if fork.error is not None and (isinstance(fork.error, InputError) or not self._instead):
            raise fork.error


class _Fork(Generic[T]):
    """A fork of this process that iterates over ``results``, pairs of a number and a value. It writes each value into a
    file, where the value stays whatever happens to the fork.

    ending: how the fork ended too early; empty while it runs, and if it completed. error: what it raised, or None.
    """

    def __init__(self, results: Iterable[tuple[int, T]], folder: Path) -> None:
        self.ending, self.is_running = "", True
        self.error: Exception | None = None
        self._scratch = Scratch(folder, "results")
        # faulthandler writes here where compiled code crashed
        self._stack = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self._parent = os.getpid()
        context = get_context("fork")
        self.receiver, sender = context.Pipe(duplex=False)
        # a daemon ends with this process
        self._process = context.Process(target=self._send, args=(results, sender), daemon=True)
        self._process.start()
        sender.close()

    def received(self) -> list[tuple[int, T]]:
        """A list of the next result; empty at the end."""
        message: tuple[int, int, int] | None = None
        try:
            message = self.receiver.recv()
        except (EOFError, OSError):
            self._process.join()
            self._stack.seek(0)
            status = self._process.exitcode or 0
            by = f"killed by {Signals(-status).name}" if status < 0 else f"ended with status {status}"
            self.ending = f"{self._stack.read().decode(errors='replace')}its process was {by}"
        if message is None:
            self.is_running = False
            return []
        number, place, size = message
        # what the fork wrote, into a file that no other can open
        value = pickle.loads(self._scratch.read(place, size))  # nosec B301
        if number != _ERROR:
            return [(number, value)]
        self.error, self.is_running = value, False
        self.ending = "".join(getattr(value, "__notes__", [])) or str(value)
        return []

    def close(self) -> None:
        """End the fork, and remove its files."""
        self._process.kill()
        self._process.join()
        self.receiver.close()
        self._scratch.close()
        self._stack.close()

    def _send(self, results: Iterable[tuple[int, Any]], sender: Connection) -> None:
        self.receiver.close()
        faulthandler.enable(self._stack, all_threads=False)
        # a search for garbage would copy the memory that the fork shares; its own objects are hardly ever garbage
        gc.freeze()
        gc.set_threshold(50_000)
        # if the first process was killed, its pipe is broken, and this one ends
        with suppress(KeyboardInterrupt, BrokenPipeError):
            try:
                for number, value in results:
                    self._write(sender, number, value)
                    if os.getppid() != self._parent:
                        return
                sender.send(None)
            except Exception as error:
                error.add_note(traceback.format_exc())
                self._write(sender, _ERROR, error)

    def _write(self, sender: Connection, number: int, value: Any) -> None:
        content = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        place = self._scratch.num_bytes
        self._scratch.append(content)
        sender.send((number, place, len(content)))
