"""Kills of the workflow at moments of every stage of a small miniature: what a rerun makes good, and what is lost.

    python tests/faults/kills.py --moments 20 --work results/kills

A trial starts ``snakemake`` in a copy of the project as it stood before a stage, sends a signal at a moment of that
stage, and runs the same command again, after ``snakemake --unlock`` where Snakemake has left its folder locked. Its
target is the stage; the first trial goes on to the end of the pipeline:

* ``KILL group``: SIGKILL to Snakemake and all that it started, as when a machine fails;
* ``KILL snakemake``: SIGKILL to Snakemake alone; its jobs go on while the rerun starts at once;
* ``TERM snakemake``: SIGTERM to Snakemake alone;
* ``TERM group``: SIGTERM to all of them.

A trial survives if the rerun succeeds, all results have the bytes of an undisturbed run, no job that had ended runs
again, no temporary file, lock or checkpoint is left, no two trainings were in one folder at once, and, where jobs went
on, a third run has nothing to do. ``none`` are trials without a signal. Work lost is, of each job that ran at the
signal and runs again, the time since it started, or since the checkpoint with which a training goes on.

Trials that have been made are read from ``--work`` (remove it to make them again). The last line is JSON.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests/workflow"), str(ROOT / "benchmarks")]
from checkout import Project  # noqa: E402
from figures import Figures  # noqa: E402

# the reduced miniature, smaller still: a stage takes a few CPU seconds, most of them for imports
SETTINGS = """\
scans:
  density_per_m2: 1.5
  density_bounds_per_m2: [1.0, 30.0]
dvae:
  num_points: 256
  num_validation: 16
  optimiser: {num_steps: 40, batch_size: 32}
  checkpoint_every_steps: 10
model:
  num_validation: 16
  optimiser: {num_steps: 40, batch_size: 16}
  checkpoint_every_steps: 10
eval:
  baselines: [lod1]
  num_samples: 256
  max_num_points: 256
  num_resamples: 20
reconstruct:
  registration: never
  roofs: parametric
"""
COMMAND = ["snakemake", "-c2", "--configfile", "tests/mini/reduced.yaml", "kills.yaml"]
EVERYTHING = "all"
# targets, in the order in which the stages follow from one another
STAGES = {
    "fetch": "fetch",
    "scenes": "scenes",
    "buildings": "buildings",
    "scans": "scans",
    "crops": "results/mini/crops/manifest.json",
    "dvae": "results/mini/dvae/model.safetensors",
    "model": "results/mini/model/model.safetensors",
    "eval": "eval_report",
    "reconstruct": "reconstruct",
}
SIGNALS = {
    "KILL group": (signal.SIGKILL, True),
    "KILL snakemake": (signal.SIGKILL, False),
    "TERM snakemake": (signal.SIGTERM, False),
    "TERM group": (signal.SIGTERM, True),
}
# jobs that go on may write after those that follow: a third run would then not be content
CHECKED_BY_A_THIRD_RUN = ("KILL snakemake", "none")
LONGEST_S = 600.0
STARTED = re.compile(r"^(?:local)?(?:rule|checkpoint) (\w+):$")
TRAININGS = ("dvae", "model")


@dataclass
class Job:
    """A job in the log of Snakemake; times in seconds since the epoch, 0 for one that did not end."""

    rule: str
    output: str = ""
    number: str = ""
    start: float = 0.0
    end: float = 0.0


@dataclass
class Trial:
    """One row of the table."""

    moment: float
    stage: str
    signal: str
    target: str
    rules: str = ""
    survived: bool = False
    jobs_running: int = 0
    jobs_repeated: int = 0
    work_lost_s: float = 0.0
    unlocked: bool = False
    num_runs: int = 0
    trainings_at_once: int = 0
    faults: list[str] = field(default_factory=list)


class Run:
    """A run of Snakemake whose log is followed."""

    def __init__(self, folder: Path, number: int, target: str = EVERYTHING) -> None:
        self.folder = folder
        self.log = folder / f"run-{number}.log"
        self.jobs: list[Job] = []
        self._place = 0
        environment = os.environ | {
            "PYTHONPATH": str(folder / "src"),
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "TMPDIR": str(folder / "tmp"),
            "OMP_WAIT_POLICY": "PASSIVE",
        }
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [*COMMAND, "--", target], cwd=folder, env=environment, stdout=log, stderr=log,
                stdin=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip

    def follow(self) -> None:
        """Read what was added to the log."""
        with self.log.open("rb") as log:
            log.seek(self._place)
            added = log.read()
        end = added.rfind(b"\n") + 1
        self._place += end
        for line in added[:end].decode(errors="replace").splitlines():
            if match := STARTED.match(line):
                self.jobs.append(Job(match[1], start=time.time()))
            elif self.jobs and line.startswith("    output: "):
                self.jobs[-1].output = line.removeprefix("    output: ")
            elif self.jobs and line.startswith("    jobid: "):
                self.jobs[-1].number = line.removeprefix("    jobid: ")
            elif match := re.match(r"Finished jobid: (\d+)", line):
                for job in self.jobs:
                    if job.number == match[1]:
                        job.end = time.time()

    def wait(self, until: float = float("inf"), num_jobs: int = 10**9) -> bool:
        """Follow the log until a time, the end (true) or so many jobs; a run that lasts too long is ended."""
        deadline = time.time() + LONGEST_S
        while time.time() < until:
            ended = self.process.poll() is not None
            self.follow()
            if ended or sum(bool(job.output) for job in self.jobs) >= num_jobs:
                return ended
            if time.time() > deadline:
                os.killpg(self.process.pid, signal.SIGKILL)
            time.sleep(0.03)
        return self.process.poll() is not None

    @property
    def text(self) -> str:
        return self.log.read_text(errors="replace")


@contextmanager
def watched(folder: Path) -> Iterator[list[int]]:
    """Counts, while the block runs, the processes that train in one folder: those that have its points mapped."""
    most, stop = [0], threading.Event()

    def watch() -> None:
        while not stop.wait(0.2):
            counts: dict[str, int] = {}
            for process in processes(folder):
                try:
                    maps = Path(f"/proc/{process}/maps").read_text(encoding="utf-8")
                except OSError:
                    continue
                for place in set(re.findall(r"results/mini/(\w+)/checkpoints/#", maps)):
                    counts[place] = counts.get(place, 0) + 1
            most[0] = max([most[0], *counts.values()])

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield most
    finally:
        stop.set()
        thread.join()


def processes(folder: Path) -> list[int]:
    """Processes that work in a folder."""
    numbers = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if Path(os.readlink(entry / "cwd")) == folder and (entry / "cmdline").read_bytes():
                    numbers.append(int(entry.name))
            except OSError:
                continue
    return numbers


def wait_for_orphans(folder: Path) -> None:
    deadline = time.time() + LONGEST_S
    while processes(folder) and time.time() < deadline:
        time.sleep(0.1)
    if left := processes(folder):
        raise TimeoutError(f"{folder}: processes {left} do not end")


def contents(folder: Path) -> dict[str, str]:
    """A hash of every file of the results and of what was fetched, by its path."""
    hashes = {}
    for part in ("results", "resources"):
        for path in sorted((folder / part).rglob("*")):
            name = path.relative_to(folder).as_posix()
            if path.is_file():
                hashes[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return hashes


def leftovers(folder: Path) -> list[str]:
    """Temporary files, locks and checkpoints."""
    found = []
    for part in ("results", "resources", "tmp", ".snakemake/locks", ".snakemake/incomplete"):
        for path in sorted((folder / part).rglob("*")):
            name = path.relative_to(folder).as_posix()
            hidden = path.name.startswith(".") and path.name != ".snakemake_timestamp"
            partial = path.name in ("checkpoints.lock", "checkpoints") or path.suffix == ".part"
            if hidden or partial or (part not in ("results", "resources") and path.is_file()):
                found.append(name)
    return found


def unlock(folder: Path) -> None:
    """Remove the lock that a killed Snakemake has left."""
    environment = os.environ | {"PYTHONPATH": str(folder / "src")}
    subprocess.run(["snakemake", "--unlock"], cwd=folder, env=environment, capture_output=True, check=True)


def copy_of(source: Path, target: Path) -> None:
    shutil.rmtree(target, ignore_errors=True)
    subprocess.run(["cp", "-a", str(source), str(target)], check=True)


def reference(work: Path) -> dict[str, Any]:
    """An undisturbed run, with a copy of the project before each stage: seconds, jobs and hashes of results."""
    summary = work / "reference.json"
    if summary.is_file():
        return json.loads(summary.read_text())
    folder = work / "reference"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    Project(folder)
    (folder / "kills.yaml").write_text(SETTINGS)
    (folder / "tmp").mkdir()
    seconds: dict[str, float] = {}
    jobs: dict[str, int] = {}
    truth = {}
    for stage, target in STAGES.items():
        copy_of(folder, work / f"before-{stage}")
        run = Run(folder, 0, target)
        run.wait()
        if run.process.returncode:
            raise RuntimeError(run.text[-5000:])
        seconds[stage] = max(job.end for job in run.jobs) - min(job.start for job in run.jobs)
        jobs[stage] = sum(bool(job.output) for job in run.jobs)
        print(f"{stage}: {seconds[stage]:.1f} s, {jobs[stage]} jobs", file=sys.stderr)
        truth[target] = contents(folder)
    run = Run(folder, 0)
    run.wait()
    truth[EVERYTHING] = contents(folder)
    if left := leftovers(folder):
        raise RuntimeError(f"an undisturbed run leaves {left}")
    result = {"seconds": seconds, "jobs": jobs, "contents": truth}
    summary.write_text(json.dumps(result, indent=1))
    return result


def attempt(trial: Trial, work: Path, truth: dict[str, Any]) -> None:
    """Make a trial: fills in its row."""
    folder = (work / "trial").resolve()
    with watched(folder) as most:
        # the moment is a share of the jobs of the stage, and of the time that one of them takes
        jobs_before, share = divmod(trial.moment * truth["jobs"][trial.stage], 1)
        after_s = share * truth["seconds"][trial.stage] / truth["jobs"][trial.stage]
        # again while the stage ends before the signal: the machine may be less busy than it was
        while True:
            copy_of(work / f"before-{trial.stage}", folder)
            first = Run(folder, 1, trial.target)
            if trial.signal == "none":
                break
            if not first.wait(num_jobs=int(jobs_before) + 1) and not first.wait(time.time() + after_s):
                break
            after_s *= 0.6
        if trial.signal != "none":
            number, group = SIGNALS[trial.signal]
            (os.killpg if group else os.kill)(first.process.pid, number)
        struck = time.time()
        first.wait()
        first.follow()
        if trial.signal.endswith("group"):
            wait_for_orphans(folder)
        running = [job for job in first.jobs if job.output and not 0 < job.end <= struck]
        started = {job.output: job for job in first.jobs if job.output and job.start < struck}
        ended_before = {job.output for job in first.jobs if job.end and job.output}
        saved = {
            path.parts[-3]: max(saved.stat().st_mtime for saved in path.parent.glob("step-*.pt"))
            for path in (folder / "results/mini").glob("*/checkpoints/step-*.pt")
        }
        jobs: list[Job] = []
        while trial.num_runs < 5:
            trial.num_runs += 1
            if list((folder / ".snakemake/locks").glob("*")):
                unlock(folder)
                trial.unlocked = True
            again = Run(folder, 1 + trial.num_runs, trial.target)
            again.wait()
            jobs += again.jobs
            if again.process.returncode == 0:
                break
            shutil.copy(again.log, work / f"failed-{trial.stage}-{trial.signal.replace(' ', '-')}.log")
            trial.faults.append(f"run {trial.num_runs} failed")
            wait_for_orphans(folder)
        wait_for_orphans(folder)
    trial.rules = " ".join(sorted({job.rule for job in running}))
    trial.jobs_running = len(running)
    repeated = [job for job in jobs if job.output in started]
    trial.jobs_repeated = len(repeated)
    if twice := {job.output for job in repeated if job.output in ended_before}:
        trial.faults.append(f"had ended and ran again: {', '.join(sorted(twice))}")
    if trial.jobs_repeated > trial.jobs_running:
        trial.faults.append("more jobs ran again than ran at the signal")
    for job in repeated:
        stage = job.rule if job.rule in TRAININGS else ""
        since = max(started[job.output].start, saved.get(stage, 0.0))
        trial.work_lost_s = round(trial.work_lost_s + max(struck - since, 0.0), 1)
    trial.trainings_at_once = most[0]
    if most[0] > 1:
        trial.faults.append(f"{most[0]} trainings at once in one folder")
    results = contents(folder)
    expected = truth["contents"][trial.target]
    differing = {name for name in {*results, *expected} if results.get(name) != expected.get(name)}
    if differing:
        trial.faults.append(f"differ: {', '.join(sorted(differing))}")
    if left := leftovers(folder):
        trial.faults.append(f"left: {', '.join(left)}")
    if not trial.faults and trial.signal in CHECKED_BY_A_THIRD_RUN:
        last = Run(folder, 99, trial.target)
        last.wait()
        if last.process.returncode or [job for job in last.jobs if job.output]:
            trial.faults.append(f"not done: {', '.join(job.rule for job in last.jobs)}")
    trial.survived = not trial.faults


def plan(arguments: argparse.Namespace) -> list[Trial]:
    """The trials: each signal at the same moments, which are spread over the stages."""
    moments, signals, stages = arguments.moments, arguments.signals, arguments.stages
    draw = random.Random(arguments.seed)
    drawn = [(i, stages[i % len(stages)], round(draw.uniform(0.02, 0.98), 3)) for i in range(moments)]
    return [
        Trial(moment, stage, name, EVERYTHING if i == 0 and name == signals[0] else STAGES[stage])
        for i, stage, moment in drawn
        for name in ([signals[i % len(signals)]] if arguments.one_signal_each else signals)
    ]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--moments", type=int, default=20, help="moments at which each signal is sent")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one-signal-each", action="store_true", help="at each moment only one, in turn")
    parser.add_argument("--signals", nargs="+", default=[*SIGNALS], choices=[*SIGNALS, "none"])
    parser.add_argument("--stages", nargs="+", default=[*STAGES], choices=[*STAGES])
    parser.add_argument("--work", type=Path, default=ROOT / "results/kills", help="folder of the trials")
    arguments = parser.parse_args()
    work = arguments.work.resolve()
    truth = reference(work)
    stored = work / "trials.jsonl"
    known = {}
    if stored.is_file():
        rows = [json.loads(line) for line in stored.read_text().splitlines()]
        known = {(row["moment"], row["stage"], row["signal"]): Trial(**row) for row in rows}
    trials = []
    for planned in plan(arguments):
        trial = known.get((planned.moment, planned.stage, planned.signal))
        if trial is None:
            trial = planned
            attempt(trial, work, truth)
            with stored.open("a") as file:
                file.write(json.dumps(asdict(trial)) + "\n")
            print(f"{len(trials) + 1}: {trial}", file=sys.stderr, flush=True)
        trials.append(trial)
    return table(trials)


def table(trials: list[Trial]) -> int:
    print(
        f"{'moment':>6} {'stage':<12}{'signal':<16}{'survived':<9}{'running':>8}{'repeated':>9}{'lost (s)':>9}  jobs"
    )
    for trial in trials:
        print(
            f"{trial.moment:6.3f} {trial.stage:<12}{trial.signal:<16}{'yes' if trial.survived else 'NO':<9}"
            f"{trial.jobs_running:>8}{trial.jobs_repeated:>9}{trial.work_lost_s:>9.1f}  {trial.rules}"
        )
        for fault in trial.faults:
            print(f"       {fault}")
    figures = Figures()
    figures.row("trials", {str(i): asdict(trial) for i, trial in enumerate(trials)})
    for name in dict.fromkeys(trial.signal for trial in trials):
        rows = [trial for trial in trials if trial.signal == name]
        figures.row(
            name,
            {
                "trials": len(rows),
                "survived": sum(trial.survived for trial in rows),
                "jobs running": sum(trial.jobs_running for trial in rows),
                "jobs repeated": sum(trial.jobs_repeated for trial in rows),
                "work lost, s": round(sum(trial.work_lost_s for trial in rows), 1),
                "most work lost, s": max(trial.work_lost_s for trial in rows),
                "unlocked": sum(trial.unlocked for trial in rows),
            },
        )
        figures.at_least(f"moments of {name}", len({(each.stage, each.moment) for each in rows}), 20)
    figures.at_least("survived, share", sum(trial.survived for trial in trials) / len(trials), 1)
    figures.at_most(
        "jobs repeated per running job",
        max((trial.jobs_repeated / max(trial.jobs_running, 1) for trial in trials), default=0),
        1,
    )
    figures.at_most("trainings in one folder at once", max(trial.trainings_at_once for trial in trials), 1)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
