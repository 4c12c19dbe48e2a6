"""``p2wss warm-up``: compile ahead of the first use."""

from __future__ import annotations

import os
import time

import click

from p2wss.cli.common import log
from p2wss.cli.parser import Command, option
from p2wss.storage.provenance import fingerprint


@click.command(cls=Command)
@option("--all", "with_scans", is_flag=True, help="also compile the code that p2wss scans needs")
@option("--jobs", type=click.IntRange(min=1), metavar="N", help="number of processes (default: one per core)")
def warm_up(with_scans: bool, jobs: int | None) -> None:
    """Compile the code that p2wss reconstruct needs, once for this computer."""
    jobs = jobs or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    from p2wss.reconstruct import warm_up as of_reconstruct

    marker = of_reconstruct.marker(with_scans)
    if marker is not None and marker.exists():
        log.info("all code is already compiled")
        return
    from p2wss.storage.progress import Progress

    tasks = list(of_reconstruct.TASKS)
    if with_scans:
        from p2wss.scans.warm_up import warm_survey

        tasks.append(warm_survey)
    log.info("compiling for this computer, with %d processes: up to a minute", jobs)
    start = time.monotonic()
    with Progress("compiling", len(tasks) + 1, "parts") as progress:
        of_reconstruct.run_tasks(tasks, of_reconstruct.warm_product, jobs, progress.update)
    fingerprint("reconstruct")  # kept beside the compiled code, too
    log.info("compiled in %.0f s", time.monotonic() - start)
    if marker is not None:
        marker.touch()
