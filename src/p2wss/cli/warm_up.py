"""``p2wss warm-up``: compile ahead of the first use."""

from __future__ import annotations

import hashlib
import os
import platform
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import click

import p2wss
from p2wss.cli.common import log
from p2wss.cli.parser import Command, option
from p2wss.storage.provenance import fingerprint

Task = Callable[[], None]


@click.command(cls=Command)
@option("--all", "with_scans", is_flag=True, help="also compile the code that p2wss scans needs")
@option("--jobs", type=click.IntRange(min=1), metavar="N", help="number of processes (default: one per core)")
def warm_up(with_scans: bool, jobs: int | None) -> None:
    """Compile the code that p2wss reconstruct needs, once for this computer."""
    jobs = jobs or _num_cores()
    marker = _marker(with_scans)
    if marker is not None and marker.exists():
        log.info("all code is already compiled")
        return
    from p2wss.reconstruct import warm_up as of_reconstruct
    from p2wss.scans.warm_up import warm_survey
    from p2wss.storage.progress import Progress

    tasks = (*of_reconstruct.TASKS, warm_survey) if with_scans else of_reconstruct.TASKS
    log.info("compiling for this computer, with %d processes: up to a minute", jobs)
    start = time.monotonic()
    with Progress("compiling", len(tasks) + 1, "parts") as progress:
        run_tasks(tasks, of_reconstruct.warm_product, jobs, progress.update)
    fingerprint("reconstruct")  # kept beside the compiled code, too
    log.info("compiled in %.0f s", time.monotonic() - start)
    if marker is not None:
        marker.touch()


def run_tasks(first: Sequence[Task], last: Task, jobs: int, progress: Callable[[int], object]) -> None:
    """Run tasks in processes, ``last`` once all of ``first`` are done. progress: called with how many are."""
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_begin) as pool:
        for num_done, future in enumerate(as_completed([pool.submit(task) for task in first]), 1):
            future.result()
            progress(num_done)
        pool.submit(last).result()
        progress(len(first) + 1)


def _begin() -> None:
    from p2wss.skeleton.compiled import expect_compilation

    expect_compilation()


def _marker(with_scans: bool) -> Path | None:
    """The file beside the cached code that exists once all of these sources are compiled; None without a cache."""
    import numba
    from llvmlite.binding import get_host_cpu_name

    from p2wss.skeleton.compiled import cache_folder

    folder = cache_folder()
    if folder is None:
        return None
    sources = Path(p2wss.__file__).parent
    digest = hashlib.blake2b(digest_size=6)
    for path in sorted(sources.rglob("*.py")):
        digest.update(path.read_bytes())
    computer = platform.python_version(), numba.__version__, get_host_cpu_name()
    digest.update(repr((computer, with_scans)).encode())
    return folder / f"warm-up.{digest.hexdigest()}"


def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
