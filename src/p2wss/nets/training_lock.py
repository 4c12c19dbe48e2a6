"""One training per folder: a second one would read and remove the checkpoints of the first."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from p2wss.errors import InputError
from p2wss.nets import distributed
from p2wss.storage.temporary import is_running

log = logging.getLogger("p2wss")

FILE_NAME = "training.lock"
# a training whose Snakemake was killed stops at its next step: this long, the one that follows waits for it
_PATIENCE_S = 60.0


@contextmanager
def training_lock(checkpoints: Path, patience_s: float = _PATIENCE_S) -> Iterator[None]:
    """Hold the folder of a training. The lock ends with the process, however that ends.

    Of several processes of a training the main one holds it. The file ``training.lock`` states host and process; one
    that a killed training left is taken over, and for one that is running this waits a little, because it may be about
    to stop. Raises :class:`InputError` if another training holds the folder, or if it cannot be written to.
    """
    if not distributed.is_main_process():
        yield
        return
    path = checkpoints / FILE_NAME
    descriptor = _patiently_locked(path, time.monotonic() + patience_s)
    try:
        holder = {
            "host": socket.gethostname(),
            "process": os.getpid(),
            "since": datetime.now().isoformat()[:19],
        }
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, (json.dumps(holder) + "\n").encode(), 0)
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)
        # only an empty folder: not one with checkpoints, nor one that the next training has just locked
        with suppress(OSError):
            checkpoints.rmdir()


class _HeldError(InputError):
    """Another training holds the folder."""


def _patiently_locked(path: Path, until: float) -> int:
    """The open file of a lock that this process now holds, or will hold before ``until``."""
    waiting = False
    while True:
        try:
            return _locked(path)
        except _HeldError as error:
            if time.monotonic() >= until:
                raise
            if not waiting:
                log.info("%s; waiting for it to stop", error)
            waiting = True
            time.sleep(0.2)


def _locked(path: Path) -> int:
    """The open file of a lock that this process now holds."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                _acquire(descriptor, path)
                if _is_same_file(descriptor, path):  # the one that ended just now may have removed it
                    return descriptor
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)
    except FileNotFoundError as error:
        # a training that ended just now removed the empty folder between the two calls
        raise _HeldError(f"{path}: its folder was removed") from error
    except OSError as error:
        raise InputError(f"{path}: not written: {error.strerror or error}") from error


def _acquire(descriptor: int, path: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _HeldError(_held(path, _holder(descriptor))) from None
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
        # a file system without locks: what the file states must do
        holder = _holder(descriptor)
        on_this_host = holder.get("host") == socket.gethostname()
        if holder and not (on_this_host and not is_running(int(holder["process"]))):
            raise _HeldError(f"{_held(path, holder)}; if it does not run any more, delete {path}") from None


def _held(path: Path, holder: dict[str, Any]) -> str:
    return (
        f"{path.parent}: another training runs in this folder: process {holder.get('process', '?')} on"
        f" {holder.get('host', '?')}, since {holder.get('since', '?')}"
    )


def _holder(descriptor: int) -> dict[str, Any]:
    try:
        holder = json.loads(os.pread(descriptor, 4096, 0))
    except ValueError:
        return {}
    return holder if isinstance(holder, dict) else {}


def _is_same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
