"""Whose points are these? Classes of the points of a building, as its roof needs them.

Along the border to another building, points may be of that one: its roof reaches over the border, or the map has the
border elsewhere, and pulses hit its wall. Planes are grown over both sides of the border: one that the building has
only in a strip along it, with a step to what it has further within, is the neighbour's if that is at the same height
beyond the border, and so are returns from walls above the building's own roof. The same rule holds from the other side,
so that no order of buildings matters. Roofs that the producer took for ground show by what is beside them, and those
that it took for trees by their planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from p2wss.data.building import Building
from p2wss.data.las_classes import (
    BUILDING_CLASS,
    GROUND_CLASS,
    NEIGHBOUR_CLASS,
    NOISE_CLASSES,
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
    """Whose the points at a border are; set by hand from drawn old towns.

    strips_m: points this near to the border may be another building's: the widest of these strips that leaves a core.
    band_m: what the building has at the strip is seen within this distance of the border. core_m: half the width of a
    wing, less the strip; narrower ones have no strip, because their own roof looks like one. step_m: between a surface
    of the neighbour and the ``num_near`` points of the building nearest to it; the highest of the ``num_beyond``
    nearest beyond the border may be so much lower, one of the ``num_near`` nearest differ less from a low one. reach_m:
    points beyond the border show nothing further away. most_per_m2: points of which planes are grown. deep_share: where
    the density of a plane's points further within is a larger share of that in the strip, the plane is the building's.
    turn: difference of the slopes of planes that cross, as tangent. beyond_share: a plane goes on beyond the border
    where it has more points there than this share of those in the strip; crossing_share: of one that crosses another.
    most_share: where more of a plane's points in the strip than this share are the neighbour's, all of them are.
    roof_share: points of plants are a roof if more than this share of them lie on planes. gap_m, gap, num_around: class
    building has a gap farther from its points than this, and than so many times their distance from the ``num_around``
    th of them. gap_m2: it is missed where points as many as class building has on this area are in gaps.
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
# points that are there many times have no distance
_LEAST_M = 0.05


def with_own_classes(building: Building) -> Building:
    """The building with the classes of :func:`own_classes`."""
    classes = own_classes(building.rings, building.point_m, building.classification)
    return building if classes is building.classification else replace(building, classification=classes)


def own_classes(rings: Sequence[np.ndarray], point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """The classes (m,) of points (m, 3), with :data:`NEIGHBOUR_CLASS` where they are another building's, and with class
    building where a roof has class ground. point_m: in and around the footprint ``rings``, z above the ground."""
    if not len(rings) or not len(point_m):
        return classification
    polygon = shapely.Polygon(rings[0], rings[1:])
    inside = shapely.contains_xy(polygon, point_m[:, 0], point_m[:, 1])
    result = _with_roofs_as_ground(inside, point_m, classification)
    result = _with_roofs_as_plants(inside, point_m, result)
    result = _with_roofs_as_others(inside, point_m, result)
    theirs = _theirs(polygon, inside, point_m, result)
    return np.where(theirs, np.uint8(NEIGHBOUR_CLASS), result) if theirs.any() else result


def _with_roofs_as_ground(inside: np.ndarray, point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """The classes (m,) with class building for points inside of class ground that are above the ground beside."""
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
    """The classes (m,) with class building for points inside of plants that lie on planes, where hardly any others are
    as high and most of them do: a roof and no crown."""
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
    """The classes (m,) with class building for points inside of other classes than ground that lie on planes where
    class building has a gap, and most of them do: a part of the roof that the classifier missed."""
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


def _theirs(
    polygon: shapely.Polygon, inside: np.ndarray, point_m: np.ndarray, classification: np.ndarray
) -> np.ndarray:
    """Mask (m,) of the points of other buildings, of those ``inside`` the footprint."""
    result = np.zeros(len(point_m), bool)
    is_solid = ~has_class(classification, (*PLANT_CLASSES, *NOISE_CLASSES, WATER_CLASS))
    is_high = is_solid & (point_m[:, 2] >= MIN_HEIGHT_M)
    is_beyond = is_high & ~inside
    if not is_beyond.any():
        return result
    for strip_m in RULES.strips_m:
        core = polygon.buffer(-strip_m - RULES.core_m)
        if not core.is_empty:
            break
    else:
        return result
    inner = polygon.buffer(-RULES.band_m)

    def within(area: shapely.Polygon, mask: np.ndarray) -> np.ndarray:
        result = mask.copy()
        result[mask] = shapely.contains_xy(area, point_m[mask, 0], point_m[mask, 1])
        return result

    own = is_solid & inside
    own &= ~within(inner, own)
    is_near = within(core.buffer(RULES.core_m + 2 * strip_m), own)
    is_near &= ~within(polygon.buffer(-strip_m), is_near)
    is_deep = own & ~is_near
    if not is_near.any():
        return result
    surface = np.column_stack([point_m, np.full((len(point_m), 2), np.nan)])
    band = np.flatnonzero(own | is_beyond)
    ring_m2 = polygon.buffer(strip_m).area - inner.area
    in_band_m = point_m[band]
    chosen = in_band_m[even_order(in_band_m)[every_kth(len(band), int(RULES.most_per_m2 * ring_m2))]]
    found = detect(chosen, max(len(chosen) / ring_m2, _DETECTION.sparse_per_m2), (), _DETECTION)
    # the last plane is that of points without one
    plane, label = np.vstack([found.plane, np.full(3, np.nan)]), np.full(len(point_m), len(found.plane))
    label[band] = found.label[nearest(chosen, in_band_m)[1][:, 0]] % len(plane)
    surface[:, 3:] = plane[label, :2]
    num_near, num_deep, num_beyond = (
        np.bincount(label[mask], minlength=len(plane)) for mask in (is_near, is_deep, is_beyond)
    )
    has_plane = label < len(found.plane)
    if is_deep.any():
        # where a plane that goes on at the neighbour crosses a larger one of the building, points of that are on both
        turn = plane[:, None, :2] - plane[:-1, :2]
        crosses = (np.hypot(turn[..., 0], turn[..., 1]) > RULES.turn)[label[is_deep]]
        is_on = distances(plane[:-1], point_m[is_deep]) < _DETECTION.distance_m
        largest = np.where(is_on & crosses, num_deep[:-1], 0).max(axis=1, initial=0)
        shared = np.bincount(label[is_deep][largest > num_deep[label[is_deep]]], minlength=len(plane))
        num_deep = num_deep - shared * (num_beyond > RULES.crossing_share * num_near)
        is_own = num_deep * is_near.sum() > RULES.deep_share * num_near * is_deep.sum()
    else:
        # under plants: planes that have most of their points here, and what is on none
        is_own, is_deep = num_near > num_beyond, own & (classification == BUILDING_CLASS)
    shows = np.where(has_plane, own & is_own[label], is_deep)
    if not shows.any():
        return result
    result = is_near & is_high & ~(has_plane & is_own[label])
    own_m, near_m = surface[shows], surface[is_near]
    _, beside = nearest(own_m[:, :2], near_m[:, :2], min(RULES.num_near, len(own_m)))
    near_z, rise_m = near_m[:, 2], np.asarray(_rise_m(near_m, own_m, beside))
    beyond_m = point_m[is_solid & ~inside]
    far_m, other = nearest(beyond_m[:, :2], point_m[is_near, :2], min(RULES.num_beyond, len(beyond_m)))
    higher_m = np.where(far_m < RULES.reach_m, beyond_m[other, 2], -np.inf) - near_z[:, None]
    most_m = higher_m.max(axis=1)
    goes_on = has_plane & (num_beyond > RULES.beyond_share * num_near)[label]
    # without points beyond, nothing shows that the building ends here
    as_high = (most_m > -RULES.step_m) | np.isinf(most_m) | goes_on[is_near]
    # a plane is one roof's: at a corner, a third building may be lower
    of_plane = label[is_near]
    num_high = np.bincount(of_plane, as_high, minlength=len(plane))
    as_high |= has_plane[is_near] & (num_high > RULES.most_share * num_near)[of_plane]
    as_low = (np.abs(higher_m[:, : RULES.num_near]) < RULES.step_m).any(axis=1)
    as_low &= (goes_on | ~has_plane)[is_near]
    result[is_near] &= np.where(rise_m > 0, as_high, as_low) & (np.abs(rise_m) > RULES.step_m)
    return result


@entry
def _rise_m(place: np.ndarray, own: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """How far surfaces at places (m, 5) rise above the own ones (n, 5) nearest to them, (m,): x, y, z in metres and the
    slope there, not a number where it is unknown. A fold between them is no step. beside: (m, k), the own ones nearest
    to each place."""
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
