"""Lines of the log."""

import logging
import sys
from collections.abc import Sequence

log = logging.getLogger("p2wss")


class TextLines(logging.Formatter):
    """The message, after the time where details are shown."""

    def format(self, record: logging.LogRecord) -> str:
        """See :meth:`logging.Formatter.format`."""
        time = f"{self.formatTime(record)} " if log.isEnabledFor(logging.DEBUG) else ""
        return time + super().format(record)


def first_of(names: Sequence[str], most: int = 5) -> str:
    """The first names, and how many there are more.

    >>> first_of("abcdefg")
    'a, b, c, d, e and 2 more'
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def start() -> None:
    """Send the log to stderr."""
    log.setLevel(logging.NOTSET)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(TextLines())
    logging.basicConfig(handlers=[handler], level=logging.INFO)
