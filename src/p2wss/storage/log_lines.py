"""Lines of the log: plain text, or JSON objects for programs."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise

log = logging.getLogger("p2wss")


class TextLines(logging.Formatter):
    """The message, after the time where details are shown."""

    def format(self, record: logging.LogRecord) -> str:
        """See :meth:`logging.Formatter.format`."""
        time = f"{self.formatTime(record)} " if log.isEnabledFor(logging.DEBUG) else ""
        return time + super().format(record)


class JsonLines(logging.Formatter):
    """An object with ``time``, ``level`` and ``message``, and what the attribute ``fields`` of the record has."""

    def format(self, record: logging.LogRecord) -> str:
        """See :meth:`logging.Formatter.format`."""
        level = record.levelname.lower()
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        message = super().format(record).removeprefix(f"{level}: ")
        row = {"time": time, "level": level, "message": message, **getattr(record, "fields", {})}
        return json.dumps(row, ensure_ascii=False)


def start(words: Sequence[str]) -> None:
    """Send the log to stderr: as JSON where the words of a command ask for it, also of errors in other words."""
    log.setLevel(logging.NOTSET)
    is_json = "--log-format=json" in words or ("--log-format", "json") in pairwise(words)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if is_json else TextLines())
    logging.basicConfig(handlers=[handler], level=logging.INFO)
    if is_json:
        logging.captureWarnings(True)
        sys.excepthook = lambda *error: log.critical("unexpected error", exc_info=error)


def is_json() -> bool:
    """Whether stderr gets JSON, with which nothing else may be mixed."""
    return any(isinstance(handler.formatter, JsonLines) for handler in logging.root.handlers)
