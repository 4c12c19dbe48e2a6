"""What a config needs: its work times the measured costs, as a table and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from p2wss.config import ALL, Config, dataset_name, member_places, place_config
from p2wss.errors import InputError
from p2wss.plan.costs import Cost
from p2wss.plan.work import Region, Work, count_work, density_per_km2, split_shares

# a point takes about 5 bytes in a LAZ file and 100 while a tile is prepared or cropped
_MEMORY_PER_LAZ_MB = 20


@dataclass(frozen=True)
class Download:
    """Megabytes of one product that are not stored yet, and how they were estimated. largest_mb: of one file."""

    product: str
    size_mb: float
    largest_mb: float
    basis: str


def estimate(
    config: Config, regions: Sequence[Region], costs: Sequence[Cost], downloads: Sequence[Download]
) -> dict[str, Any]:
    """What a config needs, for programs: counts are whole numbers, figures have three digits.

    regions: as of :func:`count_work`. downloads: what must still be downloaded. cpu_hours are without what runs on a
    GPU, cpu_hours_without_gpu are all; peak_memory_gb is that of the largest job, not on the GPU.

    Raises :class:`InputError` if the costs are per a unit that is unknown.
    """
    work = count_work(config, regions)
    unknown = sorted({cost.unit for cost in costs} - work.amounts.keys())
    if unknown:
        raise InputError(f"table of costs: unknown unit {unknown[0]}; units: {', '.join(work.amounts)}")
    # a stage that the config skips costs nothing, whatever its unit
    rows = [(cost, work.amounts[cost.unit]) for cost in costs if work.amounts[cost.unit]]
    download_gb = sum(download.size_mb for download in downloads) / 1000
    clouds_gb = sum(download.size_mb for download in downloads if download.product == "LiDAR") / 1000
    largest_mb = max((download.largest_mb for download in downloads), default=0.0)
    # prepared clouds are as large as those downloaded
    disk_gb = sum(cost.disk_mb * amount for cost, amount in rows) / 1000 + download_gb + clouds_gb
    return {
        "name": dataset_name(config),
        "tiles": work.num_tiles,
        "lidar_tiles": work.num_lidar_tiles,
        "jobs": work.num_jobs,
        "buildings": round(work.num_buildings),
        "simulated": round(work.num_expected),
        "pairs": round(sum(work.pairs.values())),
        "pairs_by_split": {split: round(count) for split, count in work.pairs.items()},
        "real_clouds": round(work.num_real),
        "lidar_dvae": round(work.num_lidar_dvae),
        "lidar_test": round(work.num_lidar_test),
        "cpu_hours": _rounded(sum(cost.cpu_s * amount for cost, amount in rows if not cost.gpu_s) / 3600),
        "gpu_hours": _rounded(sum(cost.gpu_s * amount for cost, amount in rows) / 3600),
        "cpu_hours_without_gpu": _rounded(sum(cost.cpu_s * amount for cost, amount in rows) / 3600),
        "disk_gb": _rounded(disk_gb + _training_cache_gb(config, work)),
        "download_gb": _rounded(download_gb),
        "peak_memory_gb": _rounded(
            max([largest_mb * _MEMORY_PER_LAZ_MB, *(cost.peak_mb for cost, _ in rows)]) / 1000
        ),
        "stages": [
            {
                "stage": cost.stage,
                "amount": _rounded(amount),
                "unit": cost.unit,
                "cpu_hours": _rounded(cost.cpu_s * amount / 3600),
                "gpu_hours": _rounded(cost.gpu_s * amount / 3600),
                "disk_gb": _rounded(cost.disk_mb * amount / 1000),
            }
            for cost, amount in rows
        ],
        "assumptions": _assumptions(config, regions, [cost for cost, _ in rows], downloads, work),
    }


def to_text(result: dict[str, Any]) -> str:
    """The estimate for the terminal."""
    splits = ", ".join(f"{count:,} {split}" for split, count in result["pairs_by_split"].items())
    rows = [
        ("tiles", "{tiles:,}, with real LiDAR {lidar_tiles:,}"),
        ("jobs", "{jobs:,}"),
        ("buildings", "{buildings:,}, simulated {simulated:,} times"),
        ("pairs", "{pairs:,} ({splits})"),
        ("real clouds", "{real_clouds:,}; for the dvae {lidar_dvae:,}, for the test {lidar_test:,}"),
        ("CPU-hours", "{cpu_hours:,.3g}, without a GPU {cpu_hours_without_gpu:,.3g}"),
        ("GPU-hours", "{gpu_hours:,.3g}"),
        ("to download", "{download_gb:,.3g} GB"),
        ("on disk", "{disk_gb:,.3g} GB"),
        ("peak memory", "{peak_memory_gb:.2g} GB"),
    ]
    lines = [f"{name:12} {text.format(splits=splits, **result)}" for name, text in rows]
    lines += ["", f"{'stage':24}{'amount':>14} {'unit':16}{'CPU-hours':>10}{'GPU-hours':>10}{'GB':>9}"]
    row = "{stage:24}{amount:14,.0f} {unit:16}{cpu_hours:10.3g}{gpu_hours:10.3g}{disk_gb:9.3g}"
    lines += [row.format(**stage) for stage in result["stages"]]
    return "\n".join([*lines, "", "assumptions:", *(f"- {text}" for text in result["assumptions"])])


def pinned(config: Config, regions: Sequence[Region]) -> dict[str, Any]:
    """A config for a later ``--configfile`` that names the tiles of every member."""
    if not config.dataset.members:
        return {"region": {"tiles": list(regions[0].tiles), "lidar_tiles": list(regions[0].lidar_tiles)}}
    members = config.model_dump(mode="json")["dataset"]["members"]
    for member, region in zip(members, regions, strict=True):
        member["region"] |= {"tiles": list(region.tiles), "lidar_tiles": list(region.lidar_tiles)}
    return {"dataset": {"members": members}}


def _training_cache_gb(config: Config, work: Work) -> float:
    """Points and patches that a training maps into memory, int16."""
    num_clouds = work.pairs["train"] + work.pairs["val"] + work.num_lidar_dvae
    num_points = config.dvae.num_points + config.dvae.num_patches * config.dvae.patch_size
    return 6 * num_clouds * num_points / 1e9 if work.amounts["dvae tflop"] else 0.0


def _assumptions(
    config: Config,
    regions: Sequence[Region],
    costs: Sequence[Cost],
    downloads: Sequence[Download],
    work: Work,
) -> list[str]:
    lines = []
    for place, region in zip(member_places(config), regions, strict=True):
        name = place.removesuffix("/") or config.region.name
        named = place_config(config, place).region.tiles
        tiles = f"{len(region.tiles)} tiles{', all within its bounds' if named in ([], [ALL]) else ''}"
        buildings = (
            f"{density_per_km2(config, place):g} usable buildings per km2 (section plan of the config)"
            if region.num_buildings is None
            else "buildings counted by the stage scenes"
        )
        lines.append(f"{name}: {tiles}; {buildings}")
    shares = split_shares(config.crops)
    if config.crops.split == "blocks":
        lines.append(
            f"{100 * (1 - shares['test'] / 0.1):.0f} % of val and test buildings are within "
            f"{config.crops.guard_m:g} m of another split and are not used"
        )
    dataset, pairs = config.dataset, sum(work.pairs.values())
    if dataset.num_pairs and round(pairs) < dataset.num_pairs:
        lines.append(f"TOO FEW pairs: {pairs:,.0f} of the {dataset.num_pairs:,} of dataset.num_pairs")
    wanted = dataset.num_lidar_dvae + dataset.num_lidar_test
    if round(work.num_real) < wanted:
        lines.append(f"TOO FEW real clouds: {work.num_real:,.0f} of {wanted:,}")
    lines += dict.fromkeys(f"{download.product} to download: {download.basis}" for download in downloads)
    if any(download.product == "LiDAR" for download in downloads):
        lines.append(
            f"a job with real LiDAR needs {_MEMORY_PER_LAZ_MB} times the size of its LAZ file as memory, "
            "and prepared clouds are as large as those downloaded"
        )
    lines += sorted({f"costs: {cost.source}" for cost in costs})
    return lines


def _rounded(value: float) -> float:
    """Three digits: the costs are not known better."""
    return float(f"{value:.3g}")
