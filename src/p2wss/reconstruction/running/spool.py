"""Sequences that are not in memory: values in a temporary file, and values that are computed at each access."""

import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from p2wss.storage.temporary import Closeable, Scratch

# the first values stay in memory, about 25 KiB each; a cache of the last ones would not help a large run, which reads
# all of them in order again and again
_NUM_KEPT = 4096
T = TypeVar("T")
S = TypeVar("S")


class Lazy(Sequence[T], Generic[S, T]):
    """``function`` of each element of ``source``, computed anew at each access."""

    def __init__(self, function: Callable[[S], T], source: Sequence[S]) -> None:
        self._function, self._source = function, source

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: Any) -> Any:
        element = self._source[index]
        return Lazy(self._function, element) if isinstance(index, slice) else self._function(element)


class Spool(Lazy[int, T], Closeable):
    """``count`` values, the first set ones in memory, the others in a :class:`~p2wss.storage.temporary.Scratch` file in
    ``folder``.

    A value may be replaced; its place in the file is then not used again. Reading a value that was not set raises a
    KeyError. Do not change a value in place: other accesses may return the same object.
    """

    def __init__(self, count: int, folder: Path) -> None:
        super().__init__(self._value, range(count))
        self._place: dict[int, tuple[int, int]] = {}
        self._kept: dict[int, T] = {}
        self._scratch = Scratch(folder, "results")

    def close(self) -> None:
        """Remove the file."""
        self._scratch.close()

    def __setitem__(self, index: int, value: T) -> None:
        self._kept.pop(index, None)
        if len(self._kept) < _NUM_KEPT:
            self._kept[index] = value
        else:
            content = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
            self._place[index] = (self._scratch.num_bytes, len(content))
            self._scratch.append(content)

    def _value(self, index: int) -> T:
        if index in self._kept:
            return self._kept[index]
        # what this process wrote, into a file that no other can open
        value: T = pickle.loads(self._scratch.read(*self._place[index]))  # nosec B301
        return value
