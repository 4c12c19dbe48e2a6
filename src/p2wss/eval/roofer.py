"""Roofer (Peters et al. 2022), the baseline of Table 2: a separate program that the user installs.

No part of it belongs to this package. It reads LAZ and GeoPackage and writes CityJSON, which is read back. Where it
cannot be run, CityJSON of an earlier run may replace it.
"""

from __future__ import annotations

import logging
import shlex
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyproj
import shapely.affinity

from p2wss.config import Eval
from p2wss.data import reasons
from p2wss.data.building import Reconstruction, no_mesh
from p2wss.eval import roofer_command
from p2wss.eval.cases import Case
from p2wss.formats import cityjson_read
from p2wss.formats.cityjson_read import ReadSolid
from p2wss.storage.schemas.crops import REAL
from p2wss.storage.temporary import temporary_folder

log = logging.getLogger("p2wss")
METHOD = "roofer"
_ID_FIELD = "building_id"


def reconstruct(cases: Sequence[Case], crs: str | None, config: Eval) -> list[Reconstruction]:
    """The solids of Roofer for the cases of one shard, in order.

    It is run on their points or, if it cannot be run, replaced by recorded outputs for real LiDAR; empty if there are
    none. Without a solid the status states the reason.
    """
    if roofer_command.version(config) is not None:
        solids, missing = _run(cases, crs, config)
    else:
        recorded = roofer_command.recorded_files(config)
        if not recorded or cases[0].dataset != REAL:
            return []
        solids, missing = _read(recorded), reasons.NOT_RECORDED
    return [_reconstruction(case, solids.get(case.building.building_id), missing) for case in cases]


def _read(paths: Iterable[Path]) -> dict[str, ReadSolid]:
    """The solids by the attribute ``building_id``, or else by their names."""
    solids = (solid for path in paths for solid in cityjson_read.read(path))
    return {str(solid.attributes.get(_ID_FIELD, solid.building_id)): solid for solid in solids}


def _reconstruction(case: Case, solid: ReadSolid | None, missing: str) -> Reconstruction:
    building = case.building
    if solid is None or not len(solid.mesh.triangle):
        return no_mesh(building, METHOD, missing if solid is None else reasons.NO_ROOFER_MESH)
    return Reconstruction(
        building_id=building.building_id,
        tile=building.tile,
        method=METHOD,
        status="ok",
        origin_xy_m=building.origin_xy_m,
        # the ground face of Roofer's solid is at its own estimate of the ground
        ground_z_m=building.ground_z_m,
        rings=building.rings,
        eave_height_m=None,
        angle_deg=None,
        confidence=None,
        mesh=solid.mesh.translated(-building.position_m),
    )


def _run(cases: Sequence[Case], crs: str | None, config: Eval) -> tuple[dict[str, ReadSolid], str]:
    """Solids by building id, and why others have none."""
    tile = cases[0].building.tile
    with temporary_folder("roofer") as folder:
        write_inputs(cases, crs, folder)
        words = [word.replace("{folder}", str(folder)) for word in shlex.split(config.roofer_command)]
        words += ["--id-attribute", _ID_FIELD, "--lod22"]
        words += [str(folder / name) for name in ("points.laz", "footprints.gpkg", "out")]
        try:
            completed = subprocess.run(
                words, capture_output=True, text=True, timeout=config.roofer_timeout_s, check=False
            )
        except subprocess.TimeoutExpired:
            log.warning("Roofer took more than %g s on tile %s", config.roofer_timeout_s, tile)
            return {}, reasons.ROOFER_TIMEOUT
        if completed.returncode != 0:
            message = (completed.stderr or completed.stdout).strip()
            log.warning(
                "Roofer failed with exit status %d on tile %s: %s", completed.returncode, tile, message
            )
            return {}, reasons.ROOFER_FAILED
        return _read(sorted((folder / "out").rglob("*.jsonl"))), reasons.NO_ROOFER_MESH


def write_inputs(cases: Sequence[Case], crs: str | None, folder: Path) -> None:
    """Write ``points.laz``, each point once with its class, and ``footprints.gpkg`` with the ids of the buildings."""
    cloud = [case.building.point_m + case.building.position_m for case in cases]
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
        {_ID_FIELD: [case.building.building_id for case in cases]}, geometry=shapes, crs=crs
    )
    # Roofer 1.1 built with GDAL 3.6 aborts on version 1.4 without a CRS
    frame.to_file(folder / "footprints.gpkg", driver="GPKG", engine="pyogrio", VERSION="1.2")
