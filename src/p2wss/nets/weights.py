"""Files of trained weights (safetensors) with what made them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torch import Tensor

from p2wss import __version__
from p2wss.data import files
from p2wss.errors import InputError


def write_weights(path: Path, state: dict[str, Tensor], facts: dict[str, Any]) -> None:
    """Weights as safetensors with ``facts`` as JSON in the header, under the key ``p2wss``."""
    from safetensors.torch import save

    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    content = save(tensors, metadata={"p2wss": json.dumps(facts, sort_keys=True)})
    with files.atomic(path) as temporary:
        temporary.write_bytes(content)


def read_weights(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The inverse of :func:`write_weights`. Raises :class:`InputError` for a file of another kind."""
    from safetensors import SafetensorError, safe_open

    if not Path(path).is_file():
        raise InputError(f"{path}: no such file; train it first (p2wss {kind})")
    try:
        with safe_open(path, "pt") as file:
            facts = json.loads((file.metadata() or {}).get("p2wss", "{}"))
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable safetensors file: {error}") from error
    if facts.get("kind") != kind:
        raise InputError(f"{path}: not a {kind} of p2wss")
    return state, facts


@contextmanager
def of_this_version(path: Path, facts: dict[str, Any]) -> Iterator[None]:
    """Turn what goes wrong while weights are put to use into an :class:`InputError`."""
    try:
        yield
    # pydantic's errors are ValueErrors; load_state_dict raises RuntimeError
    except (KeyError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{path}: made by p2wss {facts.get('version')} with other settings or networks than this"
            f" one ({__version__}) knows; train it again"
        ) from error
