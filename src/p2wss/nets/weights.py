"""Files of trained weights: safetensors with the configs, the code's fingerprint and the last measures."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import Module

from p2wss import __version__
from p2wss.config import Dvae as DvaeConfig
from p2wss.config import Model as ModelConfig
from p2wss.errors import InputError
from p2wss.nets.builders import build_dvae, build_model, build_tokenizer
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.metrics_log import last_validation
from p2wss.nets.point2wss import Point2Wss, inference_weights
from p2wss.nets.weights_file import read_metadata
from p2wss.storage import files, integrity

# keys of the metadata that had another name when older files were written
_RENAMED_KEYS = {"words": "vocabulary"}


def save_dvae(module: DiscreteVae, path: Path, config: DvaeConfig, code: str, metrics: str) -> None:
    """Write the tokenizer's weights, completely or not at all. ``metrics``: lines of ``metrics.jsonl``."""
    metadata = files.provenance(
        kind="dvae", config=config.model_dump(mode="json"), code=code, measures=last_validation(metrics)
    )
    write_weights(path, module.state_dict(), metadata)


def load_dvae(path: Path) -> tuple[DiscreteVae, DvaeConfig]:
    """The trained tokenizer, frozen, and its config. Raises :class:`InputError` for any other file."""
    state, metadata = read_weights(path, "dvae")
    with _compatible(path, metadata):
        config = DvaeConfig.model_validate(metadata["config"])
        _check_sizes(lambda: build_dvae(config), state)
        module = build_dvae(config)
        module.load_state_dict(state)
    return module.eval().requires_grad_(False), config


def save_model(
    module: Point2Wss, path: Path, config: ModelConfig, dvae_config: DvaeConfig, code: str, metrics: str
) -> None:
    """Write the weights that inference needs, completely or not at all. ``metrics``: lines of ``metrics.jsonl``."""
    metadata = files.provenance(
        kind="model",
        config=config.model_dump(mode="json"),
        dvae_config=dvae_config.model_dump(mode="json"),
        vocabulary=module.tokenizer.vocabulary,
        code=code,
        measures=last_validation(metrics),
    )
    write_weights(path, inference_weights(module.state_dict()), metadata)


def load_model(path: Path) -> tuple[Point2Wss, ModelConfig, DvaeConfig]:
    """A trained Point2WSS for inference, with its config and its tokenizer's.

    Raises :class:`InputError` for any other file.
    """
    state, metadata = read_weights(path, "model")
    with _compatible(path, metadata):
        config = ModelConfig.model_validate(metadata["config"])
        dvae_config = DvaeConfig.model_validate(metadata["dvae_config"])
        tokenizer = build_tokenizer(config)
        if tuple(metadata["vocabulary"]) != tokenizer.vocabulary:
            raise ValueError("another vocabulary")
        _check_sizes(lambda: build_model(config, dvae_config, tokenizer), state)
        module = build_model(config, dvae_config, tokenizer)
        module.load_state_dict(state, strict=False)
        missing = set(inference_weights(module.state_dict())) - set(state)
        if missing:
            raise ValueError(f"no weights {min(missing)}")
    return module, config, dvae_config


def write_weights(path: Path, state: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Weights as safetensors, with ``metadata`` as JSON in the header under the key ``p2wss``, and a checksum."""
    from safetensors.torch import save

    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    content = save(tensors, metadata={"p2wss": json.dumps({"checksum": integrity.SLOT} | metadata)})
    files.write_bytes(path, content)


def read_weights(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The inverse of :func:`write_weights`; renamed keys of the metadata get their present names.

    Raises :class:`InputError` for a file that is missing, unreadable or not of this ``kind``.
    """
    from safetensors import SafetensorError, safe_open

    metadata = read_metadata(path, kind)
    try:
        with safe_open(path, "pt") as file:
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable safetensors file: {error}") from error
    return state, {_RENAMED_KEYS.get(name, name): value for name, value in metadata.items()}


def _check_sizes(build: Callable[[], Module], state: dict[str, Tensor]) -> None:
    """Raise ValueError if the network that the config describes has other sizes than the file's tensors.

    It is built without memory first, so that a config that does not belong to the weights cannot take all of it.
    """
    with torch.device("meta"):
        shapes = {name: value.shape for name, value in build().state_dict().items()}
    for name, value in state.items():
        if shapes.get(name) != value.shape:
            raise ValueError(f"{name} has another size")


@contextmanager
def _compatible(path: Path, metadata: dict[str, Any]) -> Iterator[None]:
    """Turn any failure to use weights into an :class:`InputError` that names the version that wrote them."""
    try:
        yield
    # pydantic's errors are ValueErrors; load_state_dict raises RuntimeError
    except (KeyError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{path}: written by p2wss {metadata.get('version')}, with settings or networks that this version"
            f" ({__version__}) does not support; train it again"
        ) from error
