"""What users read: the one exception that they see, the conversion of errors of files and of libraries that read them
into it, and lines of the log."""

import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

log = logging.getLogger("p2wss")
_MAX_REASON = 300


class InputError(Exception):
    """An error that the user can correct: the message is one line that names the file, the building and what to do.

    The command line prints it as it is and exits with status 2.
    """


@contextmanager
def reading(path: str | Path, kind: str) -> Iterator[None]:
    """Raise any error of the block as an :class:`InputError` that names ``path``.

    The block must do nothing but read that file: for damaged files, libraries raise dozens of kinds of errors. A
    missing package is not converted. kind: what the file is not, as in "a readable Parquet file".
    """
    try:
        yield
    except (InputError, ModuleNotFoundError):
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise InputError(f"{path}: is a folder; name a file in it") from error
    except PermissionError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    except MemoryError as error:
        raise InputError(f"{path}: not {kind}: it would take more memory than there is") from error
    except BaseException as error:
        # libraries in Rust raise a failed assertion as PanicException, which is no Exception
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise InputError(f"{path}: not {kind}: {_reason(error)}") from error


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Raise an ``OSError`` of the block, such as that of a full disk, as an :class:`InputError` that names ``path``."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: not written: {error.strerror or error}") from error


def _reason(error: BaseException) -> str:
    """An error of a library in one line."""
    if "previous exception" in str(error) and error.__cause__ is not None:  # of rasterio: the reason is there
        return _reason(error.__cause__)
    text = " ".join(str(error).split())[:_MAX_REASON]
    if isinstance(error, RecursionError):
        return "nested too deeply"
    return f"missing {text}" if isinstance(error, KeyError) else text or type(error).__name__


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
