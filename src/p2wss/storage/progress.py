"""Progress of long loops: a bar on a terminal, plain lines in a log."""

import logging
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Self

from p2wss.storage.messages import log

INTERVAL_S = 2.0
# lines of a log become rarer: the next one comes after at least this share of the time so far
LATER = 0.1


class Progress(ExitStack):
    """How many of ``total`` items are done, for use in a ``with`` block.

    On a terminal a tqdm bar shows it. Elsewhere ``report`` gets lines: at most one in two seconds, later fewer and
    fewer, and none for the last item, because a summary follows. Nothing is shown where the log's level hides
    information, and no bar where it shows details. ``initial`` items were done before, for example by an interrupted
    run.
    """

    def __init__(
        self,
        title: str,
        total: int,
        unit: str,
        initial: int = 0,
        report: Callable[[str], None] = log.info,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self.title, self.total, self.unit, self.initial = title, total, unit, initial
        self._report, self._clock = report, clock
        self._began_at = self._reported_at = clock()
        # the number of items of the first report, and its time: what was before, such as compilation, says nothing of
        # the others
        self._first: tuple[int, float] | None = None
        self._bar: Any = None

    def __enter__(self) -> Self:
        if sys.stderr.isatty() and log.getEffectiveLevel() == logging.INFO:
            from tqdm import tqdm
            from tqdm.contrib.logging import logging_redirect_tqdm

            self.enter_context(logging_redirect_tqdm())
            self._bar = self.enter_context(
                tqdm(
                    desc=self.title,
                    total=self.total,
                    unit=f" {self.unit}",
                    initial=self.initial,
                    dynamic_ncols=True,
                )
            )
        return self

    def update(self, num_done: int, note: str = "") -> None:
        """Report that ``num_done`` items are done, those of ``initial`` among them; ``note`` is shown too."""
        if self._bar is not None:
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(num_done - self._bar.n)
            return
        now = self._clock()
        first, at = self._first = self._first or (num_done, now)
        if (
            now - self._reported_at < max(INTERVAL_S, LATER * (self._reported_at - self._began_at))
            or num_done >= self.total
        ):
            return
        self._reported_at = now
        left = ""
        if num_done > first:
            left = f", about {_duration((self.total - num_done) * (now - at) / (num_done - first))} left"
        self._report(
            f"{self.title}: {num_done} of {self.total} {self.unit}{left}" + (f", {note}" if note else "")
        )


def _duration(seconds: float) -> str:
    """Seconds up to two minutes, then minutes.

    >>> _duration(65.2), _duration(150)
    ('65 s', '2 min')
    """
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
