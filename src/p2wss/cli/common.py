"""Shared by the commands: options, threads, checks of arguments and log lines."""

from __future__ import annotations

import logging
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired

import click
from typing_extensions import TypedDict

from p2wss.cli.parser import PATH, file_option, option, setting
from p2wss.config import OUTPUT_SUFFIXES, TABLES_AND_MODELS, Config
from p2wss.data import reasons
from p2wss.data.tiling import Bounds, tile_bounds
from p2wss.storage import files, integrity
from p2wss.storage.messages import InputError, first_of, log, reading, writing

if TYPE_CHECKING:
    import numpy as np

    from p2wss.reconstruction.scene import Scene

CITY = (".json", ".jsonl")
# share of footprints without points above which the cloud may be of another place
MAX_BARE_SHARE = 0.05

config_option = option(
    "--config",
    multiple=True,
    metavar="FILE|JSON",
    help="YAML file, or sections as JSON, over the defaults (p2wss config); may be repeated, later ones win",
)
place_option = option(
    "--place",
    default="",
    help="member and draw of the tile in a data set of several regions, such as paris/2/",
)
tile_option = option(
    "--tile", required=True, help="name of the tile: its north-west corner in kilometres, such as 0652_6862"
)
threads_option = option(
    "--threads",
    type=click.IntRange(min=1),
    default=1,
    metavar="N",
    show_default=True,
    help="number of CPU threads",
)
device_option = option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    more=True,
    help="where the network runs; auto: on a GPU if there is one",
)


def _set_level(context: click.Context, parameter: click.Parameter, value: int | None) -> None:
    if value:
        log.setLevel(value)


_level = {"expose_value": False, "callback": _set_level}
_quiet_option = option(
    "--quiet", "-q", flag_value=logging.WARNING, help="show warnings and errors only", **_level
)
_verbose_option = option(
    "--verbose",
    "-v",
    flag_value=logging.DEBUG,
    more=True,
    help="show each building, step and file, with times",
    **_level,
)


def log_options(command: Any) -> Any:
    """Add the options that say what a command shows on stderr."""
    return _quiet_option(_verbose_option(command))


crs_option = option("--crs", more=True, help="CRS of clouds that do not state it, such as EPSG:28992")
clouds_argument = click.argument(
    "clouds",
    type=PATH,
    nargs=-1,
    required=True,
    metavar="CLOUD ..",
    help="LAS, LAZ or COPC files, or folders of them",
)
inputs_argument = click.argument(
    "inputs",
    type=PATH,
    nargs=-1,
    required=True,
    metavar="CLOUD .. FOOTPRINTS",
    help="LAS, LAZ or COPC files, or folders of them; then a vector file with polygons, reprojected if it is in "
    "another CRS",
)
classes_option = setting("region.classes.preset", "--classes")
manifest_option = file_option("--manifest", "JSON written by p2wss crops manifest")
out_metrics_option = file_option("--out-metrics", "JSON lines to write: losses during training")
weights_option = file_option("--out", "safetensors file to write: the weights")
checkpoints_option = file_option(
    "--checkpoints",
    "folder for checkpoints; an interrupted training resumes from it, a finished one deletes it",
)


def write_trained(
    checkpoints: Path, out_metrics: Path, save: Callable[[str], None], extendable: bool = False
) -> None:
    """At the end of a training, write the metrics, write the weights with ``save(metrics)``, and remove the
    checkpoints. extendable: keep them, as another training may continue from them.

    Of several processes only the main one writes.
    """
    from p2wss.nets import distributed
    from p2wss.training.loop import METRICS_NAME, remove_checkpoints

    if not distributed.is_main_process():
        return
    path = checkpoints / METRICS_NAME
    with reading(path, "readable metrics; delete it"):
        metrics = path.read_text(encoding="utf-8")
    files.write_text(out_metrics, metrics + integrity.JSON_LINES_TRAILER)
    save(metrics)
    if not extendable:
        remove_checkpoints(checkpoints)


def write_run(
    out: Path,
    scene: Scene,
    start_s: float,
    formats: list[str] | None = None,
    name: str | None = None,
) -> int:
    """Write the files of a run that began at ``start_s``. Log the files, the numbers of buildings, which buildings to
    check, and what to do next.

    Returns the exit status: 1 if internal errors left out a file, or too many buildings.
    """
    listed = sums_of(out / f"{name or scene.name}.json")
    earlier = {path for path in (*listed["sha256"], *listed.get("earlier", ())) if (out / path).is_file()}
    written = scene.write(out, formats, name)
    content = files.read_json(written[-1], dict[str, Any])
    log.info("%s: %s", out, ", ".join([*content["files"], written[-1].name]))
    counts, wedges = content["buildings"], content["wedges"]
    more = "" if wedges is None else f", {wedges} wedges"
    size = f"{counts['triangles']} triangles{more}"
    log.info("%s; %s, in %.0f s", scene.summary, size, time.monotonic() - start_s)
    if left := sorted(earlier - content["sha256"].keys()):
        files.write_json(written[-1], content | {"earlier": left})
        log.warning("warning: %s: of an earlier run, not of this one: %s", out, first_of(left))
    if (num_bare := counts["without_points"]) > MAX_BARE_SHARE * counts["total"]:
        log.warning("warning: the cloud has no point at %d of %d footprints", num_bare, counts["total"])
    if to_check := counts["to_check"]:
        doubts = ", ".join(
            f"{count} {name.replace('-', ' ')}" for name, count in Counter(counts["doubts"]).most_common()
        )
        rest = counts["total"] - len(to_check)
        log.info("%d need no look, %d to check (%s): %s", rest, len(to_check), doubts, first_of(to_check))
    pages = [path for path in written if path.suffix == ".html"]
    if pages:
        log.info("open %s in a browser: buildings in 3D with their points, and a table", pages[0])
    if not content["errors"]:
        return 0
    failed, most = (
        counts["reasons"].get(reasons.INTERNAL_ERROR, 0),
        scene.config.reconstruct.max_failed_fraction,
    )
    text = "warning: internal errors at %d of %d buildings, in all at: %s; tracebacks: %s"
    log.warning(text, failed, counts["total"], first_of(content["errors"]), written[-2])
    if failed <= most * counts["total"] and content["is_complete"]:
        return 0
    log.error(
        "error: a file is missing, or more buildings failed than reconstruct.max_failed_fraction %g", most
    )
    return 1


def city_files(folder: Path) -> list[Path]:
    """The CityJSON files in a folder; empty if the path is no folder."""
    return [each for each in sorted(folder.glob("*.city.json*")) if each.suffix in CITY]


class Sums(TypedDict):
    """The part of a summary about files: SHA-256 of the files of the run, and names of the files that earlier runs
    left."""

    sha256: dict[str, str]
    earlier: NotRequired[list[str]]


def sums_of(summary: Path) -> Sums:
    """The checksums in the summary of a run; empty without a summary, or if the file is no summary."""
    try:
        listed: Sums = files.read_json(summary, Sums)
    except InputError:
        return {"sha256": {}}
    return listed


def bounds_of_tile(tile: str, config: Config, margin_m: float = 0.0) -> Bounds:
    """Bounds of a tile and its margin, metres. Raises :class:`InputError` if ``tile`` is not a tile name."""
    return tile_bounds(tile, config.region.tile_size_m, margin_m)


def check_failures(path: Path, what: str, status: np.ndarray, section: str, config: Config) -> None:
    """Raise :class:`InputError` if a larger share of buildings, by their ``status``, is not ok than
    ``max_failed_fraction`` of a section of the config. what: the buildings and what befell them, for the message."""
    share = (status != "ok").mean() if len(status) else 0.0
    most = getattr(config, section).max_failed_fraction
    if share > most:
        raise InputError(
            f"{path}: {share:.1%} of {what}, more than {section}.max_failed_fraction {most:.1%}; the reasons are"
            " listed above"
        )


def log_status_counts(out: Path, status: Iterable[str]) -> None:
    """Log one line: the number of buildings with status ok, and the number of others per reason."""
    counts = Counter(map(str, status))
    num_ok = counts.pop("ok", 0)
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts.most_common()) or "none"
    log.info(f"{out.name}: {num_ok} buildings ok, {counts.total()} excluded ({reasons})")


def check_arguments(out: Path, terrain: Path | None, tile: str | None, config: Config) -> None:
    """Check the arguments of ``p2wss reconstruct`` that are no inputs, before anything slow is imported or read.

    Raises :class:`InputError`, in one line, for an argument that cannot work; logs a warning for one without effect.
    """
    check_out(out, config)
    if tile is not None:
        tile_bounds(tile, config.region.tile_size_m)
    outputs = config.reconstruct.outputs
    names = ", ".join(outputs)
    if config.reconstruct.vegetation and {*outputs} <= {"gpkg", "geoparquet"}:
        log.warning("warning: --vegetation has no effect on files: none of %s has plants", names)
    if any(name not in TABLES_AND_MODELS for name in outputs):
        return
    if terrain is not None and "report" not in outputs:  # the page of the report shows it
        raise InputError(
            f"--terrain {terrain}: {names} cannot hold a terrain; add a mesh format to --outputs, such as"
            " glb, or omit --terrain"
        )
    for name in ("per_building", "skin"):
        if getattr(config.reconstruct, name):
            text = "warning: --%s has no effect on files: none of %s is a mesh format"
            log.warning(text, name.replace("_", "-"), names)


def check_out(out: Path, config: Config) -> None:
    """Raise :class:`InputError` if ``out`` is no folder, is named like a file, or cannot be written to, and
    ``ModuleNotFoundError`` if a format needs a missing package."""
    if config.reconstruct.writes_parquet:
        import pyarrow.parquet  # noqa: F401
    files.check_folder(out, OUTPUT_SUFFIXES.values())
    with writing(out), tempfile.TemporaryFile(dir=files.existing_folder(out)):
        pass
