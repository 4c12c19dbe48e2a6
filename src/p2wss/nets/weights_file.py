"""Files of weights: the one that comes with the package, and the metadata of a file. Imports no torch."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from p2wss.config import Reconstruct
from p2wss.storage import integrity
from p2wss.storage.errors import InputError, reading

# in place of a file of weights: no network
NO_NETWORK = "none"
# the phrase of messages
KIND = "a readable safetensors file"


def weights_to_use(model: Path | None, config: Reconstruct) -> Path | None:
    """The file of weights: ``model``; by default none for roofs of planes, which a network brings no nearer to their
    points, and for parametric buildings the one that came with the package, if there is one. None for no network, as
    with the ``model`` "none".

    Raises :class:`InputError` if there is neither a network nor a fit.
    """
    weights = model
    if model is None and (config.roofs == "parametric" or not config.fit):
        weights = shipped_model()
    if weights is not None and str(weights) == NO_NETWORK:
        weights = None
    if weights is None and not config.fit:
        raise InputError(
            "without the fit (--no-fit, reconstruct.fit) a network is required; name one with --model"
        )
    return weights


def shipped_model() -> Path | None:
    """The weights that came with the package; None in a package without."""
    path = Path(str(files("p2wss"))) / "weights" / "point2wss.safetensors"
    return path if path.is_file() else None


def read_metadata(path: Path, kind: str) -> dict[str, Any]:
    """The metadata of a file of weights. Raises :class:`InputError` for a file that is missing, unreadable or not of
    this ``kind``."""
    from safetensors import safe_open

    if not Path(path).is_file():
        raise InputError(f"{path}: no such file; train it first (p2wss {kind})")
    integrity.verify(path)
    with reading(path, KIND), safe_open(path, "np") as file:
        metadata = json.loads((file.metadata() or {}).get("p2wss", "{}"))
    if not isinstance(metadata, dict) or metadata.get("kind") != kind:
        raise InputError(f"{path}: not a {kind} of p2wss")
    return {name: value for name, value in metadata.items() if name != "checksum"}
