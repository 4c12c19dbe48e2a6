"""Whether Roofer can be run here, which version, and which recorded outputs stand in where it cannot.

Imports nothing heavy: the Snakefile asks at each start, for a Roofer that appears, or another version of it,
is a reason to run the baseline again.
"""

from __future__ import annotations

import shlex
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from p2wss.config import Eval
from p2wss.errors import InputError

_RECORDED_SUFFIXES = (".city.jsonl", ".jsonl", ".city.json", ".json")


@dataclass(frozen=True)
class Roofer:
    """A command that can be run, and what it says of its version."""

    command: Sequence[str]
    version: str


def find(command: str) -> Roofer | str:
    """The configured command if it can be run, else why not: ``"not run: .."``."""
    words = shlex.split(command)
    if not words:
        return "not run: eval.roofer_command is empty"
    if shutil.which(words[0]) is None:
        return f"not run: no program {words[0]} was found"
    try:
        answer = subprocess.run(
            [words[0], "--version"], capture_output=True, text=True, timeout=60, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"not run: {words[0]} --version: {error}"
    text = (answer.stdout or answer.stderr).strip().splitlines()
    return Roofer(words, text[0] if text else "unknown version")


def recorded_files(config: Eval) -> list[Path]:
    """The files of ``eval.roofer_recorded``, none where it is empty or where Roofer itself can be run.

    Raises :class:`InputError` if it is set but nothing is there.
    """
    if not config.roofer_recorded or isinstance(find(config.roofer_command), Roofer):
        return []
    path = Path(config.roofer_recorded)
    if path.is_file():
        return [path]
    found = sorted(file for file in path.glob("*") if file.name.endswith(_RECORDED_SUFFIXES))
    if not found:
        raise InputError(f"eval.roofer_recorded: {path}: no such file, and no folder with CityJSON in it")
    return found


def state(config: Eval) -> str:
    """What the baseline will be made with: the version, the names of recorded files, or why it is not run."""
    found = find(config.roofer_command)
    if isinstance(found, Roofer):
        return found.version
    recorded = recorded_files(config)
    return "recorded: " + ", ".join(file.name for file in recorded) if recorded else found
