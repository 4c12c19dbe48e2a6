"""Whether Roofer can be run here, in which version, and which recorded outputs replace it if it cannot.

Imports no slow modules, because the Snakefile uses it at every start: a new installation or another version of Roofer
reruns the baseline.
"""

from __future__ import annotations

import shlex
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from p2wss.config import Eval
from p2wss.errors import InputError

_RECORDED_SUFFIXES = (".city.jsonl", ".jsonl", ".city.json", ".json")


@dataclass(frozen=True)
class Roofer:
    """A command that can be run, and the version that it reports."""

    command: Sequence[str]
    version: str


def find(command: str) -> Roofer | str:
    """The configured command if it can be run, or else the reason: ``"not run: <reason>"``."""
    words = shlex.split(command)
    if not words:
        return "not run: eval.roofer_command is empty"
    path = shutil.which(words[0])
    if path is None:
        return f"not run: program {words[0]} not found"
    try:
        return Roofer(words, _version(path, Path(path).stat().st_mtime_ns))
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"not run: {words[0]} --version: {error}"


@cache
def _version(program: str, modified_ns: int) -> str:
    """The version that the program reports; asked once per process, unless the file at ``program`` changes."""
    completed = subprocess.run(
        [program, "--version"], capture_output=True, text=True, timeout=60, check=False
    )
    text = (completed.stdout or completed.stderr).strip().splitlines()
    return text[0] if text else "unknown version"


def recorded_files(config: Eval) -> list[Path]:
    """The files of ``eval.roofer_recorded``; none if it is empty or if Roofer can be run.

    Raises :class:`InputError` if it is set but there is no such file or folder.
    """
    if not config.roofer_recorded or isinstance(find(config.roofer_command), Roofer):
        return []
    path = Path(config.roofer_recorded)
    if path.is_file():
        return [path]
    paths = sorted(file for file in path.glob("*") if file.name.endswith(_RECORDED_SUFFIXES))
    if not paths:
        raise InputError(f"eval.roofer_recorded: {path}: no such file, and no folder with CityJSON files")
    return paths


def state(config: Eval) -> str:
    """What the baseline depends on: the version, the names of recorded files, or the reason why it is not run."""
    command = find(config.roofer_command)
    if isinstance(command, Roofer):
        return command.version
    recorded = recorded_files(config)
    return "recorded: " + ", ".join(file.name for file in recorded) if recorded else command
