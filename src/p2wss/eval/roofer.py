"""Roofer (Peters et al. 2022), the baseline of Table 2: a separate program that the user installs.

No part of it belongs to this package. It reads LAZ and GeoPackage and writes CityJSON, which is read back.
"""

from __future__ import annotations

import logging
import subprocess
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyproj
import shapely.affinity

from p2wss.config import Eval
from p2wss.data import reasons
from p2wss.data.building import Reconstruction, no_mesh
from p2wss.eval.cases import Case
from p2wss.eval.clock import CpuClock
from p2wss.eval.recording import ID_FIELD, Recording
from p2wss.eval.roofer_command import Roofer
from p2wss.formats import cityjson_read
from p2wss.formats.cityjson_read import ReadSolid
from p2wss.storage import files
from p2wss.storage.schemas.crops import REAL
from p2wss.storage.temporary import temporary_folder

log = logging.getLogger("p2wss")
METHOD = "roofer"


def run(
    roofer: Roofer,
    cases: Sequence[Case],
    crs: dict[str, str | None],
    config: Eval,
    clock: CpuClock | None = None,
) -> list[Reconstruction]:
    """One reconstruction per case, in order; Roofer runs once per data set and tile.

    Buildings of a run that fails, and buildings that Roofer skips, get a row without a mesh, with the reason.
    """
    by_key: dict[tuple[str, str, str], Reconstruction] = {}
    clock = clock or CpuClock()
    for (dataset, tile), group in groupby(sorted(cases, key=_run_key), key=_run_key):
        members = list(group)
        with temporary_folder("roofer") as folder:
            write_inputs(members, crs.get(dataset), folder)
            with clock.timed(dataset, len(members)):
                solids, reason = _run_tile(roofer, members, folder, config)
            if config.roofer_keep:
                _keep(_outputs(folder), dataset, tile, Path(config.roofer_keep))
        for case in members:
            solid = solids.get(case.building.building_id)
            by_key[case.key] = (
                reconstruction(case, solid)
                if solid is not None and len(solid.mesh.triangle)
                else no_mesh(case.building, METHOD, reason or reasons.NO_ROOFER_MESH)
            )
    return [by_key[case.key] for case in cases]


def recorded(recording: Recording, cases: Sequence[Case]) -> dict[tuple[str, str, str], Reconstruction]:
    """Outputs of an earlier run of Roofer for the cases of real LiDAR, by their keys.

    A building that is missing gets a row without a mesh; if all of the data set are missing, the files are of other
    buildings and the result is empty.
    """
    real = [case for case in cases if case.dataset == REAL]
    if not recording.num_evaluated:
        return {}
    solids = recording.solids([case.building.building_id for case in real])
    by_key = {}
    for case in real:
        solid = solids.get(case.building.building_id)
        if solid is None:
            by_key[case.key] = no_mesh(case.building, METHOD, reasons.NOT_RECORDED)
        elif len(solid.mesh.triangle):
            by_key[case.key] = reconstruction(case, solid)
        else:
            by_key[case.key] = no_mesh(case.building, METHOD, reasons.NO_ROOFER_MESH)
    return by_key


def reconstruction(case: Case, solid: ReadSolid) -> Reconstruction:
    """A solid of Roofer in the frame of the case."""
    building = case.building
    # the ground face of Roofer's solid is at its own estimate of the ground
    ground = building.ground_z_m
    return Reconstruction(
        building.building_id,
        building.tile,
        METHOD,
        "ok",
        building.origin_xy_m,
        ground,
        building.rings,
        None,
        None,
        None,
        solid.mesh.translated([-building.origin_xy_m[0], -building.origin_xy_m[1], -ground]),
    )


def _run_key(case: Case) -> tuple[str, str]:
    return case.dataset, case.building.tile


def _run_tile(
    roofer: Roofer, cases: Sequence[Case], folder: Path, config: Eval
) -> tuple[dict[str, ReadSolid], str | None]:
    """Solids by building id, and the reason if the run failed."""
    command = [word.replace("{folder}", str(folder)) for word in roofer.command]
    command += ["--id-attribute", ID_FIELD, "--lod22"]
    command += [str(folder / "points.laz"), str(folder / "footprints.gpkg"), str(folder / "out")]
    try:
        completed = subprocess.run(
            command, capture_output=True, text=True, timeout=config.roofer_timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        name, limit_s = cases[0].building.tile, config.roofer_timeout_s
        log.warning("Roofer took more than %g s on tile %s", limit_s, name)
        return {}, reasons.ROOFER_TIMEOUT
    if completed.returncode != 0:
        message = (completed.stderr or completed.stdout).strip().splitlines()
        log.warning(
            "Roofer failed with exit status %d on tile %s: %s",
            completed.returncode,
            cases[0].building.tile,
            message[-1] if message else "",
        )
        return {}, reasons.ROOFER_FAILED
    solids = {}
    for path in _outputs(folder):
        for solid in cityjson_read.read(path):
            solids[str(solid.attributes.get(ID_FIELD, solid.building_id))] = solid
    return solids, None


def _outputs(folder: Path) -> list[Path]:
    return sorted((folder / "out").rglob("*.jsonl"))


def _keep(paths: Sequence[Path], dataset: str, tile: str, folder: Path) -> None:
    """Copy the output of a run: of real LiDAR into ``folder``, of other data sets into a folder of their name in it.

    ``eval.roofer_recorded`` reads the files of a folder, but not those of the folders in it.
    """
    folder = folder if dataset == REAL else folder / dataset
    # the name of a tile may begin with its place
    name = tile.replace("/", "_")
    for old in folder.glob(f"{name}.*.city.jsonl"):
        old.unlink()
    for number, path in enumerate(paths):
        files.write_bytes(folder / f"{name}.{number}.city.jsonl", path.read_bytes())


def write_inputs(cases: Sequence[Case], crs: str | None, folder: Path) -> None:
    """Write ``points.laz``, each point once with its class, and ``footprints.gpkg`` with the ids of the buildings."""
    cloud = [case.building.point_m + np.array([*case.building.origin_xy_m, 0.0]) for case in cases]
    classes = np.concatenate([case.building.classification for case in cases])
    # crops of neighbours overlap; on a grid of centimetres the same point has the same coordinates
    grid, first = np.unique(np.round(np.concatenate(cloud) * 100).astype(np.int64), axis=0, return_index=True)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.array([0.01, 0.01, 0.01])
    header.offsets = np.floor(grid.min(axis=0) / 100.0) if len(grid) else np.zeros(3)
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (grid / 100.0).T
    las.classification = classes[first]
    las.return_number = np.ones(len(grid), np.uint8)
    las.number_of_returns = np.ones(len(grid), np.uint8)
    las.write(folder / "points.laz")
    shapes = [shapely.affinity.translate(case.building.polygon, *case.building.origin_xy_m) for case in cases]
    frame = gpd.GeoDataFrame(
        {ID_FIELD: [case.building.building_id for case in cases]}, geometry=shapes, crs=crs
    )
    # Roofer 1.1 built with GDAL 3.6 aborts on version 1.4 without a CRS
    frame.to_file(folder / "footprints.gpkg", driver="GPKG", engine="pyogrio", VERSION="1.2")
