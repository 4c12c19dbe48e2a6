"""The command line: one sub-command per stage, each a few lines that read files, call the stage and write files.

Heavy modules are imported inside the commands, so that ``p2wss --help`` answers at once. Everything here is
glue: what decides a result belongs in the stage's module.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from p2wss import __version__, io
from p2wss.config import OUTPUT_SUFFIXES, Config, load, section_json
from p2wss.errors import InputError
from p2wss.provenance import fingerprint
from p2wss.tiling import Bounds, tile_bounds, tiles_of_bounds

DEVICES = ("auto", "cpu", "cuda")
Command = Callable[[argparse.Namespace], None]
log = logging.getLogger("p2wss")


def main(arguments: list[str] | None = None) -> int:
    """Run one sub-command. Returns the exit status: 0, or 2 for input that the user can mend."""
    parsed = _parser().parse_args(arguments)
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(message)s")
    # what laspy logs of a broken file it raises too, which becomes the one line below
    logging.getLogger("laspy").setLevel(logging.CRITICAL)
    logging.getLogger("pyogrio").setLevel(logging.WARNING)  # it reports every file that it writes
    try:
        parsed.run(parsed)
    except InputError as error:
        print(f"p2wss: error: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="p2wss", description="Footprints and LiDAR to watertight LoD2 buildings."
    )
    parser.add_argument("--version", action="version", version=f"p2wss {__version__}")
    stages = parser.add_subparsers(title="stages, in order", required=True, metavar="STAGE")

    fetch = _fetch_group(stages)
    command = _command(fetch, "footprints", fetch_footprints, "footprints of the region")
    command.add_argument("out", type=Path, help="footprints.gpkg")
    _downloads(command)
    command = _command(fetch, "dtm", fetch_dtm, "terrain of one tile and its margin")
    command.add_argument("tile", help="name of the tile, such as 0652_6862")
    command.add_argument("out", type=Path, help="GeoTIFF, float32, NaN where there is no data")
    _downloads(command)
    command = _command(fetch, "lidar", fetch_lidar, "LiDAR of one tile, as delivered")
    command.add_argument("tile", help="name of the tile, such as 0652_6862")
    command.add_argument("out", type=Path, help="LAZ or COPC")
    _downloads(command)
    command = _command(fetch, "prepare", fetch_prepare, "LiDAR of one tile, cropped and with ground points")
    command.add_argument("tile", help="name of the tile, such as 0652_6862")
    command.add_argument("out", type=Path, help="LAZ; where PDAL was run its pipeline stands beside it")
    command.add_argument("clouds", type=Path, nargs="+", help="TILE.laz of the tile and of its neighbours")

    scenes = _group(stages, "scenes", "cut tiles, clean footprints, draw roofs")
    command = _command(scenes, "index", scenes_index, "count buildings per tile")
    command.add_argument("footprints", type=Path)
    command.add_argument("out", type=Path, help="TSV: tile, num_buildings")
    command = _command(scenes, "cut", scenes_cut, "one tile with its margin")
    command.add_argument("tile", help="name of the tile, such as 0652_6862")
    command.add_argument("footprints", type=Path)
    command.add_argument("dtm", type=Path)
    command.add_argument("out", type=Path, help="GeoParquet of buildings")
    command.add_argument("out_dtm", type=Path, help="GeoTIFF, the terrain under the scene")

    command = _command(stages, "buildings", buildings, "parametric buildings of one scene")
    command.add_argument("scene", type=Path)
    command.add_argument("out", type=Path, help="Parquet of parameters and meshes")

    command = _command(stages, "scans", scans, "LiDAR survey of one scene")
    command.add_argument("scene", type=Path)
    command.add_argument("dtm", type=Path)
    command.add_argument("buildings", type=Path)
    command.add_argument("out", type=Path, help="LAZ")
    command.add_argument("out_survey", type=Path, help="JSON: parameters of the survey and counts")
    command.add_argument(
        "--picture", type=Path, default=None, help="PNG of a part of it, by building, strip and return"
    )
    command.add_argument("--threads", type=int, default=1)

    crops = _group(stages, "crops", "points of each building")
    command = _command(crops, "scene", crops_scene, "from a simulated scan, with labels")
    command.add_argument("buildings", type=Path)
    command.add_argument("scan", type=Path)
    command.add_argument("out", type=Path, help="Parquet shard")
    command = _command(crops, "lidar", crops_lidar, "from real LiDAR, without labels")
    command.add_argument("tile", help="buildings of this tile")
    command.add_argument("footprints", type=Path)
    command.add_argument("out", type=Path, help="Parquet shard")
    command.add_argument("clouds", type=Path, nargs="+", help="LAS, LAZ or COPC")
    command = _command(crops, "manifest", crops_manifest, "list shards, with hashes and splits")
    command.add_argument("out", type=Path, help="manifest.json")
    command.add_argument("--scenes", type=Path, nargs="*", default=[], help="shards of simulated scans")
    command.add_argument("--lidar", type=Path, nargs="*", default=[], help="shards of real LiDAR")

    command = _command(stages, "dvae", dvae, "train the point tokenizer")
    command.add_argument("manifest", type=Path)
    command.add_argument("out", type=Path, help="model.safetensors")
    command.add_argument("out_metrics", type=Path, help="metrics.jsonl")
    _training(command)

    command = _command(stages, "model", model, "train Point2WSS")
    command.add_argument("manifest", type=Path)
    command.add_argument("dvae", type=Path)
    command.add_argument("out", type=Path, help="model.safetensors")
    command.add_argument("out_metrics", type=Path, help="metrics.jsonl")
    _training(command)

    evaluate = _group(stages, "eval", "tables, figures, report")
    command = _command(
        evaluate, "predict", eval_predict, "reconstruct test split and real LiDAR with the model"
    )
    command.add_argument("manifest", type=Path)
    command.add_argument("model", type=Path)
    command.add_argument("out", type=Path, help="Parquet of reconstructions")
    command.add_argument("out_parameters", type=Path, help="JSON: errors of Table 1")
    command.add_argument("out_cpu", type=Path, help="JSON: CPU time per building")
    command.add_argument("--threads", type=int, default=1)
    command.add_argument("--device", choices=DEVICES, default="auto")
    command = _command(evaluate, "refine", eval_refine, "fit the same buildings to their points")
    command.add_argument("manifest", type=Path)
    command.add_argument("out", type=Path, help="Parquet of reconstructions")
    command.add_argument("out_cpu", type=Path, help="JSON: CPU time per building")
    command.add_argument(
        "--predictions", type=Path, default=None, help="begin with the network's; default: from nothing"
    )
    command = _command(evaluate, "baseline", eval_baseline, "reconstruct the same buildings with a baseline")
    command.add_argument("name", help="lod1, constant or roofer")
    command.add_argument("manifest", type=Path)
    command.add_argument("out", type=Path, help="Parquet of reconstructions")
    command.add_argument("out_cpu", type=Path, help="JSON: CPU time per building")
    command = _command(
        evaluate, "measure", eval_measure, "Chamfer distance, triangles, .. of every reconstruction"
    )
    command.add_argument("manifest", type=Path)
    command.add_argument("out", type=Path, help="Parquet, one row per building and method")
    command.add_argument("reconstructions", type=Path, nargs="+")
    command = _command(evaluate, "ablation", eval_ablation, "the table of the ablation, on the test split")
    command.add_argument("manifest", type=Path)
    command.add_argument("out_csv", type=Path)
    command.add_argument("out_markdown", type=Path)
    command.add_argument("models", type=Path, nargs="+", help="VARIANT/model.safetensors")
    command.add_argument("--threads", type=int, default=1)
    command.add_argument("--device", choices=DEVICES, default="auto")
    command = _command(evaluate, "report", eval_report, "the report")
    command.add_argument("out", type=Path, help="folder: report.html and its tables as CSV and LaTeX")
    command.add_argument("--manifest", type=Path, required=True)
    command.add_argument("--measures", type=Path, required=True)
    command.add_argument("--parameters", type=Path, required=True)
    command.add_argument("--reconstructions", type=Path, nargs="+", required=True)
    command.add_argument("--cpu", type=Path, nargs="*", default=[], help="JSON: CPU time per building")
    command.add_argument(
        "--metrics", type=Path, nargs="*", required=True, help="metrics.jsonl of dvae and model"
    )
    command.add_argument("--scans", type=Path, nargs="*", default=[], help="PNGs of simulated scans")

    command = _command(stages, "reconstruct", reconstruct, "buildings from your own LiDAR and footprints")
    command.add_argument("clouds", type=Path, nargs="+", metavar="CLOUD", help="LAS, LAZ or COPC")
    command.add_argument("footprints", type=Path, help="any vector file, in the CRS of the clouds")
    command.add_argument("out", type=Path, help="folder")
    command.add_argument(
        "--model",
        type=Path,
        default=None,
        help="model.safetensors; none: fit only; default: the weights that came with p2wss, if any",
    )
    command.add_argument("--no-refine", action="store_true", help="leave the network's values as they are")
    command.add_argument(
        "--id-field", default=None, help="column of building ids; default: the usual names, else a number"
    )
    command.add_argument(
        "--crs", default=None, help="of the clouds, where their headers tell none, such as EPSG:28992"
    )
    command.add_argument(
        "--tile", default=None, help="only the buildings of this tile, whose name the outputs get"
    )
    command.add_argument(
        "--format",
        default=None,
        metavar="A,B,..",
        help=f"what to write: {', '.join(OUTPUT_SUFFIXES)}; default: reconstruct.outputs of the config",
    )
    command.add_argument("--per-building", action="store_true", help="meshes one by one too, in a folder")
    command.add_argument(
        "--terrain", type=Path, default=None, help="raster of heights: meshes stand in a closed block of it"
    )
    command.add_argument("--threads", type=int, default=1)
    command.add_argument("--device", choices=DEVICES, default="auto")

    about = "what a file holds: ours, and those of IGN"
    command = stages.add_parser("inspect", help=about, description=about)
    command.add_argument("files", type=Path, nargs="+", metavar="FILE")
    command.add_argument("--json", action="store_true", help="one line of JSON per file")
    command.set_defaults(run=inspect)
    return parser


def _fetch_group(stages: argparse._SubParsersAction) -> argparse._SubParsersAction:
    """``p2wss fetch PART ..`` for the workflow, ``p2wss fetch --bbox ..`` for people."""
    about = "get footprints, terrain and LiDAR of the region"
    parser = stages.add_parser("fetch", help=about, description=about)
    parser.add_argument(
        "--bbox",
        type=float,
        nargs=4,
        metavar=("X_MIN", "Y_MIN", "X_MAX", "Y_MAX"),
        help="a new region: metres in --crs, rounded outwards to whole tiles",
    )
    parser.add_argument("--region", metavar="NAME", help="its name; of a region there is without --bbox")
    parser.add_argument("--vintage", default="", help="names resources/ign/VINTAGE; default: this year")
    parser.add_argument("--crs", default="EPSG:2154", help="of the region; default: Lambert-93")
    parser.add_argument("--lidar", nargs="*", default=[], metavar="TILE", help="tiles whose LiDAR is wanted")
    parser.add_argument(
        "--dry-run", action="store_true", help="only show what would be downloaded; no request, no file"
    )
    parser.set_defaults(run=fetch_region)
    return parser.add_subparsers(metavar="PART")


def _downloads(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--downloads",
        type=Path,
        help="folder of what was downloaded; default: resources/ign/VINTAGE/downloads",
    )
    command.add_argument(
        "--offline", type=int, choices=(0, 1), help="1: send no request; default: fetch.offline of the config"
    )


def _group(stages: argparse._SubParsersAction, name: str, about: str) -> argparse._SubParsersAction:
    parser = stages.add_parser(name, help=about, description=about)
    return parser.add_subparsers(required=True, metavar="PART")


def _command(
    group: argparse._SubParsersAction, name: str, run: Command, about: str
) -> argparse.ArgumentParser:
    parser = group.add_parser(name, help=about, description=about)
    parser.add_argument(
        "--config", default="{}", help="a YAML file, or sections as JSON; default: the built-in values"
    )
    parser.set_defaults(run=run)
    return parser


def _training(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--checkpoints", type=Path, required=True, help="folder to resume from; kept until the end"
    )
    command.add_argument("--threads", type=int, default=1)
    command.add_argument("--device", choices=DEVICES, help="default: compute.device of the config")


def _use_threads(num_threads: int) -> None:
    """Before torch is imported: on shared cores OpenMP threads that spin make small operations 40 times slower."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
    import torch

    torch.set_num_threads(num_threads)


def _config(arguments: argparse.Namespace) -> Config:
    return load(arguments.config)


# --- fetch ---


def fetch_region(arguments: argparse.Namespace) -> None:
    import yaml

    from p2wss.fetch import plan

    if arguments.region is None:
        raise InputError("fetch: give --region NAME, and --bbox for a new one; p2wss fetch --help")
    path = Path("config/regions", f"{arguments.region}.yaml")
    if arguments.bbox is not None:
        text = plan.region_yaml(
            arguments.region, arguments.bbox, arguments.vintage, arguments.crs, arguments.lidar
        )
        config = load(yaml.safe_load(text))
    else:
        text, config = "", load(path)
    downloads = _downloads_of(config, None)
    needs = plan.needs(config, downloads)
    print(plan.table(config, needs))
    if arguments.dry_run:
        return
    if text:
        if path.exists():
            raise InputError(
                f"{path}: is there; take another name, or `p2wss fetch --region NAME` without --bbox"
            )
        io.write_text(path, text)
        print(f"{path} written")
    plan.download(config, downloads, log)
    print(f"everything is in {downloads}; now: snakemake -c2 eval_report --configfile {path}")


def fetch_footprints(arguments: argparse.Namespace) -> None:
    from p2wss.fetch import normalise, write_footprints
    from p2wss.tiling import grown

    config = _config(arguments)
    source = _source(config, arguments)
    found = source.footprints(grown(config.region.bounds_m, config.fetch.margin_m))
    frame = normalise(found, config.region.crs, source.name)
    if not len(frame):
        raise InputError(f"{source.name}: no building in region.bounds_m {config.region.bounds_m}")
    log.info(f"{arguments.out.name}: {len(frame)} buildings from {source.name}")
    write_footprints(arguments.out, frame, _fetched(config))


def fetch_dtm(arguments: argparse.Namespace) -> None:
    from p2wss.fetch import check_terrain
    from p2wss.terrain import write_terrain

    config = _config(arguments)
    source = _source(config, arguments)
    terrain = source.dtm(_tile_bounds(arguments.tile, config, config.fetch.margin_m))
    share = check_terrain(terrain, _tile_bounds(arguments.tile, config), f"terrain of tile {arguments.tile}")
    log.info(
        f"{arguments.out.name}: {terrain.height_m.shape} heights, {terrain.cell_m} m apart, {share:.1%} known"
    )
    write_terrain(arguments.out, terrain, config.region.crs, _fetched(config))


def fetch_lidar(arguments: argparse.Namespace) -> None:
    from p2wss.fetch import delivered, write_cloud

    config = _config(arguments)
    source = _source(config, arguments)
    paths = source.lidar(_tile_bounds(arguments.tile, config))
    around = _tile_bounds(arguments.tile, config, config.fetch.margin_m)
    crs, bounds = delivered(config.region, config.fetch, around)
    # files of the user's own are copied: they may be changed one day
    num_points = write_cloud(arguments.out, paths, bounds, crs, link=config.fetch.source != "folder")
    log.info(f"{arguments.out.name}: {num_points} points from {', '.join(path.name for path in paths)}")


def fetch_prepare(arguments: argparse.Namespace) -> None:
    from p2wss.fetch import delivered
    from p2wss.fetch.prepare import prepare

    config = _config(arguments)
    holes = [_tile_bounds(path.stem, config) for path in arguments.clouds[1:]]
    bounds = _tile_bounds(arguments.tile, config, config.fetch.margin_m)
    crs, _ = delivered(config.region, config.fetch, bounds)
    facts = prepare(
        arguments.out, arguments.clouds, bounds, holes, config.region.crs, crs, config.fetch.prepare
    )
    log.info(
        f"{arguments.out.name}: {', '.join(f'{name} {value}' for name, value in facts.items() if value)}"
    )


def _source(config: Config, arguments: argparse.Namespace) -> Any:
    from p2wss.fetch import open_source

    offline = config.fetch.offline if arguments.offline is None else bool(arguments.offline)
    fetch = config.fetch.model_copy(update={"offline": offline})
    return open_source(config.region, fetch, _downloads_of(config, arguments.downloads))


def _downloads_of(config: Config, folder: Path | None) -> Path:
    return folder or Path("resources/ign", config.region.vintage, "downloads")


def _tile_bounds(tile: str, config: Config, margin_m: float = 0.0) -> Bounds:
    try:
        return tile_bounds(tile, config.region.tile_size_m, margin_m)
    except ValueError as error:
        raise InputError(str(error)) from error


def _fetched(config: Config) -> dict[str, Any]:
    return io.provenance(
        vintage=config.region.vintage,
        crs=config.region.crs,
        config=section_json(config, "region", "fetch"),
        code=fingerprint("fetch"),
    )


# --- scenes ---


def scenes_index(arguments: argparse.Namespace) -> None:
    from p2wss.scenes import count_buildings, read_footprints

    config = _config(arguments)
    counts = count_buildings(
        read_footprints(arguments.footprints), config.region.tile_size_m, config.scenes.min_area_m2
    )
    inside = set(tiles_of_bounds(config.region.bounds_m, config.region.tile_size_m))
    rows = [f"{tile}\t{number}\n" for tile, number in counts.items() if tile in inside]
    log.info(f"{arguments.out.name}: {len(rows)} tiles with buildings")
    with io.atomic(arguments.out) as temporary:
        temporary.write_text("tile\tnum_buildings\n" + "".join(rows))


def scenes_cut(arguments: argparse.Namespace) -> None:
    from p2wss.clouds import same_crs
    from p2wss.scenes import NEIGHBOUR_M, cut_scene, failed_fraction, read_footprints
    from p2wss.terrain import read_terrain, write_terrain

    config = _config(arguments)
    tile, tile_size_m, margin_m = arguments.tile, config.region.tile_size_m, config.scenes.margin_m
    frame = read_footprints(arguments.footprints, bounds=_tile_bounds(tile, config, margin_m + NEIGHBOUR_M))
    terrain, dtm_crs = read_terrain(arguments.dtm)
    if not same_crs(dtm_crs, frame.crs):
        raise InputError(
            f"{arguments.dtm}: is in {dtm_crs.name}, but {arguments.footprints} in {frame.crs.name}"
        )
    scene = cut_scene(frame, terrain, tile, tile_size_m, config.scenes)
    if not scene["in_tile"].any():
        raise InputError(f"{arguments.footprints}: no building in tile {tile}; take it out of region.tiles")
    _report(log, arguments.out, scene["status"][scene["in_tile"]])
    failed = failed_fraction(scene)
    if failed > config.scenes.max_failed_fraction:
        raise InputError(
            f"tile {tile}: {failed:.1%} of its footprints in {arguments.footprints} were left out, more than "
            f"scenes.max_failed_fraction {config.scenes.max_failed_fraction:.1%}; the reasons are above"
        )
    metadata = io.provenance(
        tile=tile,
        tile_size_m=tile_size_m,
        margin_m=margin_m,
        crs=config.region.crs,
        config=section_json(config, "region", "scenes"),
        code=fingerprint("scenes"),
        num_by_status=dict(sorted(Counter(scene["status"][scene["in_tile"]]).items())),
    )
    window = terrain.cut(_tile_bounds(tile, config, margin_m))
    write_terrain(arguments.out_dtm, window, config.region.crs, metadata)
    io.write_scene(arguments.out, scene, metadata)


# --- buildings ---


def buildings(arguments: argparse.Namespace) -> None:
    import numpy as np

    from p2wss.buildings import build_scene, failed_fraction

    config = _config(arguments)
    scene, facts = io.read_scene(arguments.scene)
    columns = build_scene(scene, config.buildings)
    status = columns["status"]
    _report(log, arguments.out, status)
    failed = failed_fraction(scene["status"].to_numpy(), status)
    if failed > config.buildings.max_failed_fraction:
        raise InputError(
            f"{arguments.scene}: {failed:.1%} of its buildings were rejected, more than "
            f"buildings.max_failed_fraction {config.buildings.max_failed_fraction:.1%}; the reasons are above"
        )
    metadata = io.provenance(
        **{name: facts[name] for name in ("tile", "tile_size_m", "margin_m", "crs")},
        config=section_json(config, "buildings"),
        code=fingerprint("buildings"),
        num_by_status=dict(
            zip(*(a.tolist() for a in np.unique(status.astype(str), return_counts=True)), strict=True)
        ),
    )
    io.write_table(arguments.out, columns, io.BUILDINGS, metadata)


def _report(log: logging.Logger, out: Path, status: Iterable[str]) -> None:
    """One line: how many rows are ok, and how many are not for which reason."""
    counts = Counter(map(str, status))
    num_ok = counts.pop("ok", 0)
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts.most_common()) or "none"
    log.info(f"{out.name}: {num_ok} buildings kept, {sum(counts.values())} rejected ({reasons})")


# --- scans ---


def scans(arguments: argparse.Namespace) -> None:
    import pyproj

    from p2wss import scans
    from p2wss.terrain import read_terrain

    config = _config(arguments)
    facts = io.read_metadata(arguments.scene)
    table = io.read_table(arguments.buildings, io.BUILDINGS)
    if io.read_metadata(arguments.buildings)["tile"] != facts["tile"]:
        raise InputError(f"{arguments.buildings}: is not of tile {facts['tile']}, as {arguments.scene} is")
    terrain, dtm_crs = read_terrain(arguments.dtm)
    crs = pyproj.CRS.from_user_input(facts["crs"])
    scans.check_dtm_crs(dtm_crs, crs, arguments.dtm)
    scan = scans.simulate(
        table, terrain, facts["tile"], facts["tile_size_m"], config.scans, threads=arguments.threads
    )
    bare = scan.facts["buildings_on_nodata"]
    if bare:
        log.warning(
            f"{arguments.dtm}: no data under {len(bare)} buildings, the first is {bare[0]}; no ground there"
        )
    survey = scan.facts["survey"]
    log.info(
        f"{arguments.out.name}: {survey['pattern']} scan, {len(survey['strips'])} strips, "
        f"{scan.facts['num_points']} points, {scan.facts['pulses_per_m2']:.1f} pulses per m2 "
        f"of {survey['density_per_m2']:.1f} pulses requested"
    )
    scans.write_scan(arguments.out, scan, crs, threads=arguments.threads)
    made_by = io.provenance(
        tile=facts["tile"], crs=facts["crs"], config=section_json(config, "scans"), code=fingerprint("scans")
    )
    io.write_json(arguments.out_survey, scan.facts | made_by)
    if arguments.picture:
        from p2wss.pictures import scan_figure

        with io.atomic(arguments.picture) as temporary:
            scan_figure(scan.points, scans.busiest_place(scan.points)).savefig(temporary, dpi=110)


# --- crops ---


def crops_scene(arguments: argparse.Namespace) -> None:
    from p2wss import crops

    config = _config(arguments)
    facts = io.read_metadata(arguments.buildings)
    table = io.read_table(arguments.buildings, io.BUILDINGS)
    if facts["margin_m"] < config.crops.guard_m:
        raise InputError(
            f"{arguments.buildings}: its margin of {facts['margin_m']} m is smaller than crops.guard_m "
            f"{config.crops.guard_m}; raise scenes.margin_m"
        )
    scan = crops.read_scan(arguments.scan)
    crops.check_crs(scan[0].crs, facts["crs"], str(arguments.scan))
    columns, left_out = crops.crop_scene(table, scan, config.crops)
    _write_crops(arguments.out, columns, left_out, facts["tile"], facts["crs"], section_json(config, "crops"))


def crops_lidar(arguments: argparse.Namespace) -> None:
    from p2wss import crops, scenes

    config = _config(arguments)
    tile_size_m = config.region.tile_size_m
    bounds = _tile_bounds(arguments.tile, config)
    frame = scenes.clean_footprints(
        scenes.read_footprints(arguments.footprints, bounds=bounds), config.scenes
    )
    columns, left_out = crops.crop_lidar(frame, arguments.clouds, arguments.tile, tile_size_m, config.crops)
    made_by = section_json(config, "region", "scenes", "crops")
    _write_crops(arguments.out, columns, left_out, arguments.tile, config.region.crs, made_by)


def _write_crops(
    out: Path, columns: dict[str, Any], left_out: Counter[str], tile: str, crs: str, config: str
) -> None:
    found = {reason: count for reason, count in left_out.items() if count}
    _report(log, out, ["ok"] * len(columns["num_points"]) + list(Counter(found).elements()))
    metadata = io.provenance(config=config, code=fingerprint("crops"), tile=tile, crs=crs, left_out=found)
    io.write_table(out, columns, io.CROPS, metadata)


def crops_manifest(arguments: argparse.Namespace) -> None:
    from p2wss import crops

    config = _config(arguments)
    shards = [(path, crops.SYNTHETIC) for path in arguments.scenes] + [
        (path, crops.LIDAR) for path in arguments.lidar
    ]
    listed = crops.list_shards(shards, arguments.out.parent)
    made_by = io.provenance(config=section_json(config, "crops"), code=fingerprint("crops"))
    io.write_json(arguments.out, listed | made_by)
    log.info(f"{arguments.out.name}: {listed['num_rows']} buildings, {listed['splits']}")


# --- dvae, model ---


def dvae(arguments: argparse.Namespace) -> None:
    _use_threads(arguments.threads)
    from p2wss import dvae, training

    config, code = _on_device(arguments, "dvae").dvae, fingerprint("dvae")
    module = dvae.train(arguments.manifest, config, arguments.checkpoints, code)
    if not training.writes():
        return
    metrics = training.read_metrics(arguments.checkpoints)
    io.write_text(arguments.out_metrics, metrics)
    dvae.save(module, arguments.out, config, code, metrics)
    training.remove_checkpoints(arguments.checkpoints)


def model(arguments: argparse.Namespace) -> None:
    _use_threads(arguments.threads)
    from p2wss import model, training

    config, code = _on_device(arguments, "model").model, fingerprint("model")
    module, dvae_config = model.train(arguments.manifest, arguments.dvae, config, arguments.checkpoints, code)
    if not training.writes():
        return
    metrics = training.read_metrics(arguments.checkpoints)
    io.write_text(arguments.out_metrics, metrics)
    model.save(module, arguments.out, config, dvae_config, code, metrics)
    training.remove_checkpoints(arguments.checkpoints)


def _on_device(arguments: argparse.Namespace, stage: str) -> Config:
    device = {} if arguments.device is None else {stage: {"compute": {"device": arguments.device}}}
    return load(arguments.config, device)


# --- eval ---


def eval_predict(arguments: argparse.Namespace) -> None:
    _use_threads(arguments.threads)
    from p2wss import model, training
    from p2wss.eval import cases, parameters, predict
    from p2wss.eval.clock import CpuClock

    config, clock = _config(arguments), CpuClock()
    predictor = model.load(arguments.model, arguments.device)
    manifest = cases.read_manifest(arguments.manifest)
    found = cases.test_cases(manifest)
    rows = predict.predict(found, predictor, config.reconstruct, clock)
    errors = parameters.masked_errors(found, rows, predictor, cases.train_medians(manifest))
    made_by = training.read_weights(arguments.model, "model")[1]
    weights = {name: made_by[name] for name in ("version", "code", "config", "dvae_config")}
    facts = _eval_facts(config, method=predict.NETWORK, status="ok", model=weights)
    io.write_json(arguments.out_parameters, errors | {"p2wss": facts})
    _write_reconstructions(arguments, found, rows, facts, clock)


def eval_refine(arguments: argparse.Namespace) -> None:
    from p2wss.eval import cases, predict
    from p2wss.eval.clock import CpuClock

    config, clock = _config(arguments), CpuClock()
    found = cases.test_cases(cases.read_manifest(arguments.manifest))
    known = None if arguments.predictions is None else cases.read_reconstructions(arguments.predictions)
    rows = predict.refine(found, known, config.reconstruct, clock)
    facts: dict[str, Any] = {"method": predict.FIT, "status": "ok"}
    if arguments.predictions is not None:
        begun = io.read_metadata(arguments.predictions)
        facts = {"method": predict.REFINED, "status": "ok", "model": begun.get("model")}
    _write_reconstructions(arguments, found, rows, _eval_facts(config, **facts), clock)


def eval_baseline(arguments: argparse.Namespace) -> None:
    from p2wss.eval import baselines, cases
    from p2wss.eval.clock import CpuClock

    config, clock = _config(arguments), CpuClock()
    manifest = cases.read_manifest(arguments.manifest)
    found = cases.test_cases(manifest)
    made, run = baselines.baseline(arguments.name, found, manifest, config.eval, config.reconstruct, clock)
    chosen = [case for case in found if case.key in made]
    rows = [made[case.key] for case in chosen]
    log.info("%s: %s", arguments.name, run["status"])
    _write_reconstructions(arguments, chosen, rows, _eval_facts(config, method=arguments.name, **run), clock)


def _write_reconstructions(
    arguments: argparse.Namespace, found: Any, rows: Any, facts: dict[str, Any], clock: Any
) -> None:
    from p2wss import inference

    columns = inference.columns(rows, [case.dataset for case in found])
    io.write_table(arguments.out, columns, io.RECONSTRUCTIONS, facts)
    io.write_json(arguments.out_cpu, {"method": facts["method"], "cpu_ms": clock.ms_per_building()})
    _report(log, arguments.out, columns["status"])


def eval_measure(arguments: argparse.Namespace) -> None:
    from p2wss.eval import cases, measure

    config = _config(arguments)
    found = cases.test_cases(cases.read_manifest(arguments.manifest))
    methods = [cases.read_reconstructions(path) for path in arguments.reconstructions]
    rows = cases.columns_of(measure.measure(found, methods, config.eval), io.MEASURES.names)
    io.write_table(arguments.out, rows, io.MEASURES, _eval_facts(config))
    log.info("%s: %d rows", arguments.out, len(rows["method"]))


def eval_ablation(arguments: argparse.Namespace) -> None:
    _use_threads(arguments.threads)
    from p2wss import ablation

    rows = ablation.measure(arguments.manifest, arguments.models, arguments.device)
    io.write_text(arguments.out_csv, ablation.csv(rows))
    io.write_text(arguments.out_markdown, ablation.markdown(rows))
    log.info("%s", ablation.markdown(rows))


def eval_report(arguments: argparse.Namespace) -> None:
    from p2wss import sources
    from p2wss.eval import report

    config = _config(arguments)
    named = sources.attribution(config, sources.read(config.fetch.sources))
    footer = {"attribution": [*named, *config.eval.attribution]}
    inputs = report.read(
        config.region.name,
        arguments.manifest,
        arguments.measures,
        arguments.parameters,
        arguments.reconstructions,
        arguments.cpu,
        arguments.metrics,
        config.eval.model_copy(update=footer),
        arguments.scans,
    )
    for name, text in report.documents(inputs).items():
        io.write_text(arguments.out / name, text)
    log.info("%s", arguments.out / "report.html")


def _eval_facts(config: Config, **facts: Any) -> dict[str, Any]:
    made_by = section_json(config, "eval", "reconstruct")
    return io.provenance(config=made_by, code=fingerprint("eval"), **facts)


# --- reconstruct ---


def reconstruct(arguments: argparse.Namespace) -> None:
    _use_threads(arguments.threads)
    from p2wss import clouds, exports, model, reconstruct, scenes
    from p2wss.terrain import read_terrain

    config = _reconstruct_config(arguments)
    weights = arguments.model or reconstruct.shipped_model()
    if str(weights) == "none":
        weights = None
    if weights is None and not config.reconstruct.refine:
        raise InputError("--no-refine needs a --model: without one, all there is is the fit")
    predictor = None if weights is None else model.load(weights)
    if predictor is not None and config.reconstruct.refine:
        predictor = predictor.of_views(1)
    terrain, terrain_crs = (None, None) if arguments.terrain is None else read_terrain(arguments.terrain)
    read = scenes.read_footprints(arguments.footprints, arguments.id_field, needs_crs=False)
    frame = scenes.clean_footprints(read, config.scenes)
    if arguments.tile is not None:
        frame = reconstruct.of_tile(frame, arguments.tile, config.region.tile_size_m)
    cloud = clouds.read_clouds(arguments.clouds, reconstruct.window(frame))
    names = (str(arguments.clouds[0]), str(arguments.footprints))
    crs, note = reconstruct.common_crs(cloud.crs, frame.crs, arguments.crs, names)
    if note:
        log.info("note: %s", note)
    if terrain_crs is not None:
        exports.check_terrain(terrain_crs, crs, arguments.terrain)
    by = "fitted to the points alone" if weights is None else f"model {weights}"
    log.info("%d footprints, %d points around them; %s", len(frame), len(cloud), by)
    stem = arguments.tile or reconstruct.output_stem(arguments.clouds[0])
    progress = reconstruct.Progress(log.info)
    results = reconstruct.run(frame, cloud, predictor, stem, config.reconstruct, progress)
    if arguments.tile is None:
        reconstruct.check_overlap(results, arguments.clouds[0], arguments.footprints)
    if terrain is not None and (note := exports.terrain_note(results, terrain)):
        log.info("note: %s", note)
    made_by = section_json(config, "scenes", "reconstruct")
    code = fingerprint("reconstruct", "exports")
    facts = io.provenance(config=made_by, code=code, crs=crs.to_string(), model=weights and weights.name)
    written = exports.write(arguments.out, stem, results, crs, facts, config.reconstruct, terrain)
    log.info("%s: %s", arguments.out, ", ".join(written))
    log.info("%s", reconstruct.summary(results))


def _reconstruct_config(arguments: argparse.Namespace) -> Config:
    """The config with what the command line says of its section ``reconstruct``."""
    said: dict[str, Any] = {}
    if arguments.no_refine:
        said["refine"] = False
    if arguments.format is not None:
        said["outputs"] = [name.strip() for name in arguments.format.split(",") if name.strip()]
        unknown = [name for name in said["outputs"] if name not in OUTPUT_SUFFIXES]
        if unknown or not said["outputs"]:
            told = f"no format {unknown[0]}" if unknown else "names no format"
            raise InputError(f"--format {arguments.format}: {told}; choose from {', '.join(OUTPUT_SUFFIXES)}")
    if arguments.per_building:
        said["per_building"] = True
    config = _config(arguments)
    return config.model_copy(update={"reconstruct": config.reconstruct.model_copy(update=said)})


# --- inspect ---


def inspect(arguments: argparse.Namespace) -> None:
    from p2wss import inspection

    for path in arguments.files:
        facts = inspection.describe(path)
        print(json.dumps(facts) if arguments.json else inspection.text(facts))


if __name__ == "__main__":
    sys.exit(main())
