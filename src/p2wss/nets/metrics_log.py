"""The metrics of a training: lines of JSON in a file, and TensorBoard on request."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from p2wss.data import files
from p2wss.errors import InputError, reading
from p2wss.nets import distributed

FILE_NAME = "metrics.jsonl"


class MetricsLog:
    """``metrics.jsonl`` in the folder of the checkpoints; of several processes the main one writes it.

    Raises :class:`InputError` when the file cannot be written, or TensorBoard is asked for and not installed.
    """

    def __init__(self, checkpoints: Path, tensorboard: bool) -> None:
        self.path = checkpoints / FILE_NAME
        self._writer: Any = None
        if tensorboard and distributed.rank() == 0:
            self._writer = _tensorboard_writer(checkpoints / "tensorboard")

    def truncate(self, step: int) -> None:
        """Drop the lines after ``step``, which a resumed training writes again."""
        if distributed.rank():
            return
        lines = []
        if step and self.path.exists():
            with reading(self.path, "readable metrics; delete it"):
                lines = self.path.read_bytes().splitlines()
        earlier = [line.decode() for line in lines if 0 <= _step(line) <= step]
        files.write_text(self.path, "".join(line + "\n" for line in earlier))

    def add(self, values: dict[str, Any]) -> None:
        """Append one line; ``values`` hold the step."""
        if distributed.rank():
            return
        if self._writer is not None:
            for name in values.keys() - {"step"}:
                self._writer.add_scalar(name, values[name], values["step"])
            self._writer.flush()
        try:
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(json.dumps(values) + "\n")
        except OSError as error:
            raise InputError(f"{self.path}: not written: {error.strerror or error}") from error


def _step(line: bytes) -> int:
    """The step of a line; -1 for one that is cut off, as by a kill."""
    try:
        return int(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return -1


def read_metrics(checkpoints: Path) -> str:
    """The metrics of a finished training, one JSON object per line."""
    return files.read_text(checkpoints / FILE_NAME)


def last_validation(metrics: str) -> dict[str, float]:
    """The measures of the last validation among lines of metrics; empty if there was none."""
    records = [json.loads(line) for line in metrics.splitlines()]
    validations = [record for record in records if any(name.startswith("val_") for name in record)]
    return validations[-1] if validations else {}


def _tensorboard_writer(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise InputError(
            "compute.tensorboard: TensorBoard is not installed: pip install tensorboard"
        ) from error
    return SummaryWriter(str(folder))
