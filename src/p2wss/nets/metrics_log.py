"""The metrics of a training: lines of JSON in a file, and TensorBoard on request."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any
from zlib import crc32

from p2wss.errors import InputError, reading
from p2wss.nets import distributed
from p2wss.storage import files

FILE_NAME = "metrics.jsonl"
_CHECKSUM = ', "crc32": "'
log = logging.getLogger("p2wss")


class MetricsLog:
    """``metrics.jsonl`` in the folder of the checkpoints; of several processes the main one writes it.

    Raises :class:`InputError` when the file cannot be written, or TensorBoard is requested and not installed.
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
        records = _read(self.path) if step and self.path.exists() else []
        earlier = [record for record in records if record["step"] <= step]
        files.write_text(self.path, "".join(_line(record) for record in earlier))

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
                file.write(_line(values))
        except OSError as error:
            raise InputError(f"{self.path}: not written: {error.strerror or error}") from error


def read_metrics(checkpoints: Path) -> str:
    """The metrics of a finished training, one JSON object per line."""
    return "".join(json.dumps(record) + "\n" for record in _read(checkpoints / FILE_NAME))


def _line(values: dict[str, Any]) -> str:
    """A line of the log: the values, and a checksum of the text before it."""
    text = json.dumps(values)[:-1]
    return f'{text}{_CHECKSUM}{crc32(text.encode()):08x}"}}\n'


def _read(path: Path) -> list[dict[str, Any]]:
    """The records of a log, without those that a kill cut off or that are damaged."""
    records, num_damaged = [], 0
    with reading(path, "readable metrics; delete it"):
        lines = path.read_bytes().splitlines()
    for line in lines:
        text, separator, stated = line.rpartition(_CHECKSUM.encode())
        if separator and stated == f'{crc32(text):08x}"}}'.encode():
            records.append(json.loads(text + b"}"))
        else:
            num_damaged += 1
    if num_damaged:
        log.warning("%s: skipped %d damaged or incomplete lines", path, num_damaged)
    return records


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
