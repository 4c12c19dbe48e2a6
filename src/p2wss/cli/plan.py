"""``p2wss plan``: what a config will cost."""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

from p2wss.cli.common import Parsers
from p2wss.config import Config, dataset_name, load, member_places, place_config
from p2wss.errors import InputError
from p2wss.storage import files, integrity


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss plan`` to the parser."""
    command = stages.add_parser(
        "plan",
        help="estimate jobs, hours, disk and memory of a config",
        description="Estimate what a config needs before anything runs: tiles, jobs, buildings, CPU-hours, "
        "GPU-hours, disk, downloads and memory, from measured costs. Sends no request.",
    )
    command.add_argument(
        "--configfile",
        type=Path,
        nargs="+",
        default=[],
        metavar="YAML",
        help="configs as for snakemake; later ones override earlier ones (default: the miniature)",
    )
    command.add_argument("--json", action="store_true", help="print JSON instead of a table")
    command.add_argument(
        "--pin",
        type=Path,
        metavar="YAML",
        help="write a config that names all tiles, for use as the last --configfile of snakemake",
    )
    command.add_argument(
        "--costs",
        type=Path,
        default=Path("config/costs.csv"),
        help="table of measured costs (default: config/costs.csv)",
    )
    command.set_defaults(run=plan)


def plan(arguments: argparse.Namespace) -> None:
    """Print the estimate, and write the pinned config if asked for."""
    import yaml

    from p2wss.plan import costs, estimate

    config = load(*arguments.configfile)
    regions, downloads = _regions_and_downloads(config)
    result = estimate.estimate(config, regions, costs.read_costs(arguments.costs), downloads)
    print(json.dumps(estimate.to_json(result), indent=1) if arguments.json else estimate.to_text(result))
    if arguments.pin is not None:
        names = " ".join(map(str, arguments.configfile))
        head = f"# the tiles of {names or 'the miniature'}, as p2wss plan counts them\n"
        text = yaml.safe_dump(
            estimate.pinned(config, regions), sort_keys=False, default_flow_style=None, width=120
        )
        files.write_text(arguments.pin, head + text)


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
