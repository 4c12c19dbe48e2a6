"""Whether the code is compiled for this computer. A module of its own, so that the answer needs no slow import."""

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
from p2wss.storage.messages import log

# most processes that compile at once; each takes 0.6 GB
_MAX_PROCESSES = 4


def num_processes() -> int:
    """How many processes compile at once."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _MAX_PROCESSES)


def compile_once() -> None:
    """Compile the code of the product in several processes, before a first run compiles it function by function.

    This is done only if there are several cores, and if no other process is doing it: of many runs that begin at once,
    as in a workflow, only one starts further processes. Whatever happens here, the run itself compiles what is missing.
    A process with threads is not forked, because the fork would lack the threads, but keep their locks.
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
    """The path of a file beside the cached code that exists once these sources are compiled completely; None without a
    cache. with_scans: whether the code of simulated scans is compiled, too."""
    folder = cache_folder()
    if folder is None:
        return None
    digest = hashlib.blake2b(digest_size=6)
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    computer = platform.python_version(), numba.__version__, get_host_cpu_name()
    digest.update(repr((computer, with_scans)).encode())
    return folder / f"warm-up.{digest.hexdigest()}"
