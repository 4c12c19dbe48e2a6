"""``p2wss warm-up``: compile ahead of the first use."""

import time

import click

from p2wss.cli.common import log
from p2wss.cli.parser import Command, option
from p2wss.storage.provenance import fingerprint


@click.command(cls=Command)
@option("--all", "with_scans", is_flag=True, help="also compile the code that p2wss scans needs")
def warm_up(with_scans: bool) -> None:
    """Compile the code that p2wss reconstruct needs, once for this computer."""
    from p2wss.reconstruction.compiled import marker, num_processes

    done = marker(with_scans)
    if done is not None and done.exists():
        log.info("all code is already compiled")
        return
    from p2wss.reconstruction import warm_up as of_reconstruct

    more = []
    if with_scans:
        from p2wss.scans.warm_up import warm_survey

        more.append(warm_survey)
    start = time.monotonic()
    of_reconstruct.warm_product(num_processes(), more)
    fingerprint("reconstruction")  # kept beside the compiled code, too
    log.info("compiled in %.0f s", time.monotonic() - start)
    if done is not None:
        done.touch()
