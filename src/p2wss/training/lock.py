"""One training per folder: a second one would read and remove the checkpoints of the first."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from p2wss.nets import distributed
from p2wss.storage.errors import InputError

log = logging.getLogger("p2wss")

FILE_NAME = "training.lock"
# a training whose Snakemake was killed stops at its next step: this long, the one that follows waits for it
_PATIENCE_S = 60.0


@contextmanager
def training_lock(checkpoints: Path, patience_s: float = _PATIENCE_S) -> Iterator[None]:
    """Hold the folder of a training. The lock ends with the process, however that ends.

    Of several processes of a training the main one holds it. For a training that runs there this waits a little,
    because it may be about to stop. Raises :class:`InputError` if it goes on, or if the folder cannot be written to.
    """
    if not distributed.is_main_process():
        yield
        return
    lock = _acquired(checkpoints, time.monotonic() + patience_s)
    try:
        yield
    finally:
        (checkpoints / FILE_NAME).unlink(missing_ok=True)
        lock.release()
        # only an empty folder: not one with checkpoints, nor one that the next training has just locked
        with suppress(OSError):
            checkpoints.rmdir()


def _acquired(checkpoints: Path, until: float) -> FileLock:
    """The lock of a folder, which this process now holds, or will hold before ``until``."""
    path = checkpoints / FILE_NAME
    lock = FileLock(path)
    waiting = False
    while True:
        try:
            checkpoints.mkdir(parents=True, exist_ok=True)
            lock.acquire(timeout=0)
            return lock
        # a training that ended just now removed its empty folder
        except (Timeout, FileNotFoundError):
            if time.monotonic() >= until:
                raise InputError(f"{checkpoints}: another training runs in this folder") from None
        except OSError as error:
            raise InputError(f"{path}: not written: {error.strerror or error}") from error
        if not waiting:
            log.info("%s: another training runs in this folder; waiting for it to stop", checkpoints)
        waiting = True
        time.sleep(0.2)
