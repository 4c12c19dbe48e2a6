"""The reduced miniature on a real Slurm of one node (``make test-slurm``): minutes, as root, with Debian's packages."""

import csv
import importlib.util
import os
import re
import subprocess
import time
from collections import defaultdict

import pytest
from checkout import Project
from one_node_slurm import one_node_slurm, reason_to_skip

pytestmark = pytest.mark.slow
# this cluster has no accounts and no database of finished jobs
SITE = [
    *("--slurm-no-account", "--slurm-status-command", "squeue"),
    *("--slurm-init-seconds-before-status-checks", "3", "--latency-wait", "5"),
]
TILE = "0653_6862"


@pytest.fixture
def slurm(tmp_path):
    has_plugin = importlib.util.find_spec("snakemake_executor_plugin_slurm") is not None
    if reason := reason_to_skip() if has_plugin else "no snakemake-executor-plugin-slurm: make engines":
        # hosted CI has installed all of it
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    with one_node_slurm(tmp_path / "slurm"):
        yield


def test_the_reduced_miniature_to_its_report(slurm, tmp_path):
    """The stages of a tile are one job, and a job that Slurm kills for its memory is sent again with more."""
    project = Project(tmp_path / "project")
    start = time.monotonic()
    run = project.snakemake(
        *("eval_report", "--profile", "profiles/slurm", "--configfile", "tests/mini/reduced.yaml", *SITE),
        # instead of those of the profile, which ask for GPUs
        *("--set-resources", "crop_real:mem_mb=250 * 8 ** (attempt - 1)"),
        forks=False,  # the jobs are on nodes, where their memory is limited
    )
    seconds = time.monotonic() - start
    log = run.stdout + run.stderr
    jobs = jobs_of_slurm()
    print(f"\n{summary(project, jobs)}\nreport after {seconds:.0f} s\n{key_lines(log)}")
    assert (project.folder / "results/mini/eval/report.html").stat().st_size > 100_000

    first, second = jobs.pop("crop_real")
    assert (first["memory"], second["memory"]) == ("250M", "2000M")
    assert first["state"] != "COMPLETED" and second["state"] == "COMPLETED"
    killed = [
        path.read_text() for path in project.folder.glob(".snakemake/slurm_logs/rule_crop_real/**/*.log")
    ]
    assert any("exceeded memory limit" in text for text in killed)
    assert log.count("Trying to restart job") == 1, "no other job fails"
    assert {job["state"] for rows in jobs.values() for job in rows} == {"COMPLETED"}

    (tile,) = next(rows for name, rows in jobs.items() if name.startswith("tile_"))
    stages = ["scenes", "buildings", "scans", "crops/simulated"]
    work_s = sum(float(benchmark(project, f"{stage}/{TILE}")["s"]) for stage in stages)
    assert tile["seconds"] < 2 * work_s, f"{tile['seconds']} s for {work_s:.0f} s of work"


def jobs_of_slurm() -> dict[str, list[dict]]:
    """State, memory and seconds of each job of Slurm in the order of submission, by name of the rule or the group."""
    form = "--format=%k|%T|%m|%M"
    lines = subprocess.run(
        ["squeue", "--states=all", "--noheader", "--sort=i", form], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    jobs = defaultdict(list)
    for line in lines:
        comment, state, memory, elapsed = line.split("|")
        seconds = 0
        for part in elapsed.split(":"):
            seconds = 60 * seconds + int(part)
        name = comment.removeprefix("rule_").partition("_wildcards_")[0]
        jobs[name].append({"state": state, "memory": memory, "seconds": seconds})
    return jobs


def benchmark(project: Project, name: str) -> dict[str, str]:
    with (project.folder / f"logs/mini/benchmarks/{name}.tsv").open() as stream:
        return next(csv.DictReader(stream, delimiter="\t"))


def summary(project: Project, jobs: dict[str, list[dict]]) -> str:
    folder = project.folder / "logs/mini/benchmarks"
    names = [str(path.relative_to(folder).with_suffix("")) for path in sorted(folder.rglob("*.tsv"))]
    rows = {name: benchmark(project, name) for name in names}
    return "\n".join(
        [
            f"{len(names)} jobs of Snakemake, {sum(map(len, jobs.values()))} of Slurm",
            *(f"  {name}: {row['s']} s, {row['max_rss']} MB" for name, row in rows.items()),
            *(
                f"  Slurm: {name}: {job['state']}, {job['memory']}, {job['seconds']} s"
                for name, of_name in jobs.items()
                for job in of_name
            ),
        ]
    )


def key_lines(log: str) -> str:
    wanted = r"submitted with SLURM|exceeded memory|Trying to restart|steps \(\d+%\) done|Error in|error: "
    return "\n".join(line for line in log.splitlines() if re.search(wanted, line))
