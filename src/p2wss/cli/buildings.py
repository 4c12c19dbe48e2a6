"""``p2wss buildings``: closed meshes of the buildings of one scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from p2wss.cli.common import Parsers, add_command, log_status_counts, read_config
from p2wss.config import section_json
from p2wss.errors import InputError
from p2wss.provenance import fingerprint
from p2wss.storage import files


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss buildings`` to the parser."""
    command = add_command(stages, "buildings", buildings, "build the closed meshes of one scene")
    command.add_argument("--scene", type=Path, required=True, help="GeoParquet written by p2wss scenes cut")
    command.add_argument(
        "--out", type=Path, required=True, help="Parquet to write: parameters and meshes of the buildings"
    )


def buildings(arguments: argparse.Namespace) -> None:
    """Write the parameters and meshes of the buildings of a scene."""
    import numpy as np

    from p2wss.buildings import build_scene, failed_fraction
    from p2wss.storage.schemas.buildings import BUILDINGS
    from p2wss.storage.schemas.scene import read_scene

    config = read_config(arguments)
    scene, facts = read_scene(arguments.scene)
    columns = build_scene(scene, config.buildings)
    status = columns["status"]
    log_status_counts(arguments.out, status)
    failed = failed_fraction(scene["status"].to_numpy(), status)
    if failed > config.buildings.max_failed_fraction:
        raise InputError(
            f"{arguments.scene}: {failed:.1%} of its buildings were rejected, more than "
            f"buildings.max_failed_fraction {config.buildings.max_failed_fraction:.1%}; "
            "the reasons are listed above"
        )
    metadata = files.provenance(
        **{name: facts[name] for name in ("tile", "tile_size_m", "margin_m", "crs")},
        place=facts.get("place", ""),
        config=section_json(config, "buildings"),
        code=fingerprint("buildings"),
        num_by_status=dict(
            zip(*(a.tolist() for a in np.unique(status.astype(str), return_counts=True)), strict=True)
        ),
    )
    files.write_table(arguments.out, columns, BUILDINGS, metadata)
