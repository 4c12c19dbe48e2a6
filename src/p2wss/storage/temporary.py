"""Temporary files and folders, with names that tell which of them are left from killed processes and can be removed."""

import hashlib
import os
import re
import shutil
import socket
import tempfile
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Self

from p2wss.storage.messages import writing

# whether a process of another host still runs is unknown: its files are removed when they are this old
_ABANDONED_S = 24 * 3600.0
_NAME = re.compile(r"^\..*~(?P<host>[0-9a-f]{8})-(?P<process>\d+)-")
# folders that this process has tidied
_tidied: set[tuple[str, int]] = set()


def temporary_prefix(stem: str) -> str:
    """The beginning of the name of a hidden temporary file: ``stem``, this host and this process."""
    return f".{stem}~{_host()}-{os.getpid()}-"


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders of processes that have ended, once per process and folder."""
    key = (os.path.abspath(folder), os.getpid())
    if key in _tidied:
        return
    _tidied.add(key)
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _NAME.match(entry.name)
            if match is None:
                continue
            with suppress(OSError):  # another process may be tidying too
                age_s = time.time() - entry.stat(follow_symlinks=False).st_mtime
                # whether a process on another host still runs is unknown: only the age of its file tells
                is_left = age_s > _ABANDONED_S
                if match["host"] == _host():
                    is_left = not is_running(int(match["process"]))
                if is_left:
                    if entry.is_dir(follow_symlinks=False):
                        shutil.rmtree(entry.path)
                    else:
                        os.unlink(entry.path)


@contextmanager
def temporary_folder(stem: str, parent: str | Path | None = None) -> Iterator[Path]:
    """A hidden folder in ``parent``, or where the system keeps temporary files; it is removed at the end of the block.

    Such folders of killed processes in ``parent`` are removed, too.
    """
    parent = Path(parent or tempfile.gettempdir())
    remove_leftovers(parent)
    with tempfile.TemporaryDirectory(prefix=temporary_prefix(stem), dir=parent) as folder:
        yield Path(folder)


def is_running(process: int) -> bool:
    """Whether a process of this host runs."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        return True
    return True


@cache
def _host() -> str:
    """Eight hexadecimal digits that identify host, boot and container, within which process ids are unique."""
    parts = [socket.gethostname()]
    for path in ("/proc/sys/kernel/random/boot_id", "/proc/self/ns/pid"):
        with suppress(OSError):
            parts.append(
                os.readlink(path) if path.endswith("pid") else Path(path).read_text(encoding="utf-8")
            )
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=4).hexdigest()


class Closeable:
    """Base of objects that a ``with`` block closes at its end, also after an error."""

    def close(self) -> None:
        """Release all resources; the object cannot be used afterwards."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class Scratch(Closeable):
    """A file without a name, for what memory has no room for: it vanishes when it is closed or the process ends.

    Raises :class:`InputError` if the disk of ``folder`` is full. content: what the file holds, for that message.
    """

    def __init__(self, folder: Path, content: str) -> None:
        self.num_bytes = 0
        self._name = f"{folder}: temporary file of {content}"
        with writing(self._name):
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        # a scene that nobody closes takes the file with it, without a ResourceWarning
        weakref.finalize(self, self._file.close)

    def close(self) -> None:
        """Close the file, which removes it."""
        self._file.close()

    def append(self, content: bytes | memoryview) -> None:
        """Add bytes at the end. Raises :class:`InputError` if the disk is full."""
        with writing(self._name):
            self._file.seek(self.num_bytes)
            self._file.write(content)
            self._file.flush()
        self.num_bytes += len(content)

    def read(self, place: int, size: int) -> bytes:
        """``size`` bytes from ``place`` on. Several processes may read at the same time."""
        return os.pread(self._file.fileno(), size, place)
