"""Whether Roofer can be run here, its version, and the recorded outputs that replace it if it cannot be run.

Imports no slow modules, because the Snakefile uses it at every start: a new installation or another version of Roofer
reruns the baseline.
"""

import shlex
import shutil
import subprocess
from functools import cache
from pathlib import Path

from p2wss.config.eval import Eval
from p2wss.storage.messages import InputError

# file beside recorded outputs with hashes of the points that they were made from (p2wss.eval.roofer.cloud_sketch)
CLOUDS = "clouds.json"
_RECORDED_SUFFIXES = (".city.jsonl", ".jsonl", ".city.json", ".json")


def version(config: Eval) -> str | None:
    """The version that the configured command reports; None if it cannot be run."""
    words = shlex.split(config.roofer_command)
    path = shutil.which(words[0]) if words else None
    return None if path is None else _version(path, Path(path).stat().st_mtime_ns)


@cache
def _version(program: str, modified_ns: int) -> str | None:
    """The version that a program reports. It is run once per process, unless the file at ``program`` changes."""
    try:
        completed = subprocess.run(
            [program, "--version"], capture_output=True, text=True, timeout=60, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return (completed.stdout or completed.stderr or "unknown version").strip().splitlines()[0]


def recorded_files(config: Eval) -> list[Path]:
    """The files of ``eval.roofer_recorded``; none if it is empty or if Roofer can be run.

    Raises :class:`InputError` if there is no such file or folder, unless the setting has its default.
    """
    if not config.roofer_recorded or version(config) is not None:
        return []
    path = Path(config.roofer_recorded)
    if path.is_file():
        return [path]
    found = [*path.glob("*"), *path.glob("simulated/*")]
    paths = sorted(file for file in found if file.name.endswith(_RECORDED_SUFFIXES))
    if not paths and config.roofer_recorded != Eval().roofer_recorded:
        raise InputError(f"eval.roofer_recorded: {path}: no such file, and no folder with CityJSON files")
    return paths


def state(config: Eval) -> str:
    """What the baseline depends on: the version, the names of recorded files, or that it is not run."""
    recorded = ", ".join(file.name for file in recorded_files(config))
    return version(config) or (
        f"recorded: {recorded}" if recorded else f"not run: cannot start {config.roofer_command!r}"
    )


def facts(config: Eval, has_rows: bool = True) -> dict[str, str]:
    """``status`` (``ok``, ``recorded``, ``not run: <reason>``) and ``note``, for the report. has_rows: whether there
    are outputs, also recorded ones, for any of the tiles."""
    if not has_rows:
        config = config.model_copy(update={"roofer_recorded": ""})
    status = "ok" if version(config) is not None else state(config)
    return {"status": "recorded" if status.startswith("recorded") else status, "note": state(config)}
