"""An area of any size, reconstructed batch by batch: memory holds the points of one batch.

A batch is some of the footprints, together with the footprints on which their registration depends, and the points
around all of these. So a building is the same in any batch, in any tile, and alone.
"""

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import shapely

from p2wss.clouds.crops import GROUND_REACH_M
from p2wss.clouds.reading import Cloud
from p2wss.config import Config, Reconstruct, Scenes
from p2wss.data import reasons
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS
from p2wss.data.tiling import Bounds, grown, tiles_of_points
from p2wss.footprints.cleaning import clean_footprints, read_footprints, uncleaned_footprints
from p2wss.footprints.coverage import block_numbers
from p2wss.footprints.limits import repaired
from p2wss.reconstruction.inputs import Inputs
from p2wss.reconstruction.pipeline import Part, Rows
from p2wss.reconstruction.points.cloud_index import CloudIndex
from p2wss.reconstruction.registration.register import (
    CLASSES,
    OWN_BUILDINGS,
    OWN_CLASSES,
    STAYS,
    Registration,
    Surroundings,
    register,
)
from p2wss.reconstruction.registration.shifts import MAX_SHIFT_M
from p2wss.reconstruction.running.failures import note, surviving
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError, log

# a building depends on points up to this far from its footprint, which may move and turn
MARGIN_M = GROUND_REACH_M + 2 * MAX_SHIFT_M
# a footprint that only takes part in the registration of others depends on points up to this far from it
_AROUND_MARGIN_M = 16.0
# footprints this near may share walls
_BESIDE_M = 0.5
# limits of a batch: points within the margin of its footprints, and its footprints without further ones around
MAX_POINTS = 3_000_000
MAX_FOOTPRINTS = 500
# column: the number of a footprint in its file
_NUMBER = "p2wss_number"


class Area:
    """Footprints to reconstruct, and the footprints around on which they depend.

    features: all footprints, as :func:`p2wss.footprints.cleaning.clean_footprints` returns them. is_chosen: bool
    (footprints,), whether the result is requested. is_built: bool (footprints,), whether the footprint is chosen or may
    share walls with a chosen one.
    """

    def __init__(self, features: Features, is_chosen: np.ndarray, config: Reconstruct) -> None:
        self.features, self.is_chosen = features, is_chosen
        shapes = features.geometry
        self._box = shapely.bounds(shapes)
        self._surroundings = None if config.registration == "never" else Surroundings(shapes)
        self.is_built = is_chosen | self._beside(is_chosen)
        self._is_around = self._around(self.is_built)

    @property
    def numbers(self) -> np.ndarray:
        """Rows of the footprints to build, the chosen ones first."""
        chosen, beside = np.flatnonzero(self.is_chosen), np.flatnonzero(self.is_built & ~self.is_chosen)
        return np.concatenate([chosen, beside])

    @property
    def boxes(self) -> np.ndarray:
        """Boxes in which points are needed, float64 (n, 4): x_min, y_min, x_max and y_max."""
        return self._boxes(self.is_built, self._is_around)

    def batches(self, points: CloudIndex) -> Iterator[np.ndarray]:
        """The footprints to build in compact batches: the ascending rows of each batch."""
        centre = np.nan_to_num((self._box[:, :2] + self._box[:, 2:]) / 2)
        pending = [np.flatnonzero(self.is_built)]
        while pending:
            rows = pending.pop()
            num_points = points.count(_grown(self._box[rows], MARGIN_M))
            is_small = len(rows) <= MAX_FOOTPRINTS and num_points <= MAX_POINTS
            if is_small or len(rows) < 2:
                if len(rows):
                    yield np.sort(rows)
                continue
            axis = int(np.ptp(centre[rows], axis=0).argmax())
            rows = rows[np.argsort(centre[rows, axis], kind="stable")]
            pending += [rows[len(rows) // 2 :], rows[: len(rows) // 2]]

    def read(
        self, rows: np.ndarray, points: CloudIndex, registers: np.ndarray
    ) -> tuple[Features, list[Registration | None], Cloud]:
        """(the footprints ``rows`` as registered, the registration of each or None, the points around them).

        registers: int8 (footprints,), whether each footprint may be moved, as :meth:`registers` returns it.
        """
        is_row = np.zeros(len(self.features), bool)
        is_row[rows] = True
        is_around = self._around(is_row)
        cloud = points.near(self._boxes(is_row, is_around))
        around = self.features.take(is_around)
        may_move = registers[is_around] != STAYS
        done: dict[int, Registration] = {}
        if may_move.any() and self._surroundings is not None:
            registered, registrations = register(around.take(may_move), cloud, registers[is_around][may_move])
            done = dict(zip(np.flatnonzero(may_move).tolist(), registrations, strict=True))
            geometry = around.geometry.copy()
            geometry[may_move] = registered.geometry
            around = replace(around, geometry=geometry)
        chosen = np.flatnonzero(is_row[is_around])
        return around.take(chosen), [done.get(k) for k in chosen.tolist()], cloud

    def registers(self, points: CloudIndex) -> np.ndarray:
        """int8 (footprints,): whether each footprint may be moved, and by which evidence. It is :data:`CLASSES` in
        blocks around which the producer has classified buildings, else :data:`OWN_BUILDINGS` where it has classified
        ground, else :data:`OWN_CLASSES`: the classes of :mod:`p2wss.reconstruction.points.unclassified` are weaker
        evidence. All are :data:`STAYS` without registration."""
        if self._surroundings is None:
            return np.full(len(self.features), STAYS, np.int8)
        has_ground, has_buildings = (
            self._surroundings.whole_blocks(points.has_points(*self._centre_m(), number))
            for number in (GROUND_CLASS, BUILDING_CLASS)
        )
        own = np.where(has_ground, OWN_BUILDINGS, OWN_CLASSES)
        return np.where(has_buildings, CLASSES, own).astype(np.int8)

    def missing_classes(self, points: CloudIndex) -> tuple[int, int, int]:
        """Three numbers of chosen footprints with points around them: without a point of class ground, without a point
        of class building, and all."""
        x_m, y_m = self._centre_m()
        x_m, y_m = x_m[self.is_chosen], y_m[self.is_chosen]
        has_points = points.has_points(x_m, y_m)
        num_missing = [
            int((has_points & ~points.has_points(x_m, y_m, number)).sum())
            for number in (GROUND_CLASS, BUILDING_CLASS)
        ]
        return num_missing[0], num_missing[1], int(has_points.sum())

    def _centre_m(self) -> tuple[np.ndarray, np.ndarray]:
        return self.features["centre_x_m"], self.features["centre_y_m"]

    def _around(self, is_row: np.ndarray) -> np.ndarray:
        return is_row if self._surroundings is None else self._surroundings.around(is_row)

    def _beside(self, is_row: np.ndarray) -> np.ndarray:
        """bool (footprints,): the rows, and the footprints that touch one of them or may do so after the
        registration."""
        if is_row.all():
            return is_row
        present = np.flatnonzero(np.isfinite(self._box[:, 0]))
        boxes = np.asarray(shapely.box(*self._box[present].T))
        near = shapely.STRtree(boxes).query(boxes[is_row[present]], predicate="dwithin", distance=_BESIDE_M)[
            1
        ]
        result = np.zeros(len(is_row), bool)
        result[present[near]] = True
        # each block moves on its own
        return result if self._surroundings is None else result & self._surroundings.whole_blocks(is_row)

    def _boxes(self, is_row: np.ndarray, is_around: np.ndarray) -> np.ndarray:
        rows = _grown(self._box[is_row], MARGIN_M)
        return np.concatenate([rows, _grown(self._box[is_around & ~is_row], _AROUND_MARGIN_M)])


def run_area(
    area: Area,
    points: CloudIndex,
    rows: Rows,
    registers: np.ndarray,
    progress: Callable[[int], object] = lambda num_done: None,
) -> None:
    """Reconstruct the footprints ``area.numbers`` into ``rows``, in this order.

    points: all points in ``area.boxes``. registers: see :meth:`Area.read`. progress: called with the number of results.
    """
    position = np.empty(len(area.features), np.int64)
    position[area.numbers] = np.arange(len(area.numbers))

    def prepared(some: np.ndarray, registers: np.ndarray) -> list[Part]:
        features, registrations, cloud = area.read(some, points, registers)
        log.debug("batch of %d buildings: %d points around them", len(some), len(cloud.x_m))
        return [rows.prepared(position[some], features, cloud, registrations)]

    def unregistered(row: int, trace: str) -> list[Part]:
        some = np.array([row])
        found = surviving(
            lambda some: prepared(some, np.full_like(registers, STAYS)), some, lambda row, trace: []
        )
        if found:
            note(f"registration of {area.features['building_id'][row]}", trace, "it stays where it is")
            return found
        (bare,) = rows.bare(position[some], area.features.take(some))
        alone = [replace(bare, status=reasons.INTERNAL_ERROR, failure=trace)]
        return [Part(alone, alone, [])]

    for batch in area.batches(points):
        for part in surviving(partial(prepared, registers=registers), batch, unregistered):
            rows.start(part, progress)
    rows.finish(int(area.is_chosen.sum()))


def _grown(box: np.ndarray, margin_m: float) -> np.ndarray:
    return box + margin_m * np.array([-1, -1, 1, 1])


def read_features(inputs: Inputs, settings: Reconstruct) -> Features:
    """The footprints of a run, in its CRS, not cleaned yet."""
    assert inputs.footprints is not None
    return read_footprints(
        inputs.footprints,
        settings.id_field or None,
        needs_crs=False,
        schema=settings.footprint_schema,
        height_field=settings.height_field or None,
        metric=inputs.metric,
        layer=settings.footprint_layer,
    )


def footprint_settings(config: Config) -> Scenes:
    """The settings with which :func:`p2wss.footprints.cleaning.clean_footprints` cleans the user's footprints: the
    section scenes, but with ``reconstruct.simplify_m``."""
    return config.scenes.model_copy(update={"simplify_m": config.reconstruct.simplify_m})


def cleaned(features: Features, config: Config) -> Features:
    """The footprints as :func:`p2wss.footprints.cleaning.clean_footprints` returns them. Where errors are met, the
    footprints of a block at which it fails stay as they are. If even that fails, they become empty with the status
    ``internal-error``.

    features: what :func:`p2wss.footprints.cleaning.read_footprints` returns."""
    settings = footprint_settings(config)

    def by_blocks(features: Features, trace: str) -> list[Features]:
        shapes = surviving(lambda some: repaired(some)[0], features.geometry, lambda *_: [shapely.Polygon()])
        block = block_numbers(np.array(shapes, object), settings.snap_m)
        rows = [features.take(block == k) for k in np.unique(block)]
        return surviving(lambda some: [clean_footprints(Features.joined(some), settings)], rows, as_they_are)

    def as_they_are(block: Features, trace: str) -> list[Features]:
        ids = block["building_id"].tolist()
        more = f" and {len(ids) - 1} of its block" if len(ids) > 1 else ""
        note(f"cleaning of {ids[0]}{more}", trace, "footprints stay as they are")
        rows = [block.take(np.array([k])) for k in range(len(block))]
        return surviving(lambda some: [uncleaned_footprints(each, settings) for each in some], rows, lost)

    def lost(row: Features, trace: str) -> list[Features]:
        unknown = np.full(1, np.nan)
        empty = replace(row, geometry=np.array([shapely.Polygon()]))
        status = np.array([reasons.INTERNAL_ERROR], object)
        return [empty.having(status=status, centre_x_m=unknown, centre_y_m=unknown)]

    numbered = features.having(**{_NUMBER: np.arange(len(features))})
    result = Features.joined(
        surviving(lambda some: [clean_footprints(each, settings) for each in some], [numbered], by_blocks)
    )
    return result.take(np.argsort(result[_NUMBER], kind="stable")).without(_NUMBER)


def window(features: Features) -> Bounds:
    """The bounds of the footprints and the ground around them, where a cloud must have points; zeros without
    footprints."""
    if not len(features):
        return 0.0, 0.0, 0.0, 0.0
    return grown(shapely.total_bounds(features.geometry).tolist(), GROUND_REACH_M)


def in_tile(features: Features, tile: str | None, tile_size_m: float) -> np.ndarray:
    """bool (footprints,): whether the centre of each footprint is in the tile; all True if ``tile`` is None."""
    if tile is None:
        return np.ones(len(features), bool)
    result = np.zeros(len(features), bool)
    x_m, y_m = features["centre_x_m"], features["centre_y_m"]
    is_known = np.isfinite(x_m)
    result[is_known] = tiles_of_points(x_m[is_known], y_m[is_known], tile_size_m) == tile
    return result


def chosen(
    features: Features,
    whole: Collection[str],
    ids: Sequence[str] | None,
    bbox: Bounds | None,
    name: str | Path,
) -> np.ndarray:
    """bool (footprints,): whether each footprint has one of these ids, and its centre in ``bbox``. The id of a split
    footprint chooses all its parts.

    ids, bbox: None does not limit. whole: ids of the footprints before they were split. bbox: (x_min, y_min, x_max,
    y_max) in the CRS of the run. name: of the footprints, for messages. Raises :class:`InputError` if ``bbox`` leaves
    no footprint, or if an id is missing.
    """
    result = np.ones(len(features), bool)
    if ids is not None:
        # a part never has the id of another footprint
        named = [
            {each} if each in whole else {each, re.sub(r"-\d+$", "", each)}
            for each in features["building_id"].tolist()
        ]
        wanted, known = set(map(str, ids)), set().union(*named)
        if missing := [each for each in map(str, ids) if each not in known]:
            raise InputError(f"{name}: has no building {missing[0]}")
        result &= [bool(each & wanted) for each in named]
    if bbox is not None:
        x_m, y_m = features["centre_x_m"], features["centre_y_m"]
        result &= (x_m >= bbox[0]) & (x_m <= bbox[2]) & (y_m >= bbox[1]) & (y_m <= bbox[3])
        if not result.any():
            numbers = ", ".join(f"{value:g}" for value in bbox)
            raise InputError(f"{name}: no footprint in {numbers}: is that in the CRS of the run, in metres?")
    return result
