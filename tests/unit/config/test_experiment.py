"""config/paper.yaml is the experiment of the paper, and config/plus.yaml differs from it in the model only."""

from __future__ import annotations

from pathlib import Path

import pytest

from p2wss.config import Config, load, member_places, place_config
from p2wss.storage.messages import InputError

CONFIG = Path(__file__).parents[3] / "config"
# what config/plus.yaml takes from the miniature, and what a larger network has of its own
SWITCHES = (
    "auxiliary_share",
    "match_balanced",
    "ground_relative",
    "numerical_decoding",
    "edge_embedding",
    "edge_attention",
    "loss_weights",
    "augmentation",
)


def paper() -> Config:
    return load(CONFIG / "paper.yaml")


def test_the_data_set_is_the_papers() -> None:
    dataset = paper().dataset
    assert (dataset.num_pairs, dataset.num_lidar_dvae, dataset.num_lidar_test) == (800_000, 500_000, 350_000)
    assert member_places(paper()) == ["paris/", "marseille/", "bordeaux/", "lyon/"]


def test_real_lidar_is_that_of_the_same_tiles_in_every_city() -> None:
    for place in member_places(paper()):
        region = place_config(paper(), place).region
        assert region.tiles == [] and region.lidar_tiles == ["all"], place
        assert all(value % 1000 == 0 for value in region.bounds_m)


def test_the_bounds_hold_enough_buildings_at_the_stated_density() -> None:
    bounds = [place_config(paper(), place).region.bounds_m for place in member_places(paper())]
    km2 = sum((x_max - x_min) * (y_max - y_min) for x_min, y_min, x_max, y_max in bounds) / 1e6
    dataset = paper().dataset
    assert km2 == 960
    assert km2 * 885 >= dataset.num_lidar_dvae + dataset.num_lidar_test - 1000
    # a tenth of the area is for the test; the guard takes up to 13 % of its buildings
    assert km2 * 1100 * 0.1 * 0.87 > dataset.num_pairs / 10


def test_the_trainings_have_the_papers_epochs() -> None:
    config = paper()
    train = 0.8 * config.dataset.num_pairs
    dvae, model = config.dvae.optimiser, config.model.optimiser
    assert (dvae.batch_size, model.batch_size) == (512, 512)
    assert dvae.num_steps == pytest.approx(300 * (train + config.dataset.num_lidar_dvae) / 512, rel=1e-4)
    assert model.num_steps == 200 * train / 512


def test_plus_differs_in_the_model_only() -> None:
    papers = paper().model_dump()
    plus = load(CONFIG / "paper.yaml", CONFIG / "plus.yaml").model_dump()
    assert {name for name in papers if papers[name] != plus[name]} == {"model"}
    default = Config().model.model_dump()
    assert {name: plus["model"][name] for name in SWITCHES} == {name: default[name] for name in SWITCHES}
    sizes = [name for name in papers["model"] if name not in (*SWITCHES, "masking", "decoding")]
    assert {name: plus["model"][name] for name in sizes} == {name: papers["model"][name] for name in sizes}


def test_all_is_inherited_by_members_and_stands_alone() -> None:
    config = load({"region": {"tiles": ["all"]}, "dataset": {"members": [{"name": "a"}]}})
    assert place_config(config, "a/").region.tiles == ["all"]
    assert place_config(config, "a/").region.lidar_tiles == [], "names of tiles are those of one region"
    with pytest.raises(InputError, match=r"region.lidar_tiles: .*all must be the only entry"):
        load({"region": {"lidar_tiles": ["all", "0652_6862"]}})


def test_the_shipped_model_is_trained_on_the_members_of_its_card() -> None:
    config = load(CONFIG / "shipped-training.yaml")
    members = {member.name: member for member in config.dataset.members}
    splits = {name: member.split for name, member in members.items() if name.startswith("town-")}
    assert splits == {f"town-{seed}": "train" for seed in range(1, 11)} | {
        "town-19": "val",
        "town-20": "test",
    }
    olemps = [member for name, member in members.items() if name.startswith("olemps")]
    assert sum(member.draws for member in olemps if member.split == "train") == 28
    tiles = {member.split: place_config(config, f"{member.name}/").region.tiles for member in olemps}
    assert tiles == {"train": ["0664_6361"], "test": ["0664_6360"]}
    # every fifth seed has the preset paper, of the others every third 14 pulses per m2
    draws = {
        (scans.preset, scans.density_per_m2): sum(
            other.draws for other in olemps if other.split == "train" and other.scans == member.scans
        )
        for member in olemps
        for scans in [place_config(config, f"{member.name}/").scans]
        if member.split == "train"
    }
    assert draws == {("hd", 8): 15, ("hd", 14): 7, ("paper", 8): 6}
    networks = load(CONFIG / "models" / "cpu.yaml")
    # the shipped network got its head of numbers in the third part
    model = networks.model.model_copy(update={"numerical_decoding": False})
    assert (config.dvae, config.model) == (networks.dvae, model)
