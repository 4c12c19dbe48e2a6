"""``p2wss scans``: simulate the LiDAR survey of one scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from p2wss.cli.common import Parsers, add_command, add_threads, log, read_config
from p2wss.config import section_json
from p2wss.errors import InputError
from p2wss.provenance import fingerprint
from p2wss.storage import files, integrity


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss scans`` to the parser."""
    command = add_command(stages, "scans", scans, "simulate the LiDAR survey of one scene")
    command.add_argument("--scene", type=Path, required=True, help="GeoParquet written by p2wss scenes cut")
    command.add_argument("--dtm", type=Path, required=True, help="GeoTIFF written by p2wss scenes cut")
    command.add_argument(
        "--buildings", type=Path, required=True, help="Parquet written by p2wss buildings for the same tile"
    )
    command.add_argument("--out", type=Path, required=True, help="LAZ file to write")
    command.add_argument(
        "--out-survey", type=Path, required=True, help="JSON to write: parameters of the survey, and counts"
    )
    command.add_argument(
        "--picture", type=Path, help="PNG to write: a part of the scan by building and by strip"
    )
    add_threads(command)


def scans(arguments: argparse.Namespace) -> None:
    """Write a simulated scan, its survey and optionally a picture of it."""
    import pyproj

    from p2wss import scans
    from p2wss.data.terrain import read_terrain
    from p2wss.storage.schemas.buildings import BUILDINGS

    config = read_config(arguments)
    facts = files.read_metadata(arguments.scene)
    table = files.read_table(arguments.buildings, BUILDINGS)
    buildings_facts = files.read_metadata(arguments.buildings)
    if any(buildings_facts.get(name, "") != facts.get(name, "") for name in ("place", "tile")):
        raise InputError(f"{arguments.buildings}: is not of tile {facts['tile']}, unlike {arguments.scene}")
    terrain, dtm_crs = read_terrain(arguments.dtm)
    crs = pyproj.CRS.from_user_input(facts["crs"])
    scans.check_dtm_crs(dtm_crs, crs, arguments.dtm)
    scan = scans.simulate(
        table, terrain, facts["tile"], facts["tile_size_m"], config.scans, threads=arguments.threads
    )
    bare = scan.facts["buildings_on_nodata"]
    if bare:
        log.warning(
            f"{arguments.dtm}: no data under {len(bare)} buildings (the first is {bare[0]}); they get no ground points"
        )
    survey = scan.facts["survey"]
    log.info(
        f"{arguments.out.name}: {survey['pattern']} scan, {len(survey['strips'])} strips, "
        f"{scan.facts['num_points']} points, {scan.facts['points_per_m2']:.1f} points per m2 "
        f"of {survey['density_per_m2']:.1f} pulses requested"
    )
    scans.write_scan(arguments.out, scan, crs, threads=arguments.threads)
    provenance = files.provenance(
        tile=facts["tile"], crs=facts["crs"], config=section_json(config, "scans"), code=fingerprint("scans")
    )
    files.write_json(arguments.out_survey, scan.facts | provenance)
    if arguments.picture:
        from p2wss.scans.picture import densest_place, scan_figure

        with files.atomic(arguments.picture) as temporary:
            scan_figure(scan.points, densest_place(scan.points)).savefig(temporary, dpi=110)
            integrity.append(temporary)
