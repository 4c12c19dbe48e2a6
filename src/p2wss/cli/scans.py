"""``p2wss scans``: simulate the LiDAR survey of one scene."""

from pathlib import Path

import click

from p2wss.cli.common import config_option, log, threads_option
from p2wss.cli.parser import Command, file_option
from p2wss.config import Config, section_json
from p2wss.storage import files
from p2wss.storage.messages import InputError
from p2wss.storage.provenance import fingerprint


@click.command(cls=Command)
@file_option("--scene", "GeoParquet written by p2wss scenes cut")
@file_option("--dtm", "GeoTIFF written by p2wss scenes cut")
@file_option("--buildings", "Parquet written by p2wss buildings for the same tile")
@file_option("--out", "LAZ file to write")
@file_option("--out-survey", "JSON to write: parameters of the survey, and counts")
@file_option("--picture", "PNG to write: a part of the scan by building and by strip", required=False)
@threads_option
@config_option
def scans(
    scene: Path,
    dtm: Path,
    buildings: Path,
    out: Path,
    out_survey: Path,
    picture: Path | None,
    threads: int,
    config: Config,
) -> None:
    """Simulate the LiDAR survey of one scene."""
    import pyproj

    from p2wss.data.crs import check_crs
    from p2wss.data.terrain import read_terrain
    from p2wss.scans.scan import simulate, write_scan
    from p2wss.storage.schemas.buildings import BUILDINGS

    facts = files.read_metadata(scene)
    table = files.read_table(buildings, BUILDINGS)
    buildings_facts = files.read_metadata(buildings)
    if any(buildings_facts.get(name, "") != facts.get(name, "") for name in ("place", "tile")):
        raise InputError(f"{buildings}: is not of tile {facts['tile']}, unlike {scene}")
    terrain, dtm_crs = read_terrain(dtm)
    crs = pyproj.CRS.from_user_input(facts["crs"])
    check_crs(dtm_crs, crs, dtm, "the buildings are", "reproject it")
    scan = simulate(table, terrain, facts["tile"], facts["tile_size_m"], config.scans, threads=threads)
    bare = scan.facts["buildings_on_nodata"]
    if bare:
        log.warning(
            f"{dtm}: no data under {len(bare)} buildings (the first is {bare[0]}); they get no ground points"
        )
    survey = scan.facts["survey"]
    log.info(
        f"{out.name}: {survey['pattern']} scan, {len(survey['strips'])} strips, "
        f"{scan.facts['num_points']} points, {scan.facts['points_per_m2']:.1f} points per m2 "
        f"of {survey['density_per_m2']:.1f} pulses requested"
    )
    write_scan(out, scan, crs, threads=threads)
    provenance = files.provenance(
        tile=facts["tile"], crs=facts["crs"], config=section_json(config, "scans"), code=fingerprint("scans")
    )
    files.write_json(out_survey, scan.facts | provenance)
    if picture:
        from p2wss.scans.picture import densest_place, scan_figure

        with files.atomic(picture, seal=True) as temporary:
            scan_figure(scan.points, densest_place(scan.points)).savefig(temporary, dpi=110)
