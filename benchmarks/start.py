"""What a user waits for before anything happens: the start of every command; the last line is JSON.

    python benchmarks/start.py

Needs no data.

CPU seconds of ``p2wss COMMAND --help``, and of ``p2wss reconstruct`` until it has read its input and has the first
building at hand, without and with the network, with the peak memory until then. In each case the least of a few runs,
after one that is not measured, and divided by how much slower than usual the machine is (``figures.slowness``).
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from figures import Figures, Run, run, slowness
from first_use import write_sample

from p2wss.cli import COMMANDS

REPEATS = 3
# stops where buildings begin
TO_FIRST_BUILDING = """
import json, os, sys, time
from p2wss.cli import importing, main
from p2wss.cli.reconstruct import WITHOUT
with importing(*WITHOUT):  # as the command does
    from p2wss.reconstruction import pipeline
def stop(*arguments):
    status = open("/proc/self/status").read().splitlines()
    peak_mib = next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmHWM"))
    modules = [name for name in ("torch", "torch._dynamo") if name in sys.modules]
    print(json.dumps({"cpu_s": time.process_time(), "peak_mib": peak_mib, "modules": modules}), flush=True)
    os._exit(0)
pipeline.Shared = stop
main(sys.argv[1:])
"""


def least(*command: object) -> Run:
    """The run with the least CPU time, of a few runs after one that is not measured."""
    return min([run(command) for _ in range(1 + REPEATS)][1:])


def main() -> int:
    figures = Figures()
    program = [sys.executable, "-m", "p2wss.cli"]
    factor = slowness()
    print(f"the machine is {factor:.2f} times as slow as usual")
    bare_s = least(*program, "--help").cpu_s / factor
    helps = {
        name: least(*program, name, "--help").cpu_s / factor for part in COMMANDS.values() for name in part
    }
    for name, cpu_s in helps.items():
        print(f"p2wss {name} --help".ljust(28), f"{cpu_s:.2f} CPU s")
    figures.row("help, CPU s", helps)
    with tempfile.TemporaryDirectory() as folder:
        files = write_sample(Path(folder))
        reconstruct = ("reconstruct", *files, Path(folder, "out"), "--crs", "EPSG:2154")
        child = (sys.executable, "-c", TO_FIRST_BUILDING, *reconstruct)
        alone, network = (
            json.loads(least(*child, *options).output.splitlines()[-1])
            for options in (["--model", "none"], [])
        )
    factor = min(factor, slowness())
    print(f"modules: {alone['modules'] or 'no torch'}; with the network {network['modules']}")
    figures.at_most("p2wss --help, CPU s", bare_s, 0.15)
    figures.at_most("first building, fit alone, CPU s", alone["cpu_s"] / factor, 1.2)
    figures.at_most("first building, fit alone, MiB", alone["peak_mib"], 250)
    figures.at_most("first building, network, CPU s", network["cpu_s"] / factor, 2.5)
    figures.at_most("torch without a network", len(alone["modules"]), 0)
    figures.at_most("torch._dynamo with a network", "torch._dynamo" in network["modules"], 0)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
