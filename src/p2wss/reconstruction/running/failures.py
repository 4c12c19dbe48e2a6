"""What a run does where its own code fails: everything else goes on, and the user is told.

Within :meth:`Failures.met`, :func:`surviving` catches what a function raises, a MemoryError included. Elsewhere, and
with ``reconstruct.strict``, the error is raised.
"""

import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

from p2wss.storage.messages import InputError, log

T = TypeVar("T")


class Failures:
    """The failures of a run. strict: raise the first error. traces: the traceback of each failure, by the name of what
    failed, such as the id of a building."""

    def __init__(self, strict: bool = False) -> None:
        self._strict = strict
        self.traces: dict[str, str] = {}

    @contextmanager
    def met(self) -> Iterator[None]:
        """A ``with`` block in which errors are met, also in processes forked in it; raised if ``strict``."""
        token = _current.set(None if self._strict else self)
        try:
            yield
        finally:
            _current.reset(token)

    @property
    def text(self) -> str:
        """All tracebacks, sorted by what failed."""
        return "\n".join(f"{name}\n{self.traces[name].rstrip()}\n" for name in sorted(self.traces))


_current: ContextVar[Failures | None] = ContextVar("failures", default=None)


def met() -> Failures | None:
    """The failures of the run within :meth:`Failures.met`; None elsewhere, and with ``strict``."""
    return _current.get()


def note(name: str, trace: str, instead: str) -> None:
    """Keep the traceback of what failed, and log a line; only the first time for a ``name``. instead: what the run does
    in its place, for the log."""
    failures = met()
    if failures is None or name in failures.traces:
        return
    failures.traces[name] = trace
    text = "warning: %s: internal error, %s: %s; see the file .errors.log of the results"
    log.warning(text, name, instead, trace.rstrip().rsplit("\n", 1)[-1])
    log.debug("%s", trace)


def surviving(
    function: Callable[[Any], Iterable[T]], parts: Any, instead: Callable[[Any, str], Iterable[T]]
) -> list[T]:
    """All that ``function`` returns for a sequence of parts. Where it raises, it is called for each half of the parts,
    and so on. For a single part at which it raises, ``instead`` is called with the part and the traceback.

    The result for a part must not depend on the others. Errors are raised outside :meth:`Failures.met`; an
    :class:`InputError` always is, as the user can correct it.
    """
    try:
        return list(function(parts))
    except InputError:
        raise
    except Exception as error:
        # compiled code turns an interrupt into another error
        if met() is None or not len(parts) or isinstance(error.__cause__, KeyboardInterrupt):
            raise
        trace = traceback.format_exc()
    if len(parts) == 1:
        return list(instead(parts[0], trace))
    middle = len(parts) // 2
    return [each for half in (parts[:middle], parts[middle:]) for each in surviving(function, half, instead)]
