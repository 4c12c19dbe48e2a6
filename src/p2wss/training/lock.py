"""One training per folder: a second one would read and remove the checkpoints of the first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from p2wss.nets import distributed
from p2wss.storage.errors import InputError
from p2wss.storage.log_lines import log

# a training whose Snakemake was killed stops at its next step: this long, the one that follows waits for it
_PATIENCE_S = 60.0


@contextmanager
def training_lock(checkpoints: Path, patience_s: float = _PATIENCE_S) -> Iterator[None]:
    """Hold the folder of a training, by a file beside it. The lock ends with the process, however that ends.

    Of several processes of a training the main one holds it. For a training that runs there this waits a little,
    because it may be about to stop. Raises :class:`InputError` if it goes on, or if the file cannot be written.
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
        # before the next training begins; only an empty folder
        with suppress(OSError):
            checkpoints.rmdir()
        path.unlink(missing_ok=True)
        lock.release()
