"""Whether the code is compiled for this computer; apart from what compiles it, so that this is known at once."""

from __future__ import annotations

import hashlib
import os
import platform
import threading
from pathlib import Path

import numba
from llvmlite.binding import get_host_cpu_name

from p2wss.mesh.contraction import contracted
from p2wss.reconstruction.running.processes import can_fork
from p2wss.skeleton.compiled import alone_ahead, cache_folder, is_stored
from p2wss.storage.log_lines import log

# of processes that compile, each of which takes 0.6 GB
_MAX_PROCESSES = 4


def num_processes() -> int:
    """How many processes compile at once."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _MAX_PROCESSES)


def compile_once() -> None:
    """Compile the code of the product before a first run needs it function by function, if several cores are there, and
    no other process does the same: where many runs begin at once, as those of a workflow, one has further processes.

    The run compiles what is missing, whatever happens here. A process with threads is not forked: a fork has none of
    them, but what they had locked.
    """
    can_share = num_processes() > 1 and can_fork() and threading.active_count() == 1
    if not can_share or cache_folder() is None or is_stored(contracted):
        return
    from p2wss.reconstruction.warm_up import warm_product

    with alone_ahead() as is_alone:
        try:
            if is_alone:
                warm_product(num_processes())
        except Exception as error:
            log.debug("compiling ahead: %s", error)


def marker(with_scans: bool) -> Path | None:
    """The file beside the cached code that exists once all of these sources are compiled; None without a cache."""
    folder = cache_folder()
    if folder is None:
        return None
    digest = hashlib.blake2b(digest_size=6)
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    computer = platform.python_version(), numba.__version__, get_host_cpu_name()
    digest.update(repr((computer, with_scans)).encode())
    return folder / f"warm-up.{digest.hexdigest()}"
