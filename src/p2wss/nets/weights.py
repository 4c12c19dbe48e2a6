"""Files of trained weights: safetensors with the configs, the code's fingerprint and the last measures."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.nn import Module
from torch.overrides import TorchFunctionMode

from p2wss import __version__
from p2wss.config import Dvae as DvaeConfig
from p2wss.config import Model as ModelConfig
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.point2wss import Point2Wss, inference_weights
from p2wss.nets.weights_file import KIND, read_metadata
from p2wss.storage import files, integrity
from p2wss.storage.messages import InputError, reading

_Network = TypeVar("_Network", bound=Module)

# values of keys that files of older versions do not state
_OLDER = {"numerical_decoding": False}


def save_dvae(module: DiscreteVae, path: Path, code: str, metrics: str) -> None:
    """Write the tokenizer's weights, completely or not at all. ``metrics``: lines of ``metrics.jsonl``."""
    metadata = files.provenance(
        kind="dvae",
        config=_settings(module.config.model_dump(mode="json")),
        code=code,
        measures=last_validation(metrics),
    )
    write_weights(path, module.state_dict(), metadata)


def load_dvae(path: Path) -> DiscreteVae:
    """The trained tokenizer, frozen. Raises :class:`InputError` for any other file."""
    state, metadata = read_weights(path, "dvae")
    with _compatible(path, metadata):
        config = DvaeConfig.model_validate(_settings(metadata["config"]))
        module = _built(lambda: DiscreteVae(config), state)
        module.load_state_dict(state)
    return module.eval().requires_grad_(False)


def save_model(module: Point2Wss, path: Path, code: str, metrics: str) -> None:
    """Write the weights that inference needs, completely or not at all. ``metrics``: lines of ``metrics.jsonl``."""
    metadata = files.provenance(
        kind="model",
        config=_settings(module.config.model_dump(mode="json")),
        dvae_config=_settings(module.dvae_config.model_dump(mode="json")),
        vocabulary=module.tokenizer.vocabulary,
        code=code,
        measures=last_validation(metrics),
    )
    write_weights(path, inference_weights(module.state_dict()), metadata)


def load_model(path: Path) -> Point2Wss:
    """A trained Point2WSS for inference. Raises :class:`InputError` for any other file."""
    state, metadata = read_weights(path, "model")
    with _compatible(path, metadata):
        config = ModelConfig.model_validate(_OLDER | _settings(metadata["config"]))
        dvae_config = DvaeConfig.model_validate(_settings(metadata["dvae_config"]))
        module = _built(lambda: Point2Wss(config, dvae_config), state)
        if tuple(metadata["vocabulary"]) != module.tokenizer.vocabulary:
            raise ValueError("another vocabulary")
        module.load_state_dict(state, strict=False)
        missing = set(inference_weights(module.state_dict())) - set(state)
        if missing:
            raise ValueError(f"no weights {min(missing)}")
    return module


def last_validation(metrics: str) -> dict[str, float]:
    """The measures of the last validation among lines of metrics; empty if there was none."""
    records = [json.loads(line) for line in metrics.splitlines()]
    validations = [record for record in records if any(name.startswith("val_") for name in record)]
    return validations[-1] if validations else {}


def write_weights(path: Path, state: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Weights as safetensors, with ``metadata`` as JSON in the header under the key ``p2wss``, and a checksum."""
    from safetensors.torch import save

    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    content = save(tensors, metadata={"p2wss": json.dumps({"checksum": integrity.SLOT} | metadata)})
    files.write_bytes(path, content)


def read_weights(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The inverse of :func:`write_weights`.

    Raises :class:`InputError` for a file that is missing, unreadable or not of this ``kind``.
    """
    from safetensors import safe_open

    metadata = read_metadata(path, kind)
    with reading(path, KIND), safe_open(path, "pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, metadata  # noqa: SIM118


def _settings(config: dict[str, Any]) -> dict[str, Any]:
    """The config of a network without the settings of the machine that trained it, which only files of older versions
    have."""
    return {name: value for name, value in config.items() if name != "compute"}


class _WithoutNormalDraws(TorchFunctionMode):
    """Skips the random draws that initialise embeddings. For tensors without memory, torch would import its compiler
    for them, which takes longer than all else. It does so for arithmetic with such tensors, too."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return None if func is torch.nn.init.normal_ else func(*args, **kwargs or {})


def _built(build: Callable[[], _Network], state: dict[str, Tensor]) -> _Network:
    """The network that ``build`` makes. Raises ValueError if the tensors of ``state`` have other sizes.

    It is built without memory first, so that a config that does not belong to the weights cannot take all of it.
    """
    with torch.device("meta"), _WithoutNormalDraws():
        shapes = {name: value.shape for name, value in build().state_dict().items()}
    for name, value in state.items():
        if shapes.get(name) != value.shape:
            raise ValueError(f"{name} has another size")
    return build()


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
