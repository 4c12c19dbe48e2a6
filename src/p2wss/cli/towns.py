"""``p2wss towns``: a synthetic town in IGN's file formats."""

from __future__ import annotations

from pathlib import Path

import click

from p2wss.cli.common import log
from p2wss.cli.parser import Command, file_option, option
from p2wss.storage import files

ROOFS = "roofs/roofs.city.jsonl"


@click.command(cls=Command)
@option("--seed", type=int, required=True, help="seed of the town; each seed gives a different town")
@file_option("--out", "output folder, with bdtopo/, rgealti/, lidar/ and roofs/")
@option("--lidar", is_flag=True, help="also simulate stand-in LiDAR for tile 0653_6861")
@option(
    "--kind",
    type=click.Choice(["streets", "wings", "terraces", "old", "large"]),
    default="streets",
    show_default=True,
    help="wings: houses whose roofs consist of several bodies; terraces: rows of such houses; old: tall ones wall to "
    "wall; large: schools, convents, factories, .. of up to some 50 planes; all with their true roofs as CityJSON",
)
def towns(seed: int, out: Path, lidar: bool, kind: str) -> None:
    """Generate a synthetic town: footprints, terrain and stand-in LiDAR in IGN's file formats."""
    from p2wss.formats.cityjson import Metadata, Solid, lines
    from p2wss.towns import write_town
    from p2wss.towns.ign import building_id
    from p2wss.towns.site import CRS
    from p2wss.towns.wings import true_solids

    town = write_town(out, seed, lidar, kind)
    if kind != "streets":
        solids = [
            Solid.of_triangles(building_id(index), *corners, {"shape": building.kind})
            for index, (building, corners) in enumerate(zip(town, true_solids(town), strict=True))
        ]
        metadata = Metadata(int(CRS.removeprefix("EPSG:")))
        files.write_text(out / ROOFS, "\n".join(lines(solids, metadata)) + "\n")
    log.info(f"{out}: town {seed} with {len(town)} buildings")
