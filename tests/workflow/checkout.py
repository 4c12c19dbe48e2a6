"""A copy of the project in a temporary folder, in which Snakemake runs and whose code can be edited."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PARTS = ["Snakefile", "workflow", "profiles", "config", "envs", "models", "src", "tests/mini"]


class Project:
    """A checkout of one's own; ``snakemake(...)`` runs in it with its own code."""

    def __init__(self, folder: Path):
        self.folder = folder
        for part in PARTS:
            source, target = ROOT / part, folder / part
            target.parent.mkdir(parents=True, exist_ok=True)
            if source.is_dir():
                shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
            else:
                shutil.copy(source, target)

    def snakemake(self, *arguments: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        return self._run("snakemake", *arguments, check=check)

    def p2wss(self, *arguments: object, check: bool = True) -> subprocess.CompletedProcess[str]:
        return self._run("p2wss", *map(str, arguments), check=check)

    def edit(self, path: str, old: str, new: str) -> None:
        file = self.folder / path
        text = file.read_text()
        assert old in text, f"{path} does not contain {old!r}"
        file.write_text(text.replace(old, new, 1))

    def _run(self, program: str, *arguments: str, check: bool) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {
            "PYTHONPATH": str(self.folder / "src"),
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "OMP_WAIT_POLICY": "PASSIVE",
        }
        run = subprocess.run(
            [program, *arguments], cwd=self.folder, env=environment, capture_output=True, text=True
        )
        assert not check or run.returncode == 0, f"{program} {arguments}:\n{run.stdout}\n{run.stderr}"
        return run


REDUCED = ["-c2", "--configfile", "tests/mini/reduced.yaml"]


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
