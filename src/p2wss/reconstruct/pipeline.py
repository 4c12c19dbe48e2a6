"""Stage 9, reconstruct: from the user's own footprints and LiDAR to closed buildings, each with a status."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import geopandas as gpd
import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from p2wss.clouds.cropping import seen_share
from p2wss.clouds.crops import CloudCrops, crop_cloud
from p2wss.clouds.points import on_millimetres
from p2wss.clouds.reading import GPS_EPOCH, Cloud
from p2wss.config import Reconstruct
from p2wss.data import polygon_arrays
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.data.terrain import Terrain
from p2wss.errors import InputError
from p2wss.fit.roof_edges import mean_overhang_m
from p2wss.mesh import Mesh
from p2wss.mesh.surface import distance_to_mesh
from p2wss.reconstruct.measures import MeshMeasures, measure, party_wall_areas_m2
from p2wss.reconstruct.network import Predictor
from p2wss.reconstruct.product import FIT, method_name, reconstruct_buildings
from p2wss.reconstruct.registration import Registration
from p2wss.reconstruct.spool import Lazy
from p2wss.skeleton.types import Polygons

# a residual is the mean over at most this many points
_MAX_RESIDUAL_POINTS = 2048
# of the share of points near the mesh
_NEAR_M = 0.2
# columns that reading and cleaning add to the input's own
_ADDED_COLUMNS = ("building_id", "stated_height_m", "status", "centre_x_m", "centre_y_m")
# number of buildings between two reports of progress
_BATCH = 256
# whose ground is that of a building without points
_NUM_NEIGHBOURS = 5


@dataclass(frozen=True)
class Result:
    """A building of the output: its reconstruction, its points and how well the mesh fits them.

    status: ``ok``, ``flat`` (a flat roof instead, for ``reason``) or ``none`` (no mesh, for ``reason``).
    residual_m: mean distance of the points on the building to the mesh; NaN without any. visible_share: share of the
    footprint's 1 m cells that have a point on the building. not_representable: the building was fitted, but the
    residual is more than ``not_representable_m``. columns: values of the footprint's input columns by their names, None
    where there is no value. registration: how the footprint was moved, None without a registration. rmse_m,
    share_within_20cm: of the same distances as the residual. is_reliable: a reconstruction that the points support.
    party_wall_area_m2: of the walls that stand against other buildings of the run. dates: the first and the last day of
    its points; None if unknown. overhang_m: how far roofs reach beyond the edges of the footprint, the mean over the
    length of those where points show it, negative where they end within; NaN where none shows it.
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
    rmse_m: float = float("nan")
    share_within_20cm: float = float("nan")
    is_reliable: bool = False
    party_wall_area_m2: float = 0.0
    dates: tuple[date, date] | None = None
    overhang_m: float = float("nan")

    @cached_property
    def mesh_measures(self) -> MeshMeasures:
        """Of the mesh, which must exist: several outputs ask for them."""
        return measure(self.reconstruction.placed_mesh)


def run(
    frame: gpd.GeoDataFrame,
    cloud: Cloud,
    predictor: Predictor | None,
    tile: str,
    config: Reconstruct,
    progress: Callable[[int], object] = lambda num_done: None,
    terrain: Terrain | None = None,
    registrations: Sequence[Registration | None] | None = None,
) -> list[Result]:
    """One result per row of ``frame``, in its order.

    frame: what :func:`p2wss.footprints.cleaning.clean_footprints` or :func:`p2wss.reconstruct.registration.register`
    returns. With a network its values are fitted to the
    points, unless ``config.fit`` is off; without a network buildings are only fitted. progress: called from time to
    time with the number of rows that are done. terrain: ground of buildings without points that stand at the height
    that their footprint states; else it is that of the neighbourhood. registrations: of each row, what moved it.
    """
    results: dict[int, Result] = {}
    rows = Rows(len(frame), results, predictor, tile, config, terrain)
    rows.reconstruct(np.arange(len(frame)), frame, cloud, progress, registrations)
    rows.finish()
    return [results[number] for number in range(len(frame))]


class Store(Protocol):
    """Results by number: a dictionary, or a :class:`p2wss.reconstruct.spool.Spool`."""

    def __getitem__(self, index: int, /) -> Result: ...

    def __setitem__(self, index: int, value: Result, /) -> None: ...


class Rows:
    """The rows of a run, reconstructed part by part, and at the end what depends on several parts.

    num_rows: of the run. results: where they are stored. The other arguments are those of :func:`run`.
    """

    def __init__(
        self,
        num_rows: int,
        results: Store,
        predictor: Predictor | None,
        tile: str,
        config: Reconstruct,
        terrain: Terrain | None = None,
    ) -> None:
        self._num_rows, self._results = num_rows, results
        self._predictor, self._tile = predictor, tile
        self._config, self._terrain = config, terrain
        self._origin_xy_m = np.full((num_rows, 2), np.nan)
        # of buildings with points
        self._ground_z_m = np.full(num_rows, np.nan)
        # buildings without points whose ground is that of others
        self._pending: list[tuple[int, Building, str, dict[str, Any]]] = []

    def reconstruct(
        self,
        numbers: np.ndarray,
        frame: gpd.GeoDataFrame,
        cloud: Cloud,
        progress: Callable[[int], object] = lambda num_done: None,
        registrations: Sequence[Registration | None] | None = None,
    ) -> None:
        """Reconstruct the rows of a frame. numbers: of each in the results. cloud: all points within
        64 m of them. progress: called with the number of rows of the frame that are done. registrations: of each row,
        what moved it."""
        polygons = polygon_arrays.to_polygons(frame.geometry.to_numpy())
        cropped = crop_cloud(cloud, polygons, self._config.buffer_m)
        origin_xy_m = polygon_arrays.origins(polygons)
        stated_height_m = frame.get("stated_height_m", pd.Series(np.nan, index=frame.index)).to_numpy(
            np.float64
        )
        ground_z_m, is_pending = _ground_z_m(cropped, polygons, self._terrain)
        self._origin_xy_m[numbers] = origin_xy_m
        self._ground_z_m[numbers] = np.where(np.diff(cropped.offset) > 0, ground_z_m, np.nan)
        names, status = frame["building_id"].to_numpy(), frame["status"].to_numpy()
        registrations = [None] * len(frame) if registrations is None else registrations
        facts: list[dict[str, Any]] = [
            {"columns": columns, "registration": registration}
            for columns, registration in zip(input_columns(frame), registrations, strict=True)
        ]
        for first in range(0, len(frame), _BATCH):
            batch: list[tuple[int, Building, str, dict[str, Any]]] = []
            for i in range(first, min(first + _BATCH, len(frame))):
                point = _in_order(cloud, cropped.of(i))
                facts[i]["dates"] = _dates(cloud, point)
                xyz_m = np.column_stack([cloud.x_m[point], cloud.y_m[point], cloud.z_m[point]])
                building = Building(
                    str(names[i]),
                    self._tile,
                    (float(origin_xy_m[i, 0]), float(origin_xy_m[i, 1])),
                    [ring - origin_xy_m[i] for ring in polygons.rings(i)],
                    on_millimetres(xyz_m, origin_xy_m[i]),
                    cloud.classification[point],
                    float(ground_z_m[i]),
                    float(stated_height_m[i]),
                )
                row = (int(numbers[i]), building, str(status[i]), facts[i])
                (self._pending if is_pending[i] else batch).append(row)
            self._store(batch)
            progress(min(first + _BATCH, len(frame)))

    def finish(self) -> None:
        """Reconstruct the buildings whose ground is the median of the nearest ones with points, and measure party
        walls."""
        known = np.flatnonzero(np.isfinite(self._ground_z_m))
        tree = cKDTree(self._origin_xy_m[known]) if len(known) else None
        for k, (number, building, status, facts) in enumerate(self._pending):
            if tree is not None:
                nearest = tree.query(
                    building.origin_xy_m, np.arange(1, min(_NUM_NEIGHBOURS, len(known)) + 1)
                )[1]
                ground_z_m = float(np.median(self._ground_z_m[known][nearest]))
                self._pending[k] = (number, replace(building, ground_z_m=ground_z_m), status, facts)
        for first in range(0, len(self._pending), _BATCH):
            self._store(self._pending[first : first + _BATCH])
        meshes = Lazy(self._placed_mesh, range(self._num_rows))
        area_m2 = party_wall_areas_m2(meshes)
        for number in np.flatnonzero(area_m2).tolist():
            self._set(number, replace(self._results[number], party_wall_area_m2=float(area_m2[number])))

    def _placed_mesh(self, number: int) -> Mesh | None:
        reconstruction = self._results[number].reconstruction
        return reconstruction.placed_mesh if reconstruction.has_mesh else None

    def _store(self, rows: Sequence[tuple[int, Building, str, dict[str, Any]]]) -> None:
        buildings = [building for _, building, _, _ in rows]
        results = _results(buildings, [status for _, _, status, _ in rows], self._predictor, self._config)
        for (number, _, _, facts), result in zip(rows, results, strict=True):
            self._set(number, replace(result, **facts))

    def _set(self, number: int, result: Result) -> None:
        if result.reconstruction.has_mesh:
            _ = result.mesh_measures  # stored with the result, as several outputs ask for them
        self._results[number] = result


def _ground_z_m(
    cropped: CloudCrops, polygons: Polygons, terrain: Terrain | None
) -> tuple[np.ndarray, np.ndarray]:
    """(the ground of each building, whether it is that of others). Of those without points it is the mean of the
    terrain at the vertices of the footprint, else what ground the cloud has nearby, else that of others."""
    result = cropped.ground_z_m.copy()
    is_pending = (np.diff(cropped.offset) == 0) & (np.diff(polygons.vertex_offset) > 0)
    if terrain is not None:
        for i in np.flatnonzero(is_pending):
            x_m, y_m = polygons.xy_m[polygons.vertex_offset[i] : polygons.vertex_offset[i + 1]].T
            height_m = terrain.interpolated(x_m, y_m)
            if np.isfinite(height_m).any():
                result[i] = np.nanmean(height_m)
    return result, is_pending & np.isnan(result)


def input_columns(frame: gpd.GeoDataFrame) -> list[dict[str, Any]]:
    """The values of the input's own columns, one dictionary per row, None where there is no value.

    frame: what :func:`p2wss.footprints.cleaning.clean_footprints` returns; the columns that it adds and the
    geometry are left out.
    """
    columns = frame.columns.drop([frame.geometry.name, *_ADDED_COLUMNS], errors="ignore")
    values = pd.DataFrame(frame[columns]).astype(object)
    rows = values.where(values.notna(), None).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]


def _dates(cloud: Cloud, point: np.ndarray) -> tuple[date, date] | None:
    day = np.zeros(0, np.uint16) if cloud.day is None else cloud.day[point]
    day = day[day > 0]
    if not len(day):
        return None
    return GPS_EPOCH + timedelta(int(day.min())), GPS_EPOCH + timedelta(int(day.max()))


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
        raise InputError(no_overlap(len(results), cloud, footprint_file))


def no_overlap(num_footprints: int, cloud: Path, footprint_file: Path) -> str:
    """The message where clouds and footprints do not overlap."""
    return (
        f"{cloud}: no point near any of the {num_footprints} footprints of {footprint_file}: do they cover"
        " the same place, in the same CRS?"
    )


def _result(building: Building, reconstruction: Reconstruction, config: Reconstruct) -> Result:
    reason = None if reconstruction.status == "ok" else reconstruction.status
    status = "none" if not reconstruction.has_mesh else "ok" if reason is None else "flat"
    on_building = building.is_on_building
    distance_m = _distances_m(building.point_m[on_building], reconstruction)
    residual_m = rmse_m = share_within_20cm = float("nan")
    if len(distance_m):
        residual_m, rmse_m = float(distance_m.mean()), float(np.sqrt((distance_m**2).mean()))
        share_within_20cm = float((distance_m <= _NEAR_M).mean())
    is_fitted = config.fit or reconstruction.method == FIT
    is_far = residual_m > config.not_representable_m
    visible_share = _visible_share(building, on_building)
    overhang_m = float("nan")
    if building.rings:
        overhang_m = mean_overhang_m(building.rings[0], building.point_m, building.classification)
    return Result(
        reconstruction,
        status,
        reason,
        len(building.point_m),
        residual_m,
        visible_share,
        is_fitted and status == "ok" and is_far,
        rmse_m=rmse_m,
        share_within_20cm=share_within_20cm,
        overhang_m=overhang_m,
        is_reliable=status == "ok" and len(distance_m) > 0 and not is_far and visible_share >= 0.5,
    )


def _distances_m(point_m: np.ndarray, reconstruction: Reconstruction) -> np.ndarray:
    """Distances of points on the building to its mesh; none without both."""
    mesh = reconstruction.mesh
    if mesh is None or not len(point_m):
        return np.zeros(0)
    # every k-th point, so that no random draw is needed
    point_m = point_m[:: -(-len(point_m) // _MAX_RESIDUAL_POINTS)] - np.array(
        [0, 0, reconstruction.ground_z_m]
    )
    return distance_to_mesh(point_m, mesh.vertex_m, mesh.triangle)


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
    reasons: dict[str, Counter[str]] = {status: Counter() for status in ("ok", "flat", "none")}
    num_with_status: Counter[str] = Counter()
    num_flagged = 0
    for result in results:
        num_with_status[result.status] += 1
        reasons[result.status].update(filter(None, [result.reason]))
        num_flagged += result.not_representable
    parts = []
    for status, of_status in reasons.items():
        text = ", ".join(f"{reason}: {count}" for reason, count in sorted(of_status.items()))
        if num_with_status[status] or status == "ok":
            parts.append(f"{num_with_status[status]} {status}" + (f" ({text})" if text else ""))
    flagged = f"; {num_flagged} of them not representable" if num_flagged else ""
    return f"{len(results)} buildings: " + ", ".join(parts) + flagged
