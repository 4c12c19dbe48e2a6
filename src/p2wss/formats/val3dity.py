"""The report of val3dity, a validator that a user may have installed (https://github.com/tudelft3d/val3dity)."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

from p2wss.storage.errors import InputError
from p2wss.storage.temporary import temporary_folder


def report(program: str, path: Path) -> dict[str, list[str]]:
    """The errors that ``program``, val3dity 2.2 or newer, reports of a CityJSON file, by city object: "code name" each.

    Raises :class:`InputError` if it cannot be run or gives no report.
    """
    with temporary_folder("val3dity") as folder:
        file = folder / "report.json"
        try:
            run = subprocess.run(
                [program, "--report", str(file), str(path.resolve())],
                capture_output=True,
                text=True,
                cwd=folder,
            )
            content = json.loads(file.read_text())
        except OSError as error:
            if not isinstance(error, FileNotFoundError) or error.filename != str(file):
                raise InputError(f"--val3dity {program}: cannot be run: {error}") from error
            said = (run.stderr or run.stdout).strip().splitlines()
            reason = said[-1] if said else f"exit status {run.returncode}"
            raise InputError(f"--val3dity {program}: wrote no report of {path}: {reason}") from error
        except json.JSONDecodeError as error:
            raise InputError(f"--val3dity {program}: its report of {path} is not JSON: {error}") from error
    return _errors(content)


def _errors(content: dict[str, Any]) -> dict[str, list[str]]:
    result: dict[str, list[str]] = {}
    for feature in [
        {"id": "the file", "errors": content.get("dataset_errors")},
        *content.get("features", []),
    ]:
        members = [feature, *(feature.get("primitives") or [])]
        errors = [error for member in members for error in member.get("errors") or []]
        texts = dict.fromkeys(
            f"{error.get('code', '')} {error.get('description', '')}".strip() for error in errors
        )
        if texts:
            result[str(feature.get("id", ""))] = list(texts)
    return result
