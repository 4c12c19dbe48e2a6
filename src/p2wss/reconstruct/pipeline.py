"""Stage 9, reconstruct: from the user's own footprints and LiDAR to closed buildings, each with a status."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyproj
import shapely

from p2wss.config import Reconstruct
from p2wss.data import polygon_arrays
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.data.cloud_crops import crop_cloud
from p2wss.data.clouds import Cloud, horizontal
from p2wss.data.cropping import seen_share
from p2wss.data.points import on_millimetres
from p2wss.data.solids.repair import surfaces_to_write
from p2wss.errors import InputError
from p2wss.formats import cityjson
from p2wss.formats.cityjson import Solid
from p2wss.metrics.surface import distance_to_mesh
from p2wss.reconstruct.network import Predictor
from p2wss.reconstruct.product import FIT, method_name, reconstruct_buildings
from p2wss.reconstruct.registration import COLUMN, Registration
from p2wss.reconstruct.valid import labelled_mesh

# a residual is the mean over at most this many points
_MAX_RESIDUAL_POINTS = 2048
# columns that reading and cleaning add to the input's own
_ADDED_COLUMNS = ("building_id", "status", "centre_x_m", "centre_y_m", COLUMN)
# number of buildings between two reports of progress
_BATCH = 256


@dataclass(frozen=True)
class Result:
    """A building of the output: its reconstruction, its points and how well the mesh fits them.

    status: ``ok``, ``flat`` (a flat roof instead, for ``reason``) or ``none`` (no mesh, for ``reason``).
    residual_m: mean distance of the points on the building to the mesh; NaN without any. visible_share: share of the
    footprint's 1 m cells that have a point on the building. not_representable: the building was fitted, but the
    residual is more than ``not_representable_m``. columns: values of the footprint's input columns by their names, None
    where there is no value. registration: how the footprint was moved, None without a registration.
    """

    reconstruction: Reconstruction
    status: str
    reason: str | None
    num_points: int
    residual_m: float
    visible_share: float
    not_representable: bool
    columns: Mapping[str, Any] = field(default_factory=dict)
    registration: Registration | None = None


def run(
    frame: gpd.GeoDataFrame,
    cloud: Cloud,
    predictor: Predictor | None,
    tile: str,
    config: Reconstruct,
    progress: Callable[[int], object] = lambda num_done: None,
) -> list[Result]:
    """One result per row of ``frame``, in its order.

    frame: what :func:`p2wss.data.footprints.clean_footprints` or :func:`p2wss.reconstruct.registration.register`
    returns. With a network its values are fitted to the
    points, unless ``config.fit`` is off; without a network buildings are only fitted. progress: called from time to
    time with the number of rows that are done.
    """
    polygons = polygon_arrays.to_polygons(frame.geometry.to_numpy())
    cropped = crop_cloud(cloud, polygons, config.buffer_m)
    origin_xy_m = polygon_arrays.origins(polygons)
    names, status = frame["building_id"].to_numpy(), frame["status"].to_numpy()
    results: list[Result] = []
    for first in range(0, len(frame), _BATCH):
        buildings = []
        rows = range(first, min(first + _BATCH, len(frame)))
        for i in rows:
            point = _in_order(cloud, cropped.of(i))
            xyz_m = np.column_stack([cloud.x_m[point], cloud.y_m[point], cloud.z_m[point]])
            buildings.append(
                Building(
                    str(names[i]),
                    tile,
                    (float(origin_xy_m[i, 0]), float(origin_xy_m[i, 1])),
                    [ring - origin_xy_m[i] for ring in polygons.rings(i)],
                    on_millimetres(xyz_m, origin_xy_m[i]),
                    cloud.classification[point],
                    float(cropped.ground_z_m[i]),
                )
            )
        results += _results(buildings, [str(status[i]) for i in rows], predictor, config)
        progress(len(results))
    registrations = frame[COLUMN] if COLUMN in frame else [None] * len(frame)
    return [
        replace(result, columns=columns, registration=registration)
        for result, columns, registration in zip(results, input_columns(frame), registrations, strict=True)
    ]


def input_columns(frame: gpd.GeoDataFrame) -> list[dict[str, Any]]:
    """The values of the input's own columns, one dictionary per row, None where there is no value.

    frame: what :func:`p2wss.data.footprints.clean_footprints` returns; the columns that it adds and the geometry are
    left out.
    """
    columns = frame.columns.drop([frame.geometry.name, *_ADDED_COLUMNS], errors="ignore")
    values = pd.DataFrame(frame[columns]).astype(object)
    rows = values.where(values.notna(), None).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]


def _in_order(cloud: Cloud, point: np.ndarray) -> np.ndarray:
    """The indices sorted by the coordinates of their points, so that a building's points have the same order whatever
    else is in the cloud."""
    keys = (cloud.classification, cloud.z_m, cloud.x_m, cloud.y_m)
    return point[np.lexsort([values[point] for values in keys])]


def _results(
    buildings: Sequence[Building], status: Sequence[str], predictor: Predictor | None, config: Reconstruct
) -> list[Result]:
    """One result per building, in order. A building whose footprint has another status than "ok" is not
    reconstructed."""
    usable = [i for i, value in enumerate(status) if value == "ok"]
    reconstructions = reconstruct_buildings([buildings[i] for i in usable], predictor, config)
    by_row = dict(zip(usable, reconstructions, strict=True))
    results = []
    for i, building in enumerate(buildings):
        if i in by_row:
            results.append(_result(building, by_row[i], config))
        else:
            rejected = no_mesh(building, method_name(predictor, config), status[i])
            results.append(
                Result(rejected, "none", status[i], len(building.point_m), float("nan"), float("nan"), False)
            )
    return results


def check_overlap(results: Sequence[Result], cloud: Path, footprint_file: Path) -> None:
    """Raise :class:`InputError` if not one building has a point."""
    if not any(result.num_points for result in results):
        raise InputError(
            f"{cloud}: no point near any of the {len(results)} footprints of {footprint_file}: do they cover"
            " the same place, in the same CRS?"
        )


def _result(building: Building, reconstruction: Reconstruction, config: Reconstruct) -> Result:
    reason = None if reconstruction.status == "ok" else reconstruction.status
    status = "none" if not reconstruction.has_mesh else "ok" if reason is None else "flat"
    on_building = building.is_on_building
    residual_m = _residual_m(building.point_m[on_building], reconstruction)
    is_fitted = config.fit or reconstruction.method == FIT
    not_representable = is_fitted and status == "ok" and residual_m > config.not_representable_m
    share = _visible_share(building, on_building)
    return Result(reconstruction, status, reason, len(building.point_m), residual_m, share, not_representable)


def _residual_m(point_m: np.ndarray, reconstruction: Reconstruction) -> float:
    if not reconstruction.has_mesh or not len(point_m):
        return float("nan")
    # every k-th point, so that no random draw is needed
    point_m = point_m[:: -(-len(point_m) // _MAX_RESIDUAL_POINTS)] - np.array(
        [0, 0, reconstruction.ground_z_m]
    )
    return float(distance_to_mesh(point_m, reconstruction.vertex_m, reconstruction.triangle).mean())


def _visible_share(building: Building, on_building: np.ndarray) -> float:
    """Share of the cells with a point on the building, as ``visible_roof_share`` of the crops."""
    x_cm, y_cm = np.ascontiguousarray(np.round(building.point_m[on_building, :2].T * 100))
    rings = [np.asarray(ring, float) for ring in building.rings]
    ends = np.cumsum([0, *map(len, rings)])
    offset = np.array([0, len(x_cm)])
    share = seen_share(
        x_cm, y_cm, np.ones(len(x_cm), bool), offset, np.concatenate(rings), ends, np.array([0, len(rings)])
    )
    return float(share[0])


def summary(results: Sequence[Result]) -> str:
    """One line: how many of each status, and why.

    ``74 buildings: 72 ok, 1 flat (too-few-points: 1), 1 none (no-points: 1); 2 of them not representable``
    """
    parts = []
    for status in ("ok", "flat", "none"):
        with_status = [result for result in results if result.status == status]
        reasons = Counter(result.reason for result in with_status if result.reason)
        text = ", ".join(f"{reason}: {count}" for reason, count in sorted(reasons.items()))
        if with_status or status == "ok":
            parts.append(f"{len(with_status)} {status}" + (f" ({text})" if text else ""))
    num_flagged = sum(result.not_representable for result in results)
    flagged = f"; {num_flagged} of them not representable" if num_flagged else ""
    return f"{len(results)} buildings: " + ", ".join(parts) + flagged


def table(results: Sequence[Result], crs: pyproj.CRS) -> gpd.GeoDataFrame:
    """A row per footprint: the cleaned geometry (none if it was rejected) and the :func:`attributes`.

    ``angle_deg`` is text with one number per edge; edge i begins at vertex i of the geometry, rings in order.
    """
    rows: list[dict[str, Any]] = []
    shapes: list[shapely.Polygon | None] = []
    for result in results:
        reconstruction = result.reconstruction
        rows.append({"building_id": reconstruction.building_id, **attributes(result)})
        rings = [ring + reconstruction.origin_xy_m for ring in reconstruction.rings]
        shapes.append(shapely.Polygon(rings[0], rings[1:]) if rings else None)
    return gpd.GeoDataFrame(pd.DataFrame(rows), geometry=shapes, crs=horizontal(crs))


def input_footprints(results: Sequence[Result], crs: pyproj.CRS) -> gpd.GeoDataFrame | None:
    """A row per footprint with its cleaned polygon before the registration; None without a registration."""
    rows = [(result.reconstruction.building_id, result.registration) for result in results]
    if not any(registration for _, registration in rows):
        return None
    names = [name for name, _ in rows]
    shapes = [None if row is None or row.input_polygon.is_empty else row.input_polygon for _, row in rows]
    return gpd.GeoDataFrame({"building_id": names}, geometry=shapes, crs=horizontal(crs))


def attributes(result: Result) -> dict[str, Any]:
    """The attributes of a building, the same in every output format; None where a value is unknown."""
    reconstruction = result.reconstruction
    angles = None
    if reconstruction.angle_deg is not None:
        angles = " ".join(f"{angle:g}" for angle in np.round(reconstruction.angle_deg, 2))
    return {
        "status": result.status,
        "reason": result.reason,
        "method": reconstruction.method if reconstruction.has_mesh else None,
        "eave_height_m": _rounded(reconstruction.eave_height_m),
        "angle_deg": angles,
        "ground_z_m": _rounded(reconstruction.ground_z_m),
        "confidence": _rounded(reconstruction.confidence),
        "residual_m": _rounded(result.residual_m),
        "not_representable": result.not_representable,
        "visible_share": _rounded(result.visible_share),
        "num_points": result.num_points,
        "num_parts": reconstruction.num_parts if reconstruction.has_mesh else None,
        "num_triangles": len(reconstruction.triangle),
        **_registration_attributes(result.registration),
    }


def _registration_attributes(registration: Registration | None) -> dict[str, Any]:
    if registration is None:
        return dict.fromkeys(("shift_x_m", "shift_y_m", "shift_sd_m", "rotation_deg", "shift_source"))
    return {
        "shift_x_m": _rounded(registration.shift_m[0]),
        "shift_y_m": _rounded(registration.shift_m[1]),
        "shift_sd_m": _rounded(registration.shift_sd_m),
        "rotation_deg": _rounded(registration.rotation_deg),
        "shift_source": registration.source,
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), 3)


def city_json(results: Sequence[Result], crs: pyproj.CRS, output: str = "cityjsonseq") -> str:
    """All buildings as a CityJSON text sequence, or as one document for the output ``cityjson``. A building without a
    mesh has no geometry."""
    epsg = crs.to_epsg() or horizontal(crs).to_epsg()
    ordered = sorted(results, key=lambda result: not result.reconstruction.has_mesh)
    solids = [solid(result) for result in ordered]
    if output == "cityjson":
        return cityjson.document(solids, epsg) + "\n"
    return "\n".join(cityjson.lines(solids, epsg)) + "\n"


def vertices_m(reconstruction: Reconstruction) -> np.ndarray:
    """Mesh vertices in the CRS of the cloud, (v, 3)."""
    return reconstruction.vertex_m + np.array([*reconstruction.origin_xy_m, reconstruction.ground_z_m])


def solid(result: Result) -> Solid:
    """The building for CityJSON, its triangles merged into planar polygons."""
    reconstruction = result.reconstruction
    if not reconstruction.has_mesh:
        return Solid(reconstruction.building_id, np.zeros((0, 3)), [], attributes(result))
    mesh = labelled_mesh(reconstruction)
    surfaces, _ = surfaces_to_write(mesh)
    return Solid(reconstruction.building_id, mesh.vertex_m, surfaces, attributes(result))
