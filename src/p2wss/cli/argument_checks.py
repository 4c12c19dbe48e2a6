"""Checks of the arguments of ``p2wss reconstruct`` before anything slow is imported or read. They use names, signatures
and headers of the files."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from p2wss.cli.common import log
from p2wss.config import OUTPUT_SUFFIXES, TABLES_AND_MODELS, Config
from p2wss.data.tiling import tile_bounds
from p2wss.storage.errors import InputError
from p2wss.storage.files import check_folder


def check(out: Path, terrain: Path | None, tile: str | None, config: Config) -> None:
    """Check the arguments that are no inputs.

    Raises :class:`InputError`, in one line, for an argument that cannot work; logs a warning for one without effect.
    """
    check_out(out, config)
    if tile is not None:
        tile_bounds(tile, config.region.tile_size_m)
    outputs = config.reconstruct.outputs
    names = ", ".join(outputs)
    if config.reconstruct.vegetation and {*outputs} <= {"gpkg", "geoparquet"}:
        log.warning("warning: --vegetation has no effect on files: none of %s has plants", names)
    if any(name not in TABLES_AND_MODELS for name in outputs):
        return
    if terrain is not None and "report" not in outputs:  # the page of the report shows it
        raise InputError(
            f"--terrain {terrain}: {names} cannot hold a terrain; add a mesh format to --outputs, such as"
            " glb, or omit --terrain"
        )
    for option in ("per_building", "skin"):
        if getattr(config.reconstruct, option):
            name = option.replace("_", "-")
            log.warning("warning: --%s has no effect on files: none of %s is a mesh format", name, names)


def check_out(out: Path, config: Config) -> None:
    """Raise :class:`InputError` if ``out`` is no folder, is named like a file, or cannot be written to, and
    ``ModuleNotFoundError`` if a format needs a missing package."""
    if config.reconstruct.writes_parquet:
        import pyarrow.parquet  # noqa: F401
    check_folder(out, OUTPUT_SUFFIXES.values())
    folder = existing_folder(out)
    if not folder.is_dir():
        raise InputError(f"{out}: not written: {folder} is a file; name a folder for the outputs")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{out}: not written: {error.strerror or error}") from error


def existing_folder(out: Path) -> Path:
    """``out``, or the nearest folder above it that exists."""
    while not os.path.lexists(out):
        out = out.parent
    return out
