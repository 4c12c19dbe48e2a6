"""One training per folder: a second one would read and remove the checkpoints of the first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from p2wss.nets import distributed
from p2wss.storage.errors import InputError
from p2wss.storage.log_lines import log

# a training whose Snakemake was killed stops at its next step; the following training waits for it this long
_PATIENCE_S = 60.0


@contextmanager
def training_lock(checkpoints: Path, patience_s: float = _PATIENCE_S) -> Iterator[None]:
    """Hold the folder of a training, by a file beside it. The lock ends with the process, however the process ends.

    If a training has several processes, the main one holds the lock. If another training holds the folder, this waits
    for ``patience_s``, as that training may be about to stop. Raises :class:`InputError` if it goes on, or if the file
    cannot be written.
    """
    if not distributed.is_main_process():
        yield
        return
    path = checkpoints.absolute().with_name(f"{checkpoints.absolute().name}.lock")
    lock = FileLock(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            log.info("%s: another training runs in this folder; waiting for it to stop", checkpoints)
            lock.acquire(timeout=patience_s, poll_interval=0.2)
    except Timeout:
        raise InputError(f"{checkpoints}: another training runs in this folder") from None
    except OSError as error:
        raise InputError(f"{path}: not written: {error.strerror or error}") from error
    try:
        yield
    finally:
        # while no other training can begin; removes the folder only if it is empty
        with suppress(OSError):
            checkpoints.rmdir()
        path.unlink(missing_ok=True)
        lock.release()
