"""A copy of the project in a temporary folder, in which Snakemake runs and whose code can be edited."""

import atexit
import functools
import importlib
import multiprocessing
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import forked

ROOT = Path(__file__).parents[2]
PARTS = ["Snakefile", "workflow", "profiles", "config", "envs", "models", "src", "tests/mini"]

# a folder that a shell would take apart, and whose command it would run
ODD_NAME = 'the town\'s "données" $(touch executed) `touch executed`; touch executed &'

# Processes that start with these libraries imported and without p2wss, which each takes from its own project. The
# libraries read the settings once, when they are loaded; p2wss makes the same
os.environ |= {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}
_PROCESSES = multiprocessing.get_context("forkserver")
_PROCESSES.set_forkserver_preload(
    [
        *("geopandas", "laspy", "matplotlib.pyplot", "numba", "pandas", "pyarrow.parquet", "rasterio"),
        *("scipy.optimize", "scipy.spatial", "scipy.stats", "snakemake.cli", "torch", "torch._dynamo"),
    ]
)


@functools.cache
def _forking_program() -> Path:
    """A folder with a program ``p2wss``, each run of which is a fork of one process with these libraries."""
    folder = Path(tempfile.mkdtemp())
    server = _PROCESSES.Process(target=forked.serve, args=(str(folder / "socket"),))
    server.start()

    def end() -> None:
        server.terminate()
        server.join()
        shutil.rmtree(folder)

    atexit.register(end)
    program = folder / "p2wss"
    command = [sys.executable, "-IS", forked.__file__, str(folder / "socket")]
    program.write_text(f'#!/bin/sh\nexec {shlex.join(command)} "$@"\n')
    program.chmod(0o755)
    while not (folder / "socket").exists():
        assert server.is_alive()
        time.sleep(0.01)
    return folder


class Project:
    """A checkout in ``folder``. Each command runs in a process that imports the code of this checkout."""

    def __init__(self, folder: Path):
        self.folder = folder
        for part in PARTS:
            source, target = ROOT / part, folder / part
            target.parent.mkdir(parents=True, exist_ok=True)
            if source.is_dir():
                ignored = shutil.ignore_patterns("*.egg-info")
                shutil.copytree(source, target, copy_function=_copy, ignore=ignored)
            else:
                shutil.copy(source, target)

    def snakemake(
        self, *arguments: str, check: bool = True, forks: bool = True
    ) -> subprocess.CompletedProcess[str]:
        """The command ``snakemake``, for runs that do something.

        With ``forks``, their jobs start without the seconds that the libraries of p2wss take to be imported.
        """
        command, environment = ["snakemake", *arguments], self._environment()
        if forks:
            environment["PATH"] = f"{_forking_program()}{os.pathsep}{environment['PATH']}"
        run = subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True)
        return _checked(run, check)

    def dry_run(self, *arguments: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        """``snakemake -n``, without the second that Snakemake takes to be imported."""
        return _checked(*self._main("snakemake", [["-n", *arguments]]), check)

    def dry_runs(self, commands: Sequence[Sequence[str]]) -> list[subprocess.CompletedProcess[str]]:
        """Several ``snakemake -n`` of the same code in one process, which reads that code once."""
        runs = self._main("snakemake", [["-n", *arguments] for arguments in commands])
        return [_checked(run, True) for run in runs]

    def p2wss(self, *arguments: object, check: bool = True) -> subprocess.CompletedProcess[str]:
        """The command ``p2wss``, without the seconds that its libraries take to be imported."""
        return _checked(*self._main("p2wss", [[str(each) for each in arguments]]), check)

    def edit(self, path: str, old: str, new: str) -> None:
        file = self.folder / path
        text = file.read_text()
        assert old in text, f"{path} does not contain {old!r}"
        file.write_text(text.replace(old, new, 1))

    def _environment(self) -> dict[str, str]:
        return os.environ | {
            "PYTHONPATH": str(self.folder / "src"),
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        }

    def _main(
        self, program: str, commands: Sequence[Sequence[str]]
    ) -> list[subprocess.CompletedProcess[str]]:
        with ProcessPoolExecutor(1, mp_context=_PROCESSES) as pool:
            return pool.submit(_main, program, commands, self.folder, self._environment()).result()


def _copy(source: str, target: str) -> None:
    """Machine code of the checkout is linked: whoever has newer code replaces such a file and never changes it."""
    if Path(source).parent.name == "__pycache__":
        try:
            os.link(source, target)
            return
        except OSError:
            pass  # another file system
    shutil.copy2(source, target)


def _main(
    program: str, commands: Sequence[Sequence[str]], folder: Path, environment: dict[str, str]
) -> list[subprocess.CompletedProcess[str]]:
    """The main function of a program for each list of arguments, in a process that does nothing else."""
    os.chdir(folder)
    os.environ.update(environment)
    sys.path.insert(0, str(folder / "src"))
    main = importlib.import_module(f"{program}.cli").main
    return [_captured(main, [program, *arguments]) for arguments in commands]


def _captured(main: Callable[[list[str]], int], command: list[str]) -> subprocess.CompletedProcess[str]:
    sys.argv = command
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8") as stdout,
        tempfile.TemporaryFile("w+", encoding="utf-8") as stderr,
    ):
        os.dup2(stdout.fileno(), sys.stdout.fileno())
        os.dup2(stderr.fileno(), sys.stderr.fileno())
        try:
            status = main(command[1:])
        except SystemExit as end:
            status = end.code
        sys.stdout.flush()
        sys.stderr.flush()
        texts = []
        for stream in (stdout, stderr):
            stream.seek(0)
            texts.append(stream.read())
    return subprocess.CompletedProcess(command, status, *texts)


def _checked(run: subprocess.CompletedProcess[str], check: bool) -> subprocess.CompletedProcess[str]:
    assert not check or run.returncode == 0, f"{run.args}:\n{run.stdout}\n{run.stderr}"
    return run


REDUCED = ["-c2", "--configfile", "tests/mini/reduced.yaml"]
# a tile of 140 buildings, and one of 52 with LiDAR; small tiles hold blocks of every split only if the blocks are small
TILE, LIDAR_TILE, TILE_SIZE_M = "0653000_6861250", "0653250_6861000", 250
SMALL_TILES = {
    "region": {"tile_size_m": TILE_SIZE_M, "tiles": [TILE], "lidar_tiles": [LIDAR_TILE]},
    "crops": {"block_size_m": 50, "guard_m": 2},
}


def rules_to_run(dry_run: subprocess.CompletedProcess[str]) -> dict[str, int]:
    """Number of jobs per rule in the output of ``snakemake -n``."""
    lines = (dry_run.stdout + dry_run.stderr).splitlines()
    starts = [i for i, line in enumerate(lines) if line.startswith("job ")]
    jobs: dict[str, int] = {}
    for line in lines[starts[-1] + 2 :] if starts else []:
        parts = line.split()
        if len(parts) != 2 or parts[0] == "total":
            break
        jobs[parts[0]] = int(parts[1])
    return jobs
