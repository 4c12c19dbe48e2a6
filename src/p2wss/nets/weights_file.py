"""Files of weights: the one that comes with the package, and the metadata of a file. Imports no torch."""

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from p2wss.storage import integrity
from p2wss.storage.messages import InputError, reading

# values in place of a file of weights: no network, and the weights of the package
NO_NETWORK, SHIPPED = "none", "point2wss"
# what messages call such a file
KIND = "a readable safetensors file"


def weights_to_use(model: Path | None) -> Path | None:
    """The file of weights of Point2WSS. ``model`` "point2wss" gives the file of the package; None or "none" gives None:
    the network of the paper is not used.

    Raises :class:`InputError` for "point2wss" if the package has come without weights.
    """
    if model is None or str(model) == NO_NETWORK:
        return None
    if str(model) != SHIPPED:
        return model
    shipped = shipped_model()
    if shipped is None:
        raise InputError(f"--model {SHIPPED}: this p2wss has no weights; name a file")
    return shipped


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
