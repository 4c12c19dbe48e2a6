"""Prepare real clouds: one file per tile with its margin, without noise, and with ground points.

Classified clouds only need cropping, which laspy does. In unclassified clouds, PDAL finds the ground
(:mod:`p2wss.fetching.pdal`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from p2wss.config import Prepare
from p2wss.data.las_classes import GROUND_CLASS
from p2wss.fetching import pdal
from p2wss.fetching.cloud import check_cloud, count_classes, read_header, write_cloud
from p2wss.storage.errors import InputError
from p2wss.storage.log_lines import log

HOW_TO_INSTALL_PDAL = (
    "install it with conda (envs/pdal.yaml, or snakemake --sdm conda), Docker or your distribution, and "
    "set fetch.prepare.pdal_command if the command is not pdal"
)


def prepare(
    out: Path,
    paths: Sequence[Path],
    window: pdal.Window,
    config: Prepare,
    ground: Sequence[int] = (GROUND_CLASS,),
) -> dict[str, Any]:
    """Write the points of a tile's cloud in ``window`` to ``out``.

    paths: the tile's cloud, then the clouds of its neighbours. The holes of the window are the bounds of the
    neighbours, in the same order; their points belong to their own files, but help to find the ground near the edges of
    this tile. ground: the classes that are ground. Returns the program used, the reason for using PDAL, and counts of
    points.

    Raises :class:`InputError` if PDAL is required but is not installed or fails, or if it would mark ground points with
    class 2 and ``ground`` lacks that class.
    """
    classes = count_classes(paths[0])
    num_ground = sum(classes[each] for each in set(ground))
    reason = ""
    is_reprojected = window.clouds_crs != window.crs
    if is_reprojected:
        reason = f"clouds in {window.clouds_crs}"
    elif config.mode == "pdal":
        reason = "fetch.prepare.mode: pdal"
    elif config.mode == "auto" and not num_ground:
        reason = f"no ground points (class {', '.join(map(str, ground))}) among the classes {sorted(classes)}"
    command = pdal.find_command(config) if reason else None
    if reason and command is None:
        problem = (
            f"{paths[0]}: {reason}, but program {config.pdal_command!r} not found; {HOW_TO_INSTALL_PDAL}"
        )
        if not num_ground or is_reprojected:
            raise InputError(f"{problem}; fetch.prepare.mode: never uses clouds unchanged")
        log.warning(f"{problem}; the cloud has ground points and is used unchanged")
    if not reason or command is None:
        num_points = write_cloud(out, paths[:1], window.bounds, window.crs, window.holes, link=True)
        if num_points < classes.total():  # of what is left
            classes = count_classes(out)
            num_ground = sum(classes[each] for each in set(ground))
        return {"by": "laspy", "num_points": num_points, "num_ground_points": num_ground, "reason": reason}
    if not num_ground and GROUND_CLASS not in ground:
        raise InputError(
            f"{paths[0]}: {reason}; PDAL marks the ground by class {GROUND_CLASS}: add it to region.classes.ground"
        )
    stages = pdal.read_stages(Path(config.pdal_stages))
    if num_ground:
        stages = [stage for stage in stages if not str(stage.get("tag", "")).startswith(pdal.CONDITIONAL)]
    for path in paths:
        check_cloud(path, window.clouds_crs)
    has_colours = {"red", "nir"} & set(read_header(paths[0]).point_format.dimension_names)
    try:
        facts = pdal.run(command, out, paths, window, 7 if has_colours else 6, stages, config.pdal_timeout_s)
    except OSError as error:
        raise InputError(f"{out}: not written: {error.strerror or error}") from error
    return facts | {"by": "pdal", "reason": reason}
