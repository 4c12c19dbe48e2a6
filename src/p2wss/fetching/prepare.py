"""Prepare real clouds: one file per tile with its margin, without noise, and with ground points.

Classified clouds only need cropping, which laspy does. In unclassified clouds, PDAL (Butler et al. 2021), a program
that the user installs, finds the ground. It reprojects, crops, merges and filters; the default filters are the simple
morphological filter (SMRF, Pingel et al. 2013). The pipeline is kept beside the result.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from p2wss.config import Prepare
from p2wss.data.las_classes import GROUND_CLASS
from p2wss.data.tiling import Bounds
from p2wss.fetching.cloud import (
    append_checksum,
    check_cloud,
    count_classes,
    link_or_copy,
    read_header,
    write_cloud,
)
from p2wss.storage import files
from p2wss.storage.messages import InputError, log, writing
from p2wss.storage.temporary import temporary_folder

HOW_TO_INSTALL_PDAL = (
    "install it with conda (envs/pdal.yaml, or snakemake --sdm conda), Docker or your distribution, and "
    "set fetch.prepare.pdal_command if the command is not pdal"
)
CONDITIONAL = "if_no_ground_"  # stages with this tag prefix run only on clouds without ground points
_NOT_WITHHELD = "Withheld[0:0]"
Stage = dict[str, Any]


def prepare(
    out: Path,
    paths: Sequence[Path],
    window: Window,
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
    command = find_command(config) if reason else None
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
    stages = read_stages(Path(config.pdal_stages))
    if num_ground:
        stages = [stage for stage in stages if not str(stage.get("tag", "")).startswith(CONDITIONAL)]
    for path in paths:
        check_cloud(path, window.clouds_crs)
    has_colours = {"red", "nir"} & set(read_header(paths[0]).point_format.dimension_names)
    with writing(out):
        facts = run_pdal(command, out, paths, window, 7 if has_colours else 6, stages, config.pdal_timeout_s)
    return facts | {"by": "pdal", "reason": reason}


@dataclass(frozen=True)
class Window:
    """The points to write: inside ``bounds`` and outside all ``holes``, in ``crs``.

    clouds_crs: CRS of the delivered clouds.
    """

    bounds: Bounds
    holes: Sequence[Bounds]
    crs: str
    clouds_crs: str


def pipeline(
    names: Sequence[str], out: str, window: Window, point_format: int, stages: Sequence[Stage]
) -> dict[str, list[Stage]]:
    """The PDAL pipeline: read, reproject and crop each cloud, merge, run ``stages``, cut the holes, write LAZ.

    names: the tile's cloud, then one per hole of ``window``. Points in a hole are read from the neighbour's cloud only,
    so that no point is read twice. point_format: of the LAS specification, 6 to 8.
    """
    steps: list[Stage] = []
    tags = []
    for number, name in enumerate(names):
        # a cloud that does not state its CRS is assumed to be in the CRS of the config
        steps.append({"type": "readers.las", "filename": name, "default_srs": window.clouds_crs})
        if window.clouds_crs != window.crs:
            steps.append({"type": "filters.reprojection", "in_srs": window.clouds_crs, "out_srs": window.crs})
        if number == 0:
            steps += [_crop(window.bounds)] + [_crop(hole) | {"outside": True} for hole in window.holes]
        else:
            steps.append(_crop(_intersection(window.bounds, window.holes[number - 1])))
        steps[-1] = steps[-1] | {"tag": f"cloud_{number}"}
        tags.append(f"cloud_{number}")
    steps.append({"type": "filters.merge", "inputs": tags})
    steps += stages
    steps += [_crop(hole) | {"outside": True} for hole in window.holes]
    steps.append(
        {
            "type": "writers.las",
            "filename": out,
            "compression": "laszip",
            "minor_version": 4,
            "dataformat_id": point_format,
            "scale_x": 0.001,
            "scale_y": 0.001,
            "scale_z": 0.001,
            "offset_x": "auto",
            "offset_y": "auto",
            "offset_z": "auto",
            "a_srs": window.crs,
        }
    )
    if any(stage["type"].startswith("filters.hag_") for stage in stages):
        steps[-1]["extra_dims"] = "HeightAboveGround=float32"
    return {"pipeline": steps}


def read_stages(path: Path) -> list[Stage]:
    """The filters of a JSON file (``fetch.prepare.pdal_stages``).

    Raises :class:`InputError` if the file is not a list of PDAL stages, or has stages other than filters.
    """
    stages = files.read_json(path)
    if not isinstance(stages, list) or not all(isinstance(s, dict) and "type" in s for s in stages):
        raise InputError(f'{path}: expected a list of PDAL stages, each with a "type"')
    for stage in stages:
        if not str(stage["type"]).startswith("filters."):
            raise InputError(
                f"{path}: {stage['type']}: only filters are allowed; p2wss adds the readers and the writer"
            )
    return stages


def for_version(schema: str, stages: Sequence[Stage]) -> list[Stage]:
    """``stages`` rewritten for the installed PDAL. schema: the dimensions of the cloud, as JSON text.

    Before PDAL 2.6, the withheld flag is not a dimension: it is bit 4 of ClassFlags or, in point formats
    below 6, bit 128 of the classification.
    """
    if '"Withheld"' in schema:
        return list(stages)
    limits = "ClassFlags[0:3],ClassFlags[8:11]" if '"ClassFlags"' in schema else "Classification[0:127]"
    return [
        stage | {"limits": stage["limits"].replace(_NOT_WITHHELD, limits)} if "limits" in stage else stage
        for stage in stages
    ]


def find_command(config: Prepare) -> list[str] | None:
    """The words of ``pdal_command``, or None if the program is not installed."""
    words = shlex.split(config.pdal_command)
    return words if words and shutil.which(words[0]) else None


def run_pdal(
    command: list[str],
    out: Path,
    paths: Sequence[Path],
    window: Window,
    point_format: int,
    stages: list[Stage],
    timeout_s: float,
) -> dict[str, Any]:
    """Run :func:`pipeline` on ``paths`` and write ``out``. Returns the counts of points.

    Raises :class:`InputError` if PDAL fails, takes too long or writes no points.
    """
    # PDAL runs in a temporary folder with plain file names: in a container it may see no other folder
    out.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(out.name, out.parent) as folder:
        folder = folder.resolve()
        folder.chmod(0o755)  # a container may run as another user
        local_names = [f"{number}.laz" for number in range(len(paths))]
        for path, local_name in zip(paths, local_names, strict=True):
            link_or_copy(path, folder / local_name)
        words = [word.replace("{folder}", str(folder)) for word in command]
        try:
            schema = _call([*words, "info", "--schema", "0.laz"], folder, timeout_s)
            stages = for_version(schema, stages)
            files.write_json(
                folder / "pipeline.json", pipeline(local_names, "out.laz", window, point_format, stages)
            )
            _call([*words, "pipeline", "pipeline.json"], folder, timeout_s)
        except subprocess.CalledProcessError as error:
            message = " ".join((error.stderr or error.stdout).split())
            raise InputError(f"{paths[0]}: PDAL failed: {message[-400:] or error}") from error
        except subprocess.TimeoutExpired as error:
            raise InputError(
                f"{paths[0]}: PDAL took longer than fetch.prepare.pdal_timeout_s {timeout_s}"
            ) from error
        if not (folder / "out.laz").is_file():
            raise InputError(f"{paths[0]}: PDAL wrote no file; can {' '.join(words)} write to {{folder}}?")
        classes = count_classes(folder / "out.laz")
        if not classes.total():
            raise InputError(
                f"{paths[0]}: PDAL wrote no points in {window.bounds}; are the tile and the CRS right?"
            )
        with files.atomic(out) as temporary:
            os.replace(folder / "out.laz", temporary)
            append_checksum(temporary)
    names = [str(path) for path in paths]
    files.write_json(out.with_suffix(".pdal.json"), pipeline(names, str(out), window, point_format, stages))
    return {"num_points": classes.total(), "num_ground_points": classes[GROUND_CLASS]}


def _call(command: list[str], folder: Path, timeout_s: float) -> str:
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=timeout_s, check=True
    ).stdout


def _crop(bounds: Bounds) -> Stage:
    x_min, y_min, x_max, y_max = bounds
    return {"type": "filters.crop", "bounds": f"([{x_min:.3f}, {x_max:.3f}], [{y_min:.3f}, {y_max:.3f}])"}


def _intersection(first: Bounds, second: Bounds) -> Bounds:
    return (
        max(first[0], second[0]),
        max(first[1], second[1]),
        min(first[2], second[2]),
        min(first[3], second[3]),
    )
