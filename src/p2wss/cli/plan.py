"""``p2wss plan``: what a config will cost."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import click

from p2wss.cli.parser import PATH, Command, option
from p2wss.config import Config, dataset_name, load, member_places, place_config
from p2wss.errors import InputError
from p2wss.storage import files, integrity


@click.command(cls=Command)
@option(
    "--config",
    "documents",
    multiple=True,
    metavar="FILE|JSON",
    help="configs as for snakemake --configfile; may be repeated, and later ones win (default: the miniature)",
)
@option("--json", "as_json", is_flag=True, help="print JSON instead of a table")
@option(
    "--pin",
    type=PATH,
    metavar="YAML",
    help="write a config that names all tiles, for use as the last --configfile of snakemake",
)
@option(
    "--costs",
    type=PATH,
    default="config/costs.csv",
    help="table of measured costs (default: config/costs.csv)",
)
def plan(documents: tuple[str, ...], as_json: bool, pin: Path | None, costs: Path) -> None:
    """Estimate what a config needs before anything runs.

    Tiles, jobs, buildings, CPU-hours, GPU-hours, disk, downloads and memory, from measured costs. Sends no request.
    """
    import yaml

    from p2wss.plan import estimate
    from p2wss.plan.costs import read_costs

    config = load(*documents)
    regions, downloads = _regions_and_downloads(config)
    result = estimate.estimate(config, regions, read_costs(costs), downloads)
    print(json.dumps(result, indent=1) if as_json else estimate.to_text(result))
    if pin is not None:
        names = " ".join(documents)
        head = f"# the tiles of {names or 'the miniature'}, as p2wss plan counts them\n"
        text = yaml.safe_dump(
            estimate.pinned(config, regions), sort_keys=False, default_flow_style=None, width=120
        )
        files.write_text(pin, head + text)


def _regions_and_downloads(config: Config) -> tuple[list[Any], list[Any]]:
    """The tiles of each member with the buildings that the stage scenes has counted, and the downloads."""
    from p2wss.fetch import plan as fetch_plan
    from p2wss.plan.estimate import Download
    from p2wss.plan.work import Region

    counts = _counted_buildings(Path("results", dataset_name(config), "scenes/index.tsv"))
    regions, downloads = [], []
    for place in member_places(config):
        member = place_config(config, place)
        regions.append(Region(fetch_plan.tiles(member), fetch_plan.lidar_tiles(member), counts.get(place)))
        downloads += [
            Download(
                part.product,
                part.size_mb,
                part.size_mb / part.num_files if part.product == "LiDAR" else 0.0,
                part.basis,
            )
            for part in fetch_plan.estimate_downloads(member)
            if part.num_files
        ]
    return regions, downloads


def _counted_buildings(path: Path) -> dict[str, dict[str, int]]:
    """Buildings per place and tile, from the index of the stage scenes; empty if it has not run."""
    counts: dict[str, dict[str, int]] = {}
    if not path.is_file():
        return counts
    try:
        for row in csv.DictReader(integrity.read_lines(path), delimiter="\t"):
            counts.setdefault(row["place"], {})[row["tile"]] = int(row["num_buildings"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not an index of the stage scenes; delete it") from error
    return counts
