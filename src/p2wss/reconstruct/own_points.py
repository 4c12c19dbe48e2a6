"""Whose points are these? Classes of the points of a building, as its roof needs them.

Along the border to another building, points may be of that one: its roof reaches over the border, or the map has the
border elsewhere, and pulses hit its wall. Planes are grown over both sides of the border: one that is found beyond it
and within it, but only in a strip along it, is the neighbour's, and so are the returns from walls below it. The same
rule holds from the other side, so that no order of buildings matters. Roofs that the producer took for ground are told
by what is beside them.
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
)
from p2wss.data.points import MIN_HEIGHT_M
from p2wss.fit.planes.detection import detect, heights
from p2wss.fit.points import even_order, every_kth
from p2wss.fit.settings import Detection
from p2wss.skeleton.nearest import nearest


@dataclass(frozen=True)
class Rules:
    """Whose the points at a border are; set by hand from drawn old towns.

    strip_m: points this near to the border may be another building's. band_m: what the building has at the strip is
    seen within this distance of the border. core_m: half the width of a wing, less the strip; narrower ones have no
    strip, because their own roof looks like one. step_m, step_quantile: the height between a plane of the neighbour
    and the points of the building nearest to it, of which so many (``num_near``) are looked at. on_m: returns from
    walls are at most this far above the plane. num_points: that show a plane beyond the border. most_per_m2: points of
    which planes are grown. steep: tangent of the slope of what is no roof but a wall. deep_share: a plane with a larger
    share of its points within the border beyond the strip is the building's.
    """

    strip_m: float = 1.0
    band_m: float = 2.5
    core_m: float = 0.1
    step_m: float = 0.7
    num_near: int = 4
    reach_m: float = 1.5
    most_per_m2: float = 6.0
    steep: float = 1.2
    deep_share: float = 0.1


RULES = Rules()
_DETECTION = Detection()


def with_own_classes(building: Building) -> Building:
    """The building with the classes of :func:`own_classes`."""
    classes = own_classes(building.rings, building.point_m, building.classification)
    return replace(building, classification=classes)


def own_classes(rings: Sequence[np.ndarray], point_m: np.ndarray, classification: np.ndarray) -> np.ndarray:
    """The classes (m,) of points (m, 3), with :data:`NEIGHBOUR_CLASS` where they are another building's, and with class
    building where a roof has class ground. point_m: in and around the footprint ``rings``, z above the ground."""
    if not len(rings) or not len(point_m):
        return classification
    polygon = shapely.Polygon(rings[0], rings[1:])
    inside = shapely.contains_xy(polygon, point_m[:, 0], point_m[:, 1])
    result = _with_roofs_as_ground(inside, point_m, classification)
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


def _theirs(
    polygon: shapely.Polygon, inside: np.ndarray, point_m: np.ndarray, classification: np.ndarray
) -> np.ndarray:
    """Mask (m,) of the points of other buildings, of those ``inside`` the footprint."""
    result = np.zeros(len(point_m), bool)
    is_solid = ~np.isin(classification, (*PLANT_CLASSES, *NOISE_CLASSES, WATER_CLASS))
    is_high = is_solid & (classification != GROUND_CLASS) & (point_m[:, 2] >= MIN_HEIGHT_M)
    core = polygon.buffer(-RULES.strip_m - RULES.core_m).buffer(RULES.core_m)
    if core.is_empty or not (is_high & ~inside).any():
        return result
    inner = polygon.buffer(-RULES.band_m)
    within, deep_within, beside_core = (
        shapely.contains_xy(each, point_m[:, 0], point_m[:, 1])
        for each in (polygon.buffer(-RULES.strip_m), inner, core.buffer(2 * RULES.strip_m))
    )
    band, beyond_m = np.flatnonzero(is_solid & inside & ~deep_within), point_m[is_solid & ~inside]
    band_m, near = point_m[band], (~within & beside_core)[band]
    if near.all() or not near.any():
        return result
    near_m, none = band_m[near], np.full(len(band), -1)
    if not _differs(near_m, band_m[~near], np.zeros((1, 3)), none).any():
        return result
    ring_m2 = polygon.area - inner.area
    chosen = even_order(band_m)[every_kth(len(band), int(RULES.most_per_m2 * ring_m2))]
    density = max(len(chosen) / ring_m2, _DETECTION.sparse_per_m2)
    found = detect(band_m[chosen], density, (), _DETECTION)
    # the last plane is that of points without one
    plane = np.vstack([found.plane, np.zeros(3)])
    label = found.label[nearest(band_m[chosen], band_m)[1][:, 0]] % len(plane)
    num_near, num_deep = (np.bincount(label[each], minlength=len(plane)) for each in (near, ~near))
    is_own = num_deep * near.sum() > RULES.deep_share * num_near * (~near).sum()
    is_own &= np.hypot(plane[:, 0], plane[:, 1]) < RULES.steep
    is_own[-1] = False
    shows = ~near & (is_own[label] | (label == len(plane) - 1))
    if not shows.any():
        return result
    differs = _differs(near_m, band_m[shows], plane, np.where(is_own[label], label, -1)[shows])
    differs &= is_high[band[near]] & ~is_own[label[near]]
    far_m, other = nearest(beyond_m[:, :2], near_m[:, :2], min(RULES.num_near, len(beyond_m)))
    other_z = np.where(far_m < RULES.reach_m, beyond_m[other, 2], -np.inf).max(axis=1)
    # without points beyond, nothing shows that the building ends here
    theirs = differs & ((near_m[:, 2] < other_z + RULES.step_m) | np.isinf(other_z))
    balance = np.bincount(label[near], np.where(theirs, 1, -1) * differs, len(plane))
    is_theirs = (balance > 0) & (np.arange(len(plane)) < len(plane) - 1)
    result[band] = is_theirs[label] & ~is_own[label]
    result[band[near]] = theirs | (differs & is_theirs[label[near]])
    return result


def _differs(place_m: np.ndarray, point_m: np.ndarray, plane: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Whether points (m, 3) are no part of a roof that goes on as it is at the points (n, 3) nearest to them, bool
    (m,). label: (n,), of the planes (k, 3), -1 where there is none, and the roof is level."""
    _, beside = nearest(point_m[:, :2], place_m[:, :2], min(RULES.num_near, len(point_m)))
    on_plane = np.take_along_axis(heights(plane, place_m[:, :2]), label[beside], axis=1)
    roof_z = np.median(np.where(label[beside] < 0, point_m[beside, 2], on_plane), axis=1)
    return np.asarray(np.abs(place_m[:, 2] - roof_z) > RULES.step_m)
