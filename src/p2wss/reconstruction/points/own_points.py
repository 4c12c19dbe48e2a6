"""Which points in a footprint are the building's? Classes of the points of a building, as its roof needs them.

Along the border to a neighbour, points in the footprint may belong to the neighbour: its roof reaches over the border,
the map has the border elsewhere, or pulses hit its wall. Planes are grown over both sides of the border. A plane is the
neighbour's if the building has it only in a strip along the border, with a step to the planes further within, and the
points beyond the border are at the same height. Returns from walls above the building's own roof are the neighbour's,
too. The same rule holds from the other side, so the order of buildings does not matter. Roofs that the producer took
for ground are found by the ground beside them, and roofs that it took for trees by their planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely

from p2wss.data.building import Building
from p2wss.data.las_classes import (
    BUILDING_CLASS,
    GROUND_CLASS,
    NEIGHBOUR_CLASS,
    NOISE_CLASSES,
    OVERLAP_CLASS,
    PERHAPS_ROOF_CLASS,
    PLANT_CLASSES,
    WATER_CLASS,
    has_class,
)
from p2wss.data.points import MIN_CLASSIFIED_SHARE, MIN_HEIGHT_M, NEVER_ON_A_BUILDING
from p2wss.fit.planes.detection import detect, distances
from p2wss.fit.points import even_order, every_kth
from p2wss.fit.settings import Detection
from p2wss.reconstruction.points.unclassified import planar
from p2wss.skeleton import ordering
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.nearest import nearest


@dataclass(frozen=True)
class Rules:
    """Which building the points at a border belong to; set by hand from drawn old towns.

    strips_m: widths of the strip along the border whose points may be a neighbour's; the first width that leaves a core
    of the footprint is used. core_m: a wing narrower than ``2 * (strip + core_m)`` has no strip, because its own roof
    looks like one. band_m: the building's own planes are taken from points within this distance of the border.
    step_m: least step between a neighbour's surface and the ``num_near`` nearest points of the building. A higher point
    is a neighbour's if the highest of the ``num_beyond`` nearest points beyond the border is at most ``step_m`` lower.
    A lower point is one if one of the ``num_near`` nearest points beyond the border is within ``step_m``. reach_m:
    points beyond the border count up to this distance. most_per_m2: planes are grown from at most this density.
    deep_share: a plane is the building's if its share of the points further within is more than this fraction of its
    share of the points in the strip. turn: planes cross if their gradients differ by more.
    beyond_share: a plane goes on beyond the border if it has more points there than this fraction of its points in the
    strip; crossing_share: the same fraction for a plane that crosses a larger one. most_share: if more than this share
    of a plane's points in the strip are as high as the points beyond, all of them count as such. roof_share: points of
    plants, or of other classes in gaps, are a roof if at least this share of them lies on planes. gap_m, gap,
    num_around: a gap of class building is farther from its points than ``gap_m``, and than ``gap`` times their median
    distance to the ``num_around`` th next one. gap_m2: a gap is filled if it has at least as many points on planes as
    class building has on this area.
    """

    strips_m: tuple[float, ...] = (1.0, 0.5)
    band_m: float = 2.5
    core_m: float = 0.3
    step_m: float = 0.5
    num_near: int = 4
    num_beyond: int = 16
    reach_m: float = 1.5
    most_per_m2: float = 6.0
    deep_share: float = 0.1
    beyond_share: float = 0.5
    turn: float = 0.15
    crossing_share: float = 0.75
    most_share: float = 0.5
    roof_share: float = 0.5
    gap_m: float = 1.5
    gap: float = 2.0
    gap_m2: float = 20.0
    num_around: int = 8


RULES = Rules()
_DETECTION = Detection()
# least distance between points, as repeated points have none
_LEAST_M = 0.05


def with_own_classes(building: Building) -> Building:
    """The building with the classes of :func:`own_classes`."""
    classes = own_classes(building.rings, building.point_m, building.classification)
    return building if classes is building.classification else replace(building, classification=classes)


def own_classes(rings: Sequence[np.ndarray], point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """The classes (m,) of points (m, 3), as the building needs them: :data:`NEIGHBOUR_CLASS` for points of another
    building, and class building for points of the roof that have another class. point_m: in and around the footprint
    ``rings``, z above the ground. Returns ``classification`` itself if nothing changes."""
    if not len(rings) or not len(point_m):
        return classification
    polygon = shapely.Polygon(rings[0], rings[1:])
    inside = shapely.contains_xy(polygon, point_m[:, 0], point_m[:, 1])
    is_roof = inside & (classification == PERHAPS_ROOF_CLASS)
    classification = (
        np.where(is_roof, np.uint8(BUILDING_CLASS), classification) if is_roof.any() else classification
    )
    result = _with_roofs_as_overlaps(inside, point_m, classification)
    result = _with_roofs_as_ground(inside, point_m, result)
    result = _with_roofs_as_plants(inside, point_m, result)
    result = _with_roofs_as_others(inside, point_m, result)
    theirs = _theirs(polygon, inside, point_m, result)
    return np.where(theirs, np.uint8(NEIGHBOUR_CLASS), result) if theirs.any() else result


def _with_roofs_as_overlaps(
    inside: np.ndarray, point_m: np.ndarray, classification: np.ndarray
) -> np.ndarray:
    """The classes (m,), with class building for points inside the footprint that have the class of overlapping flights,
    if the nearest point of another class has class building."""
    is_overlap = classification == OVERLAP_CLASS
    roof = inside & is_overlap & (point_m[:, 2] >= MIN_HEIGHT_M)
    if not roof.any() or is_overlap.all():
        return classification
    _, other = nearest(point_m[~is_overlap], point_m[roof])
    roof[roof] = classification[~is_overlap][other[:, 0]] == BUILDING_CLASS
    return np.where(roof, np.uint8(BUILDING_CLASS), classification)


def _with_roofs_as_ground(inside: np.ndarray, point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """The classes (m,), with class building for points inside the footprint that have class ground but are above the
    ground beside the building."""
    is_ground = classification == GROUND_CLASS
    roof = inside & is_ground & (point_m[:, 2] >= MIN_HEIGHT_M)
    if not roof.any():
        return classification
    beside = ~inside & is_ground
    if beside.any():
        _, ground = nearest(point_m[beside, :2], point_m[roof, :2])
        roof[roof] = point_m[roof, 2] > point_m[beside, 2][ground[:, 0]] + MIN_HEIGHT_M
    return np.where(roof, np.uint8(BUILDING_CLASS), classification)


def _with_roofs_as_plants(inside: np.ndarray, point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """The classes (m,), with class building for points inside the footprint that have a class of plants and lie on
    planes. This is done only if hardly any other points are high, and most of the points of plants lie on planes: then
    they are a roof and no crown."""
    is_high = inside & (point_m[:, 2] >= MIN_HEIGHT_M) & ~has_class(classification, NEVER_ON_A_BUILDING)
    plant = is_high & has_class(classification, PLANT_CLASSES)
    num_plant = np.count_nonzero(plant)
    if np.count_nonzero(is_high) - num_plant >= MIN_CLASSIFIED_SHARE * num_plant:
        return classification
    is_planar = planar(point_m[plant])
    if np.count_nonzero(is_planar) < RULES.roof_share * num_plant:
        return classification
    plant[plant] = is_planar
    return np.where(plant, np.uint8(BUILDING_CLASS), classification)


def _with_roofs_as_others(inside: np.ndarray, point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """The classes (m,), with class building for points inside the footprint that have another class and lie on planes
    in gaps of class building. This is done only if most points in the gaps lie on planes: then they are a part of the
    roof that the classifier missed."""
    built_m = point_m[inside & (classification == BUILDING_CLASS), :2]
    other = inside & (point_m[:, 2] >= MIN_HEIGHT_M)
    other &= ~has_class(classification, (BUILDING_CLASS, *NEVER_ON_A_BUILDING))
    if not other.any() or len(built_m) <= RULES.num_around:
        return classification
    around_m = np.median(nearest(built_m, built_m, RULES.num_around + 1)[0][:, -1])
    around_m = max(_LEAST_M, float(around_m))
    gap_m = max(RULES.gap_m, RULES.gap * around_m)
    other[other] = nearest(built_m, point_m[other, :2])[0][:, 0] > gap_m
    is_planar = planar(point_m[other])
    least = max(RULES.roof_share * len(is_planar), RULES.gap_m2 * RULES.num_around / (np.pi * around_m**2))
    if np.count_nonzero(is_planar) < least:
        return classification
    other[other] = is_planar
    return np.where(other, np.uint8(BUILDING_CLASS), classification)


class _Border(NamedTuple):
    """The points (m,) along the border of a footprint, and the planes that they show.

    is_near: in the strip along the border to a neighbour. is_deep: of the building, further within. is_beyond: outside,
    above the ground. plane: float64 (k + 1, 3), the last row, of NaN, for points on none. label: int (m,), the plane of
    each point, k for none. num_near, num_deep, num_beyond: int (k + 1,), how many of these points are on each plane.
    """

    is_near: np.ndarray
    is_deep: np.ndarray
    is_beyond: np.ndarray
    plane: np.ndarray
    label: np.ndarray
    num_near: np.ndarray
    num_deep: np.ndarray
    num_beyond: np.ndarray

    @property
    def has_plane(self) -> np.ndarray:
        """bool (m,): whether a point is on a plane."""
        return self.label < len(self.plane) - 1


def _theirs(
    polygon: shapely.Polygon, inside: np.ndarray, point_m: np.ndarray, classification: np.ndarray
) -> np.ndarray:
    """bool (m,): the points ``inside`` the footprint that belong to other buildings."""
    result = np.zeros(len(point_m), bool)
    is_solid = ~has_class(classification, (*PLANT_CLASSES, *NOISE_CLASSES, WATER_CLASS))
    is_high = is_solid & (point_m[:, 2] >= MIN_HEIGHT_M)
    border = _border_of(polygon, is_solid & inside, is_high & ~inside, point_m)
    if border is None:
        return result
    if border.is_deep.any():
        is_own, is_without_plane = _own_planes(border, point_m), border.is_deep
    else:
        # all further within is hidden, as by plants: own planes have most of their points here; points on no plane are
        # own if they have class building
        is_own = border.num_near > border.num_beyond
        is_without_plane = border.is_near & (classification == BUILDING_CLASS)
    is_on_own = border.has_plane & is_own[border.label]
    shows = np.where(border.has_plane, (border.is_near | border.is_deep) & is_on_own, is_without_plane)
    if not shows.any():
        return result
    surface = np.column_stack([point_m, border.plane[border.label, :2]])
    own_m, near_m = surface[shows], surface[border.is_near]
    _, beside = nearest(own_m[:, :2], near_m[:, :2], min(RULES.num_near, len(own_m)))
    rise_m = np.asarray(_rise_m(near_m, own_m, beside))
    as_high, as_low = _as_beyond(border, near_m[:, :3], point_m[is_solid & ~inside])
    result[border.is_near] = np.where(rise_m > 0, as_high, as_low) & (np.abs(rise_m) > RULES.step_m)
    return result & is_high & ~is_on_own


def _border_of(
    polygon: shapely.Polygon, own: np.ndarray, is_beyond: np.ndarray, point_m: np.ndarray
) -> _Border | None:
    """The border of a footprint; None without points in its strip or beyond it, or if it is too narrow for a strip.
    own: bool (m,), the points inside that may be on the roof. is_beyond: see :class:`_Border`."""
    if not is_beyond.any():
        return None
    cores = ((strip_m, polygon.buffer(-strip_m - RULES.core_m)) for strip_m in RULES.strips_m)
    strip_m, core = next(((each, core) for each, core in cores if not core.is_empty), (0.0, None))
    if core is None:
        return None
    inner = polygon.buffer(-RULES.band_m)

    def within(area: shapely.Polygon, mask: np.ndarray) -> np.ndarray:
        result = mask.copy()
        result[mask] = shapely.contains_xy(area, point_m[mask, 0], point_m[mask, 1])
        return result

    own = own & ~within(inner, own)
    is_near = within(core.buffer(RULES.core_m + 2 * strip_m), own)
    is_near &= ~within(polygon.buffer(-strip_m), is_near)
    if not is_near.any():
        return None
    band = np.flatnonzero(own | is_beyond)
    ring_m2 = polygon.buffer(strip_m).area - inner.area
    in_band_m = point_m[band]
    chosen = in_band_m[even_order(in_band_m)[every_kth(len(band), int(RULES.most_per_m2 * ring_m2))]]
    found = detect(chosen, max(len(chosen) / ring_m2, _DETECTION.sparse_per_m2), (), _DETECTION)
    plane, label = np.vstack([found.plane, np.full(3, np.nan)]), np.full(len(point_m), len(found.plane))
    label[band] = found.label[nearest(chosen, in_band_m)[1][:, 0]] % len(plane)
    masks = is_near, own & ~is_near, is_beyond
    return _Border(*masks, plane, label, *(np.bincount(label[each], minlength=len(plane)) for each in masks))


def _own_planes(border: _Border, point_m: np.ndarray) -> np.ndarray:
    """bool (k + 1,): the planes of which the building has enough further within."""
    is_deep, num_near, num_deep = border.is_deep, border.num_near, border.num_deep
    # where a plane goes on beyond the border and crosses a larger plane of the building, points of the larger plane lie
    # on both: they are not counted for the smaller plane
    of_deep = border.label[is_deep]
    turn = border.plane[:, None, :2] - border.plane[:-1, :2]
    crosses = (np.hypot(turn[..., 0], turn[..., 1]) > RULES.turn)[of_deep]
    is_on = distances(border.plane[:-1], point_m[is_deep]) < _DETECTION.distance_m
    largest = np.where(is_on & crosses, num_deep[:-1], 0).max(axis=1, initial=0)
    shared = np.bincount(of_deep[largest > num_deep[of_deep]], minlength=len(num_deep))
    num_deep = num_deep - shared * (border.num_beyond > RULES.crossing_share * num_near)
    return num_deep * border.is_near.sum() > RULES.deep_share * num_near * is_deep.sum()


def _as_beyond(border: _Border, near_m: np.ndarray, beyond_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """bool (n,) twice: whether the neighbour is as high beyond the border as a point in the strip, and as low.

    near_m: (n, 3), the points in the strip. beyond_m: (m, 3), all points outside.
    """
    far_m, other = nearest(beyond_m[:, :2], near_m[:, :2], min(RULES.num_beyond, len(beyond_m)))
    higher_m = np.where(far_m < RULES.reach_m, beyond_m[other, 2], -np.inf) - near_m[:, 2, None]
    most_m, label, has_plane = (
        higher_m.max(axis=1),
        border.label[border.is_near],
        border.has_plane[border.is_near],
    )
    goes_on = has_plane & (border.num_beyond > RULES.beyond_share * border.num_near)[label]
    # without points beyond, nothing shows that the building ends here
    as_high = (most_m > -RULES.step_m) | np.isinf(most_m) | goes_on
    # all points of a plane belong to one roof: at a corner, only a third building may be lower
    num_high = np.bincount(label, as_high, minlength=len(border.num_near))
    as_high |= has_plane & (num_high > RULES.most_share * border.num_near)[label]
    as_low = (np.abs(higher_m[:, : RULES.num_near]) < RULES.step_m).any(axis=1)
    return as_high, as_low & (goes_on | ~has_plane)


@entry
def _rise_m(place: np.ndarray, own: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """float64 (m,): how far the surface at each place rises above the nearest own surfaces: the median over these, in
    metres. A fold between two surfaces is no step. place, own: (m, 5) and (n, 5), x, y, z in metres and the gradient
    there, NaN where it is unknown. beside: int (m, k), the nearest rows of ``own``."""
    result, step_m = np.empty(len(place)), np.empty(beside.shape[1])
    for i in range(len(place)):
        for k, other in enumerate(beside[i]):
            x, y, z = place[i, 0] - own[other, 0], place[i, 1] - own[other, 1], place[i, 2] - own[other, 2]
            one_m, other_m = x * place[i, 3] + y * place[i, 4], x * own[other, 3] + y * own[other, 4]
            low_m, high_m = np.fmin(one_m, other_m), np.fmax(one_m, other_m)
            if np.isnan(low_m):
                low_m = high_m = 0.0
            step_m[k] = 0.0 if low_m < z < high_m else z - (low_m + high_m) / 2
        result[i] = ordering.median(step_m, len(step_m))
    return result
