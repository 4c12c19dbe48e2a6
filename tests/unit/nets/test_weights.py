"""Files of trained weights, those of older versions among them."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest
import torch
from places import ROOT
from small_networks import SMALL_DVAE, SMALL_MODEL

from p2wss.config import load
from p2wss.nets.point2wss import Point2Wss
from p2wss.nets.weights import load_dvae, load_model, read_weights, save_model, write_weights
from p2wss.storage.integrity import is_intact
from p2wss.storage.messages import InputError

SHIPPED = ROOT / "models" / "point2wss.safetensors"


def test_weights_carry_their_metadata_and_other_files_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    state = {"a": torch.arange(6.0).view(2, 3).T}
    write_weights(path, state, {"kind": "model", "config": {"b": 1}})
    read, metadata = read_weights(path, "model")
    assert torch.equal(read["a"], state["a"]) and metadata["config"] == {"b": 1}
    with pytest.raises(InputError, match="not a dvae of p2wss"):
        read_weights(path, "dvae")
    with pytest.raises(InputError, match="not a dvae of p2wss"):
        load_dvae(path)
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(InputError, match="not a readable safetensors file"):
        read_weights(path, "model")
    with pytest.raises(InputError, match="no such file"):
        read_weights(tmp_path / "none", "model")


def test_the_shipped_weights_load_and_know_the_vocabulary_of_the_code() -> None:
    _, metadata = read_weights(SHIPPED, "model")
    module = load_model(SHIPPED)
    config, dvae_config = module.config, module.dvae_config
    assert tuple(metadata["vocabulary"]) == module.tokenizer.vocabulary
    assert (config.dim, config.decoding.num_rotations, dvae_config.num_tokens) == (128, 4, 512)


def test_the_shipped_weights_state_their_checksum(tmp_path: Path) -> None:
    assert is_intact(SHIPPED) is True
    content = bytearray(SHIPPED.read_bytes())
    content[len(content) // 2] ^= 1
    path = tmp_path / "w.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged or changed"):
        load_model(path)


def test_weights_that_are_read_are_those_that_were_saved(tmp_path: Path) -> None:
    config = load({"dvae": SMALL_DVAE, "model": SMALL_MODEL})
    path = tmp_path / "m.safetensors"
    save_model(Point2Wss(config.model, config.dvae), path, "x", "")
    state, _ = read_weights(path, "model")
    loaded = load_model(path)
    assert (loaded.config, loaded.dvae_config) == (config.model, config.dvae)
    assert all(torch.equal(loaded.state_dict()[name], state[name]) for name in state)


def test_weights_of_before_there_was_a_head_of_numbers_have_none(tmp_path: Path) -> None:
    config = load({"dvae": SMALL_DVAE, "model": SMALL_MODEL | {"numerical_decoding": False}})
    path = tmp_path / "m.safetensors"
    save_model(Point2Wss(config.model, config.dvae), path, "x", "")
    state, metadata = read_weights(path, "model")
    del metadata["config"]["numerical_decoding"]
    write_weights(path, state, metadata)
    assert load_model(path).config == config.model


@pytest.mark.parametrize("change", [{"vocabulary": ["[pad]"]}, {"config": {"width": 3}}])
def test_weights_that_this_version_does_not_support_are_one_clear_line(
    tmp_path: Path, change: dict[str, object]
) -> None:
    state, metadata = read_weights(SHIPPED, "model")
    path = tmp_path / "m.safetensors"
    write_weights(path, state, metadata | change)
    with pytest.raises(InputError, match=r"written by p2wss .* does not support; train it again"):
        load_model(path)


def test_a_config_that_does_not_belong_to_the_weights_takes_no_memory(tmp_path: Path) -> None:
    """The largest network that a config may describe has thousands of times the weights of the file."""
    state, metadata = read_weights(SHIPPED, "model")
    metadata["config"] |= {"dim": 4096, "num_heads": 1, "mlp_ratio": 64.0, "cloud_depth": 64}
    write_weights(tmp_path / "large.safetensors", state, metadata)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="does not support; train it again"):
        load_model(tmp_path / "large.safetensors")
    num_new_bytes = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    assert num_new_bytes < 300e6, "one layer alone would have 4 GB"


def test_the_shipped_weights_are_those_of_their_configs() -> None:
    module = load_model(SHIPPED)
    parts = ("training", "continued", "numbers", "parts", "gpu")
    config = load(*(ROOT / f"config/shipped-{part}.yaml" for part in parts))
    assert (module.config, module.dvae_config) == (config.model, config.dvae)
