"""Roofer (Peters et al. 2022), the baseline of Table 2: a separate program that the user installs.

No part of it belongs to this package. It reads LAZ and GeoPackage and writes CityJSON, which is read back. Where it
cannot be run, recorded CityJSON of an earlier run may replace it.
"""

import hashlib
import shlex
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pyproj
import shapely.affinity

from p2wss.config import Eval, roofer_command
from p2wss.data import reasons
from p2wss.data.building import Reconstruction, no_mesh
from p2wss.eval.cases import Case
from p2wss.formats import cityjson_read
from p2wss.formats.cityjson_read import ReadSolid
from p2wss.storage import files
from p2wss.storage.messages import log
from p2wss.storage.schemas.crops import REAL
from p2wss.storage.temporary import temporary_folder

METHOD = "roofer"
_ID_FIELD = "building_id"
# recorded outputs count if this share of the points that they were made from is there: footprints that move by
# centimetres keep all but 0.3 % of the points of a real cloud, and another draw of the simulation keeps none
_SAME_SHARE = 0.95
_SKETCH = 128
# largest difference in the number of points, as a share, between two draws of the same simulated buildings
_OTHER_NUMBER = 0.05


def reconstruct(cases: Sequence[Case], crs: str | None, config: Eval) -> list[Reconstruction]:
    """The solids of Roofer for the cases of one shard, in order.

    Roofer is run on their points. If it cannot be run, recorded outputs replace it; the result is empty if there are
    none for the tile. Without a solid the status states the reason.
    """
    if roofer_command.version(config) is None:
        return _recorded(cases, roofer_command.recorded_files(config))
    with outputs(cases, crs, config) as (paths, missing):
        solids = _read(paths)
    return [_reconstruction(case, solids.get(case.building.building_id), missing) for case in cases]


def _recorded(cases: Sequence[Case], paths: Sequence[Path]) -> list[Reconstruction]:
    """Recorded solids of the cases; an empty list if nothing is recorded for the tile.

    If the outputs state what they were made from, they count for the same clouds. For simulated buildings with the same
    truth and about as many points they count, too, with a status that says that the points are others. Outputs without
    such a statement count for real LiDAR.
    """
    dataset, tile = cases[0].dataset, cases[0].building.tile
    stated = next((path for path in paths if path.name == roofer_command.CLOUDS), None)
    if stated is None:
        if dataset != REAL or not paths:
            return []
        states = [reasons.OK] * len(cases)
    else:
        kind = dict[str, dict[str, dict[str, list[int]]]]
        recorded = files.read_json(stated, kind, "hashes of points and buildings by data set and tile")
        known = recorded.get(dataset, {}).get(tile)
        if known is None:
            return []
        folder = stated.parent if dataset == REAL else stated.parent / dataset
        paths = [each for each in paths if each.parent == folder and each != stated]
        states = _states(cases, known)
    solids = _read(paths)
    return [
        _reconstruction(case, None, state)
        if state == reasons.OTHER_CLOUDS
        else _reconstruction(case, solids.get(case.building.building_id), reasons.NOT_RECORDED, state)
        for case, state in zip(cases, states, strict=True)
    ]


def made_from(cases: Sequence[Case]) -> dict[str, list[int]]:
    """What tells later whether outputs belong to the cases of a tile: ``points``, a sketch of the cloud,
    ``num_points``, and ``buildings``, hashes of the labels of simulated buildings."""
    return {
        "points": cloud_sketch(cases),
        "num_points": [len(_cloud(cases)[0])],
        "buildings": [_truth_hash(case) for case in cases if case.is_labelled],
    }


def _states(cases: Sequence[Case], known: dict[str, list[int]]) -> list[str]:
    """The status of each case for outputs that were made from ``known`` (:func:`made_from`): made from its points, from
    about as many other points on the same building, or from neither."""
    now, (num_known,) = made_from(cases), known["num_points"]
    if len(set(known["points"]) & set(now["points"])) >= _SAME_SHARE * len(known["points"]):
        return [reasons.OK] * len(cases)
    is_alike = abs(now["num_points"][0] - num_known) <= _OTHER_NUMBER * num_known
    same = set(known["buildings"]) if is_alike else ()
    is_same = [case.is_labelled and _truth_hash(case) in same for case in cases]
    return [reasons.OTHER_POINTS if each else reasons.OTHER_CLOUDS for each in is_same]


def _truth_hash(case: Case) -> int:
    """Hash of the id, the footprint, the heights and the angles of a simulated building, rounded to hundredths."""
    building = case.building
    corner_m = np.concatenate([ring + building.origin_xy_m for ring in building.rings])
    height_m = np.array((case.eave_height_m, case.label_terrain_z_m), float)
    values = np.concatenate([corner_m.ravel(), height_m, np.array(case.angle_deg, float)])
    hundredths = np.round(values * 100).astype(np.int64)
    return int(hashlib.sha256(building.building_id.encode() + hundredths.tobytes()).hexdigest()[:8], 16)


def cloud_sketch(cases: Sequence[Case]) -> list[int]:
    """What identifies the points of a tile as Roofer gets them: the least hashes of point and class (Broder 1997). Two
    clouds have about the same share of these hashes in common as of their points."""
    grid_cm, classification = _cloud(cases)
    points = pd.DataFrame(grid_cm).assign(classification=classification)
    least = np.sort(pd.util.hash_pandas_object(points, index=False).to_numpy())[:_SKETCH]
    return (least >> np.uint64(32)).tolist()  # shorter, and still of different points


def _cloud(cases: Sequence[Case]) -> tuple[np.ndarray, np.ndarray]:
    """(the points of all crops in centimetres, int64 (n, 3), sorted and without duplicates; their classes)."""
    cloud = [case.building.point_m + case.building.position_m for case in cases]
    # crops of neighbours overlap; on a grid of centimetres the same point has the same coordinates
    grid_cm, first = np.unique(
        np.round(np.concatenate(cloud) * 100).astype(np.int64), axis=0, return_index=True
    )
    return grid_cm, np.concatenate([case.building.classification for case in cases])[first]


def _read(paths: Iterable[Path]) -> dict[str, ReadSolid]:
    """The solids by the attribute ``building_id``, or else by their names."""
    solids = (solid for path in paths for solid in cityjson_read.read(path))
    return {str(solid.attributes.get(_ID_FIELD, solid.building_id)): solid for solid in solids}


def _reconstruction(
    case: Case, solid: ReadSolid | None, missing: str, status: str = reasons.OK
) -> Reconstruction:
    building = case.building
    if solid is None or not len(solid.mesh.triangle):
        return no_mesh(building, METHOD, missing if solid is None else reasons.NO_ROOFER_MESH)
    return Reconstruction(
        building_id=building.building_id,
        tile=building.tile,
        method=METHOD,
        status=status,
        origin_xy_m=building.origin_xy_m,
        # the ground face of Roofer's solid is at its own estimate of the ground
        ground_z_m=building.ground_z_m,
        rings=building.rings,
        eave_height_m=None,
        angle_deg=None,
        mesh=solid.mesh.translated(-building.position_m),
    )


@contextmanager
def outputs(cases: Sequence[Case], crs: str | None, config: Eval) -> Iterator[tuple[list[Path], str]]:
    """Run Roofer on a tile. Yields its CityJSON files, in a temporary folder, and the status of a building that they
    lack."""
    tile = cases[0].building.tile
    with temporary_folder("roofer") as folder:
        write_inputs(cases, crs, folder)
        words = [word.replace("{folder}", str(folder)) for word in shlex.split(config.roofer_command)]
        words += ["--id-attribute", _ID_FIELD, "--lod22"]
        words += [str(folder / name) for name in ("points.laz", "footprints.gpkg", "out")]
        paths, missing = [], reasons.NO_ROOFER_MESH
        try:
            subprocess.run(words, capture_output=True, text=True, timeout=config.roofer_timeout_s, check=True)
            paths = sorted((folder / "out").rglob("*.jsonl"))
        except subprocess.TimeoutExpired:
            log.warning("Roofer took more than %g s on tile %s", config.roofer_timeout_s, tile)
            missing = reasons.ROOFER_TIMEOUT
        except subprocess.CalledProcessError as error:
            message = (error.stderr or error.stdout).strip()
            log.warning("Roofer failed with exit status %d on tile %s: %s", error.returncode, tile, message)
            missing = reasons.ROOFER_FAILED
        yield paths, missing


def write_inputs(cases: Sequence[Case], crs: str | None, folder: Path) -> None:
    """Write ``points.laz``, each point once with its class, and ``footprints.gpkg`` with the ids of the buildings."""
    grid, classification = _cloud(cases)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.array([0.01, 0.01, 0.01])
    header.offsets = np.floor(grid.min(axis=0) / 100.0) if len(grid) else np.zeros(3)
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (grid / 100.0).T
    las.classification = classification
    las.return_number = np.ones(len(grid), np.uint8)
    las.number_of_returns = np.ones(len(grid), np.uint8)
    las.write(folder / "points.laz")
    shapes = [shapely.affinity.translate(case.building.polygon, *case.building.origin_xy_m) for case in cases]
    frame = gpd.GeoDataFrame(
        {_ID_FIELD: [case.building.building_id for case in cases]}, geometry=shapes, crs=crs
    )
    # Roofer 1.1 built with GDAL 3.6 aborts on version 1.4 without a CRS
    frame.to_file(folder / "footprints.gpkg", driver="GPKG", engine="pyogrio", VERSION="1.2")
