"""One function of many values in several processes, which share the memory of the first."""

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

from p2wss.storage.errors import InputError
from p2wss.storage.log_lines import log
from p2wss.storage.temporary import Scratch

# numbers in a pipe, of 4 bytes each: a quarter of what one holds
_MAX_PIPED = 4096
# in place of the number of a value: what follows is an error
_ERROR = -1


S = TypeVar("S")
T = TypeVar("T")


def can_fork() -> bool:
    """Whether this process can have forks."""
    return "fork" in get_all_start_methods() and not current_process().daemon


class Shared(Generic[S, T]):
    """``function`` of each value, by forks of this process: all but one of ``num_processes`` from now on, the last
    while this one waits, as it iterates over the results. Each takes the next value, or few values, that none has
    taken. With no process, and where none can be forked, this one does all.

    The iteration is for once, and gives the numbers of values and their results in the order in which they are done.
    Forks have all that this process has in memory, but lack the threads of torch. An error of the function is raised
    here, too. A fork may be killed, by the system or by an error of compiled code: what it had finished is kept, and
    what it had in hand is tried by a new one, alone. If that is killed, too, a third one gives what the first of
    ``instead`` makes of the value and of how the fork ended, and so on; the last of them is called by this process.
    Without ``instead``, that is a ChildProcessError. folder: of a temporary file with the results of each fork.
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
        # a pipe gives each of its numbers to one reader, whichever comes first, and holds all of them before that
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
        # without memory for a fork, this process does what is left
        with suppress(OSError):
            fork = _Fork(self._own(), self._folder)
            self._forks[fork.receiver] = fork

    def _of_forks(self) -> Iterator[tuple[int, T]]:
        if self._num_processes:
            self._start()
        # those that are killed before they take a value are not replaced for ever
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
        """The numbers of the values that this process takes, and their results."""
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
    """A fork of this process that iterates over ``results``, pairs of a number and a value, and writes each value into
    a file, where it stays whatever happens to the fork.

    ending: how it ended before its last result; empty before, and if it did not. error: what it raised, if it did.
    """

    def __init__(self, results: Iterable[tuple[int, T]], folder: Path) -> None:
        self.ending, self.is_running = "", True
        self.error: Exception | None = None
        self._scratch = Scratch(folder, "results")
        # where compiled code ends
        self._stack = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self._parent = os.getpid()
        context = get_context("fork")
        self.receiver, sender = context.Pipe(duplex=False)
        # a daemon ends with this process
        self._process = context.Process(target=self._send, args=(results, sender), daemon=True)
        self._process.start()
        sender.close()

    def received(self) -> list[tuple[int, T]]:
        """The next result; none at the end."""
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
        # searching what it has in common with the first process would copy that; of its own, hardly anything is garbage
        gc.freeze()
        gc.set_threshold(50_000)
        # without a reader, the pipe of a process that was killed is broken, and this one ends
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
