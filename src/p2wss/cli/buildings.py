"""``p2wss buildings``: closed meshes of the buildings of one scene."""

from collections import Counter
from pathlib import Path

import click

from p2wss.cli.common import check_failures, config_option, log_status_counts
from p2wss.cli.parser import Command, file_option
from p2wss.config import Config, section_json
from p2wss.storage import files
from p2wss.storage.provenance import fingerprint


@click.command(cls=Command)
@file_option("--scene", "GeoParquet written by p2wss scenes cut")
@file_option("--out", "Parquet to write: parameters and meshes of the buildings")
@config_option
def buildings(scene: Path, out: Path, config: Config) -> None:
    """Build the closed meshes of one scene."""
    from p2wss.scenes.buildings import build_scene
    from p2wss.storage.schemas.buildings import BUILDINGS
    from p2wss.storage.schemas.scene import read_scene

    table, facts = read_scene(scene)
    columns = build_scene(table, config.buildings)
    status = columns["status"]
    log_status_counts(out, status)
    built = status[table["status"].to_numpy() == "ok"]
    check_failures(scene, "its buildings were rejected", built, "buildings", config)
    metadata = files.provenance(
        **{name: facts[name] for name in ("tile", "tile_size_m", "margin_m", "crs")},
        place=facts.get("place", ""),
        config=section_json(config, "buildings"),
        code=fingerprint("scenes.buildings"),
        num_by_status=dict(sorted(Counter(status.tolist()).items())),
    )
    files.write_table(out, columns, BUILDINGS, metadata)
