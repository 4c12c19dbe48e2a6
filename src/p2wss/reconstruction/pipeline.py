"""Stage reconstruct: from the user's own footprints and LiDAR to closed buildings, each with a status."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from p2wss.clouds.crops import crop_cloud, roofs_around
from p2wss.clouds.reading import GPS_EPOCH, Cloud
from p2wss.config import Reconstruct
from p2wss.data import polygon_arrays, reasons
from p2wss.data.building import Building, no_mesh
from p2wss.data.points import on_millimetres
from p2wss.data.terrain import Terrain
from p2wss.fit.points import every_kth
from p2wss.footprints.cleaning import ADDED_COLUMNS, OF_INPUT
from p2wss.footprints.overlaps import COLUMN
from p2wss.mesh import Mesh
from p2wss.reconstruction.outputs.attributes import attributes
from p2wss.reconstruction.outputs.measures import party_wall_areas_m2
from p2wss.reconstruction.points.ground import BUILDINGS, ground_of
from p2wss.reconstruction.points.own_points import with_own_classes
from p2wss.reconstruction.product import Predictor, flat_roofs, method_name, reconstruct_buildings
from p2wss.reconstruction.registration.register import Registration
from p2wss.reconstruction.result import Result, Row, failed, result_of
from p2wss.reconstruction.roof_lines import LINES
from p2wss.reconstruction.running.failures import met, note, surviving
from p2wss.reconstruction.running.processes import Shared
from p2wss.reconstruction.running.spool import Lazy, Spool
from p2wss.skeleton.nearest import nearest
from p2wss.storage.features import Features
from p2wss.storage.messages import log

# column: whether a footprint is an outline of points to which p2wss, not the producer, gave class building
OWN_OUTLINE = "p2wss_own_outline"
# columns that p2wss adds to the columns of the input
_ADDED_COLUMNS = (*ADDED_COLUMNS, LINES, OWN_OUTLINE)
# a network reconstructs this many buildings together, which is faster
_NETWORK_BATCH = 256
# at most this many points on the roofs around a building are kept: enough to show planes
_MAX_AROUND = 200
# a building without points gets the ground of this many nearest buildings
_NUM_NEIGHBOURS = 5
# this process loads the compiled code with the smallest one of this many rows
_NUM_TO_LEARN = 8


def run(
    features: Features,
    cloud: Cloud,
    predictor: Predictor | None,
    tile: str,
    config: Reconstruct,
    progress: Callable[[int], object] = lambda num_done: None,
    terrain: Terrain | None = None,
    registrations: Sequence[Registration | None] | None = None,
) -> list[Result]:
    """One result per feature, in their order.

    features: what :func:`p2wss.footprints.cleaning.clean_footprints` returns. predictor: the network that predicts the
    buildings; with None, they are fitted to the points. progress: called from time to time with the number of rows that
    are done. terrain: the ground of buildings without points, which are built if their footprint states a height, and
    of buildings around which the ground is unseen or too high; without it, buildings without points get the ground of
    the nearest buildings. registrations: what moved the footprint of each row.
    """
    results: dict[int, Any] = {}
    rows = Rows(len(features), results, predictor, tile, config, terrain)
    rows.start(rows.prepared(np.arange(len(features)), features, cloud, registrations), progress)
    rows.finish()
    return [results[number] for number in range(len(features))]


# the number of a row, its result, and the time that it took, seconds
_Done = tuple[int, Result, float]


@dataclass(frozen=True)
class Part:
    """Some rows of a run. rows: with their points. bare: the same rows without points. pending: further rows that have
    neither points nor terrain, and get the ground of the nearest buildings of the run."""

    rows: Sequence[Row]
    bare: Sequence[Row]
    pending: list[Row]


class Rows:
    """The rows of a run, reconstructed part by part. What depends on several parts is computed at the end. With several
    processes, forks reconstruct a part while this process prepares the next part.

    num_rows: number of rows of the run. results: where the results are stored, by number of row; with
    ``config.max_triangles`` it needs ``2 * num_rows`` places, for rows that may be reconstructed once more.
    num_processes: how many processes fit; a fork may crash at a building without ending the run. With 0, or with a
    network, whose threads a fork would lack, this process does all. folder: for temporary files. Other arguments: see
    :func:`run`.

    Where errors are met (:mod:`p2wss.reconstruction.running.failures`), a building at which the code fails has the
    reason ``internal-error``, and a flat roof if one can be built.
    """

    def __init__(
        self,
        num_rows: int,
        results: dict[int, Any] | Spool[Any],
        predictor: Predictor | None,
        tile: str,
        config: Reconstruct,
        terrain: Terrain | None = None,
        num_processes: int = 0,
        folder: Path | None = None,
    ) -> None:
        self._num_rows, self._results, self._folder = num_rows, results, folder
        self._num_processes = num_processes if predictor is None else 0
        self._predictor, self._tile = predictor, tile
        self._config, self._terrain = config, terrain
        self._batch = 1 if predictor is None else _NETWORK_BATCH
        # the part that is computed now, the number of rows that are done, and what is called with that number
        self._current: Iterable[tuple[int, list[_Done]]] = ()
        self._num_done = 0
        self._progress: Callable[[int], object] = lambda num_done: None
        # the part that was computed before, and whether this process has repeated a row of a part
        self._before: Sequence[Row] = ()
        self._has_learnt = False
        self._origin_xy_m = np.full((num_rows, 2), np.nan)
        # NaN of buildings without points
        self._ground_z_m = np.full(num_rows, np.nan)
        # buildings that get the ground of the nearest buildings
        self._pending: list[Row] = []

    def bare(
        self,
        numbers: np.ndarray,
        features: Features,
        registrations: Sequence[Registration | None] | None = None,
    ) -> Lazy[int, Row]:
        """The features as rows without points. numbers: the number of each row in the results."""
        polygons = polygon_arrays.to_polygons(features.geometry)
        origin_xy_m, columns = polygon_arrays.origins(polygons), input_columns(features)
        names, status = features["building_id"].tolist(), features["status"].tolist()
        unknown = np.full(len(features), np.nan)
        stated_height_m = features.columns.get("stated_height_m", unknown).tolist()
        lines = features.columns.get(LINES)
        is_own = features.columns.get(OWN_OUTLINE, np.zeros(len(features), bool)).tolist()

        def row(i: int) -> Row:
            registration = None if registrations is None else registrations[i]
            # lines have not moved with the footprint
            before_m = origin_xy_m[i] - (np.zeros(2) if registration is None else registration.shift_m)
            building = Building(
                names[i],
                self._tile,
                (float(origin_xy_m[i, 0]), float(origin_xy_m[i, 1])),
                [ring - origin_xy_m[i] for ring in polygons.rings(i)],
                np.zeros((0, 3)),
                np.zeros(0, np.uint8),
                float("nan"),
                stated_height_m[i],
                line_m=None if lines is None else lines[i] - before_m,
            )
            return Row(
                int(numbers[i]), building, status[i], columns[i], registration, is_own_outline=is_own[i]
            )

        return Lazy(row, range(len(features)))

    def prepared(
        self,
        numbers: np.ndarray,
        features: Features,
        cloud: Cloud,
        registrations: Sequence[Registration | None] | None = None,
    ) -> Part:
        """The features as rows with points. numbers: the number of each row in the results. cloud: all points within
        64 m of the features. registrations: what moved each footprint."""
        polygons = polygon_arrays.to_polygons(features.geometry)
        cropped = crop_cloud(cloud, polygons, self._config.buffer_m)
        around = roofs_around(cloud, polygons, cropped)
        ground = ground_of(cloud, cropped, polygons, self._terrain)
        ground_z_m = ground.z_m
        is_pending = np.isnan(ground_z_m) & (np.diff(polygons.vertex_offset) > 0)
        bare = self.bare(numbers, features, registrations)

        def with_points(i: int) -> Row:
            row, point = bare[i], _in_order(cloud, cropped.of(i))
            beside = _in_order(cloud, around.get(i, point[:0]))
            beside = beside[every_kth(len(beside), _MAX_AROUND)]
            position_m = (*row.building.origin_xy_m, ground_z_m[i])
            building = replace(
                row.building,
                point_m=_local(cloud, point, position_m),
                classification=cloud.classification[point],
                ground_z_m=float(ground_z_m[i]),
                around_m=_local(cloud, beside, position_m),
            )
            source = (str(ground.source[i]), float(ground.sd_m[i])) if np.isfinite(ground_z_m[i]) else None
            return replace(row, building=building, dates=_dates(cloud, point), ground=source)

        def without(i: int, trace: str) -> list[Row]:
            return [replace(bare[i], status=reasons.INTERNAL_ERROR, failure=trace)]

        def row(i: int) -> Row:
            return surviving(lambda some: map(with_points, some), [i], without)[0]

        others = np.flatnonzero(~is_pending).tolist()
        pending = [row(i) for i in np.flatnonzero(is_pending).tolist()]
        self._origin_xy_m[numbers] = polygon_arrays.origins(polygons)
        self._ground_z_m[numbers] = np.where(np.diff(cropped.offset) > 0, ground_z_m, np.nan)
        return Part(Lazy(row, others), Lazy(bare.__getitem__, others), pending)

    def start(self, part: Part, progress: Callable[[int], object] = lambda num_done: None) -> None:
        """Reconstruct the rows of a part. With several processes, it goes on until the next call of this method or of
        :meth:`finish`. progress: called with the number of rows that are done in all parts."""
        self._pending += part.pending
        self._progress = progress
        self._start(part.rows, part.bare)
        if self._num_processes <= 1:
            self._complete()

    def finish(self, num_counted: int | None = None) -> None:
        """Complete the results. Pending buildings are reconstructed on the median ground of the nearest buildings with
        points. Then triangles are saved, and party walls measured. num_counted: ``config.max_triangles`` limits the
        triangles of this many first rows; None for all rows."""
        self._complete()
        known = np.flatnonzero(np.isfinite(self._ground_z_m))
        if len(known) and self._pending:
            place_m = np.array([row.building.origin_xy_m for row in self._pending])
            _, beside = nearest(self._origin_xy_m[known], place_m, min(_NUM_NEIGHBOURS, len(known)))
            for k, near_z_m in enumerate(self._ground_z_m[known][beside]):
                row, ground = self._pending[k], (BUILDINGS, float(np.std(near_z_m)))
                building = replace(row.building, ground_z_m=float(np.median(near_z_m)))
                self._pending[k] = replace(row, building=building, ground=ground)
        self._start(self._pending, self._pending)
        self._complete()
        if self._config.max_triangles is not None:
            self._save_triangles(
                self._config.max_triangles, self._num_rows if num_counted is None else num_counted
            )
        meshes = Lazy(self._placed_mesh, range(self._num_rows))

        def unknown(meshes: Lazy[int, Mesh | None], trace: str) -> list[np.ndarray]:
            note("areas of party walls", trace, "they are unknown")
            return [np.full(self._num_rows, np.nan)]

        (area_m2,) = surviving(lambda some: map(party_wall_areas_m2, some), [meshes], unknown)
        for number in np.flatnonzero(area_m2).tolist():
            self._results[number] = replace(self._results[number], party_wall_area_m2=float(area_m2[number]))

    def _save_triangles(self, max_triangles: int, num_counted: int) -> None:
        """Replace results by results at low detail until there are few enough triangles. First come the buildings that
        lose least by it: the growth of the residual, times the ground area, per saved triangle."""
        excess = (
            sum(self._results[k].reconstruction.num_triangles for k in range(num_counted)) - max_triangles
        )
        if excess <= 0:
            return
        log.info("%d triangles more than reconstruct.max_triangles: once more at low detail", excess)
        low, savings = self._config.model_copy(update={"detail": "low"}), []
        rows = Lazy(self._results.__getitem__, range(self._num_rows, self._num_rows + num_counted))
        for _, done in self._shared(rows, rows, low):
            for number, simple, _ in done:
                before: Result = self._results[number]
                saved = before.reconstruction.num_triangles - simple.reconstruction.num_triangles
                if saved > 0 and before.measures is not None and not simple.failure:
                    self._results[self._num_rows + number] = simple
                    growth_m = float(np.nan_to_num(simple.residual_m - before.residual_m))
                    savings.append((growth_m * before.measures.ground_area_m2 / saved, number, saved))
        for _, number, saved in sorted(savings):
            if excess > 0:
                self._results[number] = self._results[self._num_rows + number]
                excess -= saved
        if excess > 0:
            message = "warning: %d triangles remain, more than reconstruct.max_triangles"
            log.warning(message, max_triangles + excess)

    def _placed_mesh(self, number: int) -> Mesh | None:
        reconstruction = self._results[number].reconstruction
        return reconstruction.placed_mesh if reconstruction.has_mesh else None

    def _start(self, rows: Sequence[Row], bare: Sequence[Row]) -> None:
        """Complete the part that is computed now, then let the forks begin with these rows."""
        self._complete()
        self._learn(rows)
        if self._config.max_triangles is not None:
            for row in rows:
                self._results[self._num_rows + row.number] = row
        self._current = self._shared(rows, bare, self._config)

    def _learn(self, rows: Sequence[Row]) -> None:
        """Load the compiled code into this process, so that forks have it: loading takes as long as six buildings. To
        load it, reconstruct a small row of the part before once more, one at which no fork has failed."""
        before, self._before = self._before, rows
        if not (self._num_processes and len(before) and len(rows)) or self._has_learnt:
            return
        row = min(before[:_NUM_TO_LEARN], key=lambda row: self._results[row.number].num_points)
        if not self._results[row.number].failure:
            surviving(lambda some: self._together(some, self._config), [row], lambda *_: [])
            self._has_learnt = True

    def _complete(self) -> None:
        """Complete the part that was started, and store its results."""
        for _, results in self._current:
            for number, result, seconds in results:
                self._results[number] = result
                _log_building(result, seconds)
                if result.failure:
                    instead = "it gets a flat roof" if result.reconstruction.has_mesh else "it gets no mesh"
                    note(result.reconstruction.building_id, result.failure, instead)
            self._num_done += len(results)
            self._progress(self._num_done)
        self._current = ()

    def _shared(
        self, rows: Sequence[Row], bare: Sequence[Row], config: Reconstruct
    ) -> Shared[int, list[_Done]]:
        """The results of these rows, in batches. Without a network, each row is a batch, so that the log has its time.
        bare: the same rows without points, used for a row that kills every process that tries it."""

        def part(rows: Sequence[Row], first: int) -> list[Row]:
            return list(rows[first : first + self._batch])

        def flat(first: int, trace: str) -> list[_Done]:
            return [(row.number, self._failed(row, trace, config), nan) for row in part(rows, first)]

        def without(first: int, trace: str) -> list[_Done]:
            some = [replace(row, failure=trace) for row in part(bare, first)]
            return [(row.number, failed(row, method_name(self._predictor)), nan) for row in some]

        return Shared(
            lambda first: self._done(part(rows, first), config),
            range(0, len(rows), self._batch),
            self._num_processes,
            [flat, without] if met() is not None else (),
            self._folder,
        )

    def _done(self, rows: Sequence[Row], config: Reconstruct) -> list[_Done]:
        start = time.perf_counter()
        results = surviving(
            lambda some: self._together(some, config),
            rows,
            lambda row, trace: [self._failed(row, trace, config)],
        )
        seconds = (time.perf_counter() - start) / len(rows)
        return [(row.number, result, seconds) for row, result in zip(rows, results, strict=True)]

    def _together(self, rows: Sequence[Row], config: Reconstruct) -> list[Result]:
        """The results of these rows. Points of neighbours get another class first. A row with another status than "ok"
        gets no mesh."""
        rows = [replace(row, building=with_own_classes(row.building)) for row in rows]
        usable = [row for row in rows if row.status == "ok"]
        done = reconstruct_buildings([row.building for row in usable], self._predictor, config)
        reconstructions = {row.number: each for row, each in zip(usable, done, strict=True)}
        method = method_name(self._predictor)
        results = []
        for row in rows:
            rejected = no_mesh(row.building, method, row.status)
            results.append(result_of(row, reconstructions.get(row.number, rejected), config))
            # an error in the attributes should be met here, for one building, and not where all are written
            attributes(results[-1], names=config.attribute_names)
        return results

    def _failed(self, row: Row, trace: str, config: Reconstruct) -> Result:
        """The result of a row at which the code failed: a flat roof if one can be built."""
        method, row = method_name(self._predictor), replace(row, failure=trace)

        def flat(row: Row) -> Result:
            missing = no_mesh(row.building, method, reasons.INTERNAL_ERROR)
            roofs = flat_roofs([missing], [row.building], config) if row.building.rings else [missing]
            result = result_of(row, replace(roofs[0], status=reasons.INTERNAL_ERROR), config)
            attributes(result, names=config.attribute_names)
            return result

        return surviving(lambda some: map(flat, some), [row], lambda row, _: [failed(row, method)])[0]


def input_columns(features: Features) -> list[dict[str, Any]]:
    """The values of the input's columns, one dictionary per row, None where there is no value.

    features: what :func:`p2wss.footprints.cleaning.clean_footprints` returns; columns that p2wss adds are left out.
    """
    taken = {*features.columns, COLUMN} - {*_ADDED_COLUMNS}

    def own(name: str) -> str:
        result = name.removeprefix(OF_INPUT)
        while result != name and result in taken:
            result = f"input_{result}"
        return result

    columns = {
        own(name): [None if each != each else each for each in values.tolist()]
        if values.dtype.kind == "f"
        else values.tolist()
        for name, values in features.columns.items()
        if name not in _ADDED_COLUMNS
    }
    return [{name: values[i] for name, values in columns.items()} for i in range(len(features))]


def _log_building(result: Result, seconds: float) -> None:
    building_id, reason = result.reconstruction.building_id, f" ({result.reason})" if result.reason else ""
    points = f"{result.num_points} points, {result.residual_m:.3f} m from the mesh"
    if result.registration is not None and any(result.registration.shift_m):
        points += ", footprint moved by {:+.2f}, {:+.2f} m".format(*result.registration.shift_m)
    log.debug("%s: %s%s, %s, %.2f s", building_id, result.status, reason, points, seconds)


def _dates(cloud: Cloud, point: np.ndarray) -> tuple[date, date] | None:
    day = np.zeros(0, np.uint16) if cloud.day is None else cloud.day[point]
    day = day[day > 0]
    if not len(day):
        return None
    return GPS_EPOCH + timedelta(int(day.min())), GPS_EPOCH + timedelta(int(day.max()))


def _local(cloud: Cloud, point: np.ndarray, position_m: Sequence[float]) -> np.ndarray:
    """float64 (k, 3): coordinates relative to ``position_m`` (x, y, z). point: (k,), indices into the cloud."""
    xyz_m = np.column_stack([cloud.x_m[point], cloud.y_m[point], cloud.z_m[point]])
    return on_millimetres(xyz_m, np.array(position_m[:2])) - [0.0, 0.0, position_m[2]]


def _in_order(cloud: Cloud, point: np.ndarray) -> np.ndarray:
    """The indices ``point``, sorted by y, x, z and class. So a building's points have the same order whatever else is
    in the cloud."""
    keys = (cloud.classification, cloud.z_m, cloud.x_m, cloud.y_m)
    return point[np.lexsort([values[point] for values in keys])]
