"""How much work a config is, by the units of the table of costs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from p2wss.config import Config, Crops, draw_places, member_places, place_config
from p2wss.plan import networks

# 80 / 10 / 10 percent (paper, section 5.1)
_SPLIT_SHARES = {"train": 0.8, "val": 0.1, "test": 0.1}
# pulses per m2 of scans.density_per_m2 = null
_DEFAULT_DENSITY_PER_M2 = {"hd": 14, "paper": 8, "none": 8}
# the width of the strip inside the edge of a block whose buildings are not used, as a share of the guard: 23.6 % of val
# and test buildings are lost with 10 m and blocks of 125 m, in the miniature and in two tiles of BD TOPO (40 seeds)
_GUARD_STRIP = 0.8
_TOWN = re.compile(r"resources/towns/\d+/")


@dataclass(frozen=True)
class Region:
    """The tiles of a member of the data set. num_buildings: counted by the stage scenes, per tile; else None."""

    tiles: Sequence[str]
    lidar_tiles: Sequence[str]
    num_buildings: Mapping[str, int] | None = None


@dataclass(frozen=True)
class Work:
    """Counts of one config.

    amounts: by the units of the table of costs. pairs: simulated buildings used, per split. num_expected: simulated
    buildings of all draws.
    """

    num_tiles: int
    num_lidar_tiles: int
    num_jobs: int
    num_buildings: float
    num_expected: float
    pairs: Mapping[str, float]
    num_real: float
    num_lidar_dvae: float
    num_lidar_test: float
    amounts: Mapping[str, float]


def count_work(config: Config, regions: Sequence[Region]) -> Work:
    """The work of a config. regions: one per member, in the order of the config."""
    members = member_places(config)
    num_tiles = num_lidar_tiles = num_drawn_tiles = 0
    num_buildings = num_simulated = num_real = num_pulses = 0.0
    available = dict.fromkeys(_SPLIT_SHARES, 0.0)
    source_tiles: set[tuple[str, str]] = set()
    source_lidar_tiles: set[tuple[str, str]] = set()
    towns: set[str] = set()
    for place, region in zip(members, regions, strict=True):
        at = place_config(config, place)
        area_km2 = (at.region.tile_size_m / 1000) ** 2
        num_draws = len(draw_places(config, place))
        buildings = sum(_num_buildings(config, place, region, tile, area_km2) for tile in region.tiles)
        num_tiles += len(region.tiles)
        num_drawn_tiles += len(region.tiles) * num_draws
        num_lidar_tiles += len(region.lidar_tiles)
        num_buildings += buildings
        num_simulated += buildings * num_draws
        num_real += sum(_num_buildings(config, place, region, tile, area_km2) for tile in region.lidar_tiles)
        density = at.scans.density_per_m2 or _DEFAULT_DENSITY_PER_M2[at.scans.preset]
        num_pulses += len(region.tiles) * num_draws * area_km2 * density
        for split, share in split_shares(at.crops).items():
            available[split] += share * buildings * num_draws
        source_tiles |= {(at.region.vintage, tile) for tile in region.tiles}
        source_lidar_tiles |= {(at.region.vintage, tile) for tile in region.lidar_tiles}
        towns |= {*_TOWN.findall(f"{at.fetch.folder.footprints} {at.fetch.folder.dtm}")}
    dataset = config.dataset
    pairs = available
    if dataset.num_pairs:
        pairs = {
            name: min(available[name], share * dataset.num_pairs) for name, share in _SPLIT_SHARES.items()
        }
    lidar_test = min(num_real, dataset.num_lidar_test or num_real)
    lidar_dvae = min(num_real - lidar_test, dataset.num_lidar_dvae) if dataset.num_lidar_test else num_real
    num_test = pairs["test"] + lidar_test
    trained = not config.model.weights
    amounts: dict[str, float] = {
        "member": len(members),
        "tile": len(source_tiles),
        "building": num_simulated,
        "million pulses": num_pulses,
        "real building": num_real,
        "test building": num_test,
        "run": 1.0,
        "dvae tflop": networks.training_tflop(config.dvae, config.dvae) if trained else 0.0,
        "model tflop": networks.training_tflop(config.model, config.dvae) if trained else 0.0,
        "test tflop": networks.inference_tflop(config.model, config.dvae, num_test),
        "real tflop": networks.inference_tflop(config.model, config.dvae, num_real),
    }
    # fetch_footprints, fetch_dtm, fetch_lidar and draw_town
    num_jobs = len(members) + len(source_tiles) + len(source_lidar_tiles) + len(towns)
    num_jobs += _num_jobs(config, num_drawn_tiles, num_lidar_tiles)
    amounts["job"] = num_jobs
    return Work(
        num_tiles,
        num_lidar_tiles,
        num_jobs,
        num_buildings,
        num_simulated,
        pairs,
        num_real,
        lidar_dvae if config.dvae.use_lidar else 0.0,
        lidar_test,
        amounts,
    )


def _num_jobs(config: Config, num_drawn_tiles: int, num_lidar_tiles: int) -> int:
    """The number of jobs after the data are fetched. num_drawn_tiles: tiles times the draws of each."""
    num_groups = -(-(num_drawn_tiles + num_lidar_tiles) // config.eval.shards_per_job)
    return (
        4 * num_drawn_tiles  # cut_scene, build_roofs, cast_scan, crop_simulated
        + 3 * num_lidar_tiles  # prepare_lidar, crop_real, reconstruct_tile
        + 2 * (not config.model.weights)  # dvae, model
        + num_groups * (5 + len(config.eval.baselines))  # four methods of ours, measure
        + 5  # index_scenes, crops, medians, eval_report, all
    )


def split_shares(config: Crops) -> dict[str, float]:
    """Share of the buildings in each split.

    By location, val and test lose those near the edge of their block.
    """
    if config.split != "blocks":
        return {name: float(name == config.split) for name in _SPLIT_SHARES}
    inner = max(0.0, 1 - 2 * _GUARD_STRIP * config.guard_m / config.block_size_m) ** 2
    return {name: share * (1.0 if name == "train" else inner) for name, share in _SPLIT_SHARES.items()}


def density_per_km2(config: Config, place: str) -> float:
    """Usable buildings per km2 that the config assumes for a member."""
    return config.plan.member_buildings_per_km2.get(place.removesuffix("/"), config.plan.buildings_per_km2)


def _num_buildings(config: Config, place: str, region: Region, tile: str, area_km2: float) -> float:
    if region.num_buildings is not None:
        return region.num_buildings.get(tile, 0)
    return density_per_km2(config, place) * area_km2
