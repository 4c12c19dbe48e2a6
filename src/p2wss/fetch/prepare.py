"""Real clouds made ready: one file per tile with its margin, without noise, with ground points.

Clouds that come classified need no more than cropping, which laspy does. Ground of unclassified ones is found
by PDAL (Butler et al. 2021) with the simple morphological filter (Pingel et al. 2013). PDAL is a program of the user's,
run with a pipeline that is left beside the result.
"""

from __future__ import annotations

import logging
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from p2wss.config import Prepare
from p2wss.data import files
from p2wss.data.las_classes import GROUND_CLASS
from p2wss.data.tiling import Bounds
from p2wss.errors import InputError
from p2wss.fetch.cloud import check_cloud, count_classes, read_header, write_cloud

log = logging.getLogger(__name__)
CONDITIONAL = "if_no_ground_"
_NOT_WITHHELD = "Withheld[0:0]"
HOW_TO_GET_PDAL = (
    "get it with conda (envs/pdal.yaml, or snakemake --sdm conda), with Docker or from your distribution, and "
    "set fetch.prepare.pdal_command if it is not called pdal"
)
Stage = dict[str, Any]


def prepare(
    out: Path,
    paths: Sequence[Path],
    bounds: Bounds,
    holes: Sequence[Bounds],
    crs: str,
    clouds_crs: str,
    config: Prepare,
) -> dict[str, Any]:
    """Write the points of the tile's clouds in ``bounds``, less those in ``holes``, and tell what was done.

    paths: the tile's own cloud, then those of its neighbours. holes: the tiles of the neighbours, whose points
    are written with them; they still help to find the ground here. clouds_crs: of ``paths``.

    Raises :class:`InputError` if PDAL is needed and not there, or fails.
    """
    classes = count_classes(paths[0])
    num_ground = classes[GROUND_CLASS]
    reason = ""
    if clouds_crs != crs:
        reason = f"clouds in {clouds_crs}"
    elif config.mode == "pdal":
        reason = "fetch.prepare.mode: pdal"
    elif config.mode == "auto" and not num_ground:
        reason = f"no ground points (class {GROUND_CLASS}) among the classes {sorted(classes)}"
    command = _command(config) if reason else None
    if reason and command is None:
        problem = f"{paths[0]}: {reason}, but no program {config.pdal_command!r} was found; {HOW_TO_GET_PDAL}"
        if not num_ground or clouds_crs != crs:
            raise InputError(f"{problem}; fetch.prepare.mode: never uses clouds as they are")
        log.warning(f"{problem}; the cloud has ground points and is used as it is")
    if not reason or command is None:
        num_points = write_cloud(out, paths[:1], bounds, crs, holes, link=True)
        return {"by": "laspy", "num_points": num_points, "num_ground_points": num_ground, "reason": reason}
    stages = read_stages(Path(config.pdal_stages))
    if num_ground:
        stages = [stage for stage in stages if not str(stage.get("tag", "")).startswith(CONDITIONAL)]
    for path in paths:
        check_cloud(path, clouds_crs)
    colours = {"red", "nir"} & set(read_header(paths[0]).point_format.dimension_names)
    window = (bounds, holes, crs, clouds_crs)
    try:
        facts = _run(command, out, paths, window, 7 if colours else 6, stages, config.pdal_timeout_s)
    except OSError as error:
        raise InputError(f"{out}: not written: {error.strerror or error}") from error
    return facts | {"by": "pdal", "reason": reason}


def pipeline(
    names: Sequence[str],
    out: str,
    bounds: Bounds,
    holes: Sequence[Bounds],
    crs: str,
    clouds_crs: str,
    point_format: int,
    stages: Sequence[Stage],
) -> dict[str, list[Stage]]:
    """A PDAL pipeline: each cloud reprojected on request and cropped, all merged, ``stages``, holes, LAZ.

    What lies in a hole comes from the neighbour's cloud only, so that no point comes twice.
    """
    steps: list[Stage] = []
    ends = []
    for number, name in enumerate(names):
        # a cloud that does not tell its CRS is believed to be in the one of the config
        steps.append({"type": "readers.las", "filename": name, "default_srs": clouds_crs})
        if clouds_crs != crs:
            steps.append({"type": "filters.reprojection", "in_srs": clouds_crs, "out_srs": crs})
        if number == 0:
            steps += [_crop(bounds)] + [_crop(hole) | {"outside": True} for hole in holes]
        else:
            steps.append(_crop(_common(bounds, holes[number - 1])))
        steps[-1] = steps[-1] | {"tag": f"cloud_{number}"}
        ends.append(f"cloud_{number}")
    steps.append({"type": "filters.merge", "inputs": ends})
    steps += stages
    steps += [_crop(hole) | {"outside": True} for hole in holes]
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
            "a_srs": crs,
        }
    )
    if any(stage["type"].startswith("filters.hag_") for stage in stages):
        steps[-1]["extra_dims"] = "HeightAboveGround=float32"
    return {"pipeline": steps}


def read_stages(path: Path) -> list[Stage]:
    """The user's filters. Raises :class:`InputError` if the file is no list of PDAL stages, or reads or writes."""
    stages = files.read_json(path)
    if not isinstance(stages, list) or not all(isinstance(s, dict) and "type" in s for s in stages):
        raise InputError(f'{path}: expected a list of PDAL stages, each with a "type"')
    for stage in stages:
        if not str(stage["type"]).startswith("filters."):
            raise InputError(
                f"{path}: {stage['type']}: only filters belong here; p2wss adds readers and writer"
            )
    return stages


def in_words_of(schema: str, stages: Sequence[Stage]) -> list[Stage]:
    """``stages`` as the installed PDAL understands them. schema: its dimensions of the cloud, as JSON text.

    Before 2.6 withheld is no dimension, but bit 4 of ClassFlags, or bit 128 of the class in formats before 6.
    """
    if '"Withheld"' in schema:
        return list(stages)
    instead = "ClassFlags[0:3],ClassFlags[8:11]" if '"ClassFlags"' in schema else "Classification[0:127]"
    return [
        stage | {"limits": stage["limits"].replace(_NOT_WITHHELD, instead)} if "limits" in stage else stage
        for stage in stages
    ]


def _call(command: list[str], folder: Path, timeout_s: float) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=timeout_s, check=True)
    return done.stdout


def _command(config: Prepare) -> list[str] | None:
    words = shlex.split(config.pdal_command)
    return words if words and shutil.which(words[0]) else None


def _run(
    command: list[str],
    out: Path,
    paths: Sequence[Path],
    window: tuple[Bounds, Sequence[Bounds], str, str],
    point_format: int,
    stages: list[Stage],
    timeout_s: float,
) -> dict[str, Any]:
    # PDAL works in a folder of its own with names of no surprise: it may see no other, in a container
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as name:
        folder = Path(name).resolve()
        folder.chmod(0o755)  # a container may run as somebody else
        local = [f"{number}.laz" for number in range(len(paths))]
        for path, short in zip(paths, local, strict=True):
            _provide(path, folder / short)
        words = [word.replace("{folder}", str(folder)) for word in command]
        try:
            schema = _call([*words, "info", "--schema", "0.laz"], folder, timeout_s)
            stages = in_words_of(schema, stages)
            files.write_json(
                folder / "pipeline.json", pipeline(local, "out.laz", *window, point_format, stages)
            )
            _call([*words, "pipeline", "pipeline.json"], folder, timeout_s)
        except subprocess.CalledProcessError as error:
            said = " ".join((error.stderr or error.stdout).split())
            raise InputError(f"{paths[0]}: PDAL failed: {said[-400:] or error}") from error
        except subprocess.TimeoutExpired as error:
            raise InputError(
                f"{paths[0]}: PDAL took longer than fetch.prepare.pdal_timeout_s {timeout_s}"
            ) from error
        if not (folder / "out.laz").is_file():
            raise InputError(f"{paths[0]}: PDAL wrote nothing; does {' '.join(words)} work in {{folder}}?")
        classes = count_classes(folder / "out.laz")
        if not classes.total():
            raise InputError(f"{paths[0]}: PDAL left no point in {window[0]}; is it the right tile and CRS?")
        with files.atomic(out) as temporary:
            os.replace(folder / "out.laz", temporary)
    names = [str(path) for path in paths]
    files.write_json(out.with_suffix(".pdal.json"), pipeline(names, str(out), *window, point_format, stages))
    return {"num_points": classes.total(), "num_ground_points": classes[GROUND_CLASS]}


def _provide(path: Path, target: Path) -> None:
    try:
        os.link(path.resolve(), target)
    except OSError:  # another disk, or one without links
        shutil.copyfile(path, target)


def _crop(bounds: Bounds) -> Stage:
    x_min, y_min, x_max, y_max = bounds
    return {"type": "filters.crop", "bounds": f"([{x_min:.3f}, {x_max:.3f}], [{y_min:.3f}, {y_max:.3f}])"}


def _common(first: Bounds, second: Bounds) -> Bounds:
    return (
        max(first[0], second[0]),
        max(first[1], second[1]),
        min(first[2], second[2]),
        min(first[3], second[3]),
    )
