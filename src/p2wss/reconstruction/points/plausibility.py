"""Whether clouds, footprints and terrain agree in place and units: checked on a sample of footprints before a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.clouds.crops import crop_cloud
from p2wss.data import polygon_arrays
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS
from p2wss.data.points import stride
from p2wss.data.terrain import UNITS_M, Terrain
from p2wss.reconstruction.inputs import Inputs
from p2wss.reconstruction.points.cloud_index import CloudIndex
from p2wss.skeleton.types import differs
from p2wss.storage.features import Features
from p2wss.storage.las_crs import vertical_part
from p2wss.storage.messages import InputError, log


@dataclass(frozen=True)
class Rules:
    """What a sample of footprints is, and what it tells; set by hand.

    num_sampled: number of footprints. around_m: points are read up to this distance from each footprint; footprints are
    read one by one if there are more points than ``together``. max_gap_m: a terrain further from the ground of the
    points has other units or another height system; odd_gap_m: a terrain further than this may have.
    left_share, left_m: a factor explains such a gap if it leaves at most this share of the heights, or these metres.
    feet_ratio: range of the ratio of heights of points and stated heights, if the points are in feet; a stated height
    may be of the eave or of the ridge. same_ratio: for most houses, the ratio differs at most by this share from its
    median. high_m, slender, low_m: heights are in another unit if the median house is higher than ``high_m`` and more
    than ``slender`` times as high as wide, or lower than ``low_m``; the first value applies if the user does not state
    the unit, the second if the user does. flat_m: if the median house is lower by heights in metres, z are no heights,
    or all points are of the ground. usual_m: the guessed unit is the one that brings the median height nearest to this,
    by ratio. layers_m: the ground of one survey does not differ in height by this much within a square metre;
    min_points: least points of such a square, min_squares: least squares, num_layered: footprints where this is
    checked. max_undulation_m: largest distance of the ellipsoid from the sea level. step_m: (metres, points): around a
    footprint with this many points, x and y have smaller steps than this; if only one has, digits were lost, and if
    neither has, the points are a raster. zero_m: (metres, footprints): the ground is this near to zero around each of
    this many footprints only if heights are above the ground.
    """

    num_sampled: int = 32
    around_m: float = 6.0
    together: int = 500_000
    max_gap_m: float = 10.0
    odd_gap_m: float = 1.0
    left_share: float = 0.02
    left_m: float = 2.0
    feet_ratio: tuple[float, float] = (2.4, 4.4)
    same_ratio: float = 0.3
    high_m: tuple[float, float] = (12.0, 40.0)
    slender: tuple[float, float] = (1.8, 4.0)
    low_m: tuple[float, float] = (2.3, 1.0)
    flat_m: float = 0.5
    usual_m: float = 6.0
    layers_m: float = 0.25
    min_points: int = 6
    min_squares: int = 10
    num_layered: int = 8
    max_undulation_m: float = 110.0
    step_m: tuple[float, int] = (0.1, 100)
    zero_m: tuple[float, int] = (0.02, 3)


RULES = Rules()
# factors that may convert wrong heights of a terrain, and the unit that the heights then have
_FACTORS = {
    0.3048: "ft",
    0.01: "cm",
    0.1: "dm",
    0.001: "mm",
    1 / 0.3048: "m",
    10.0: "",
    100.0: "",
}
# steps of float32 are powers of two in the unit of the file, up to this error of the exponent
_BINARY = 1e-3
_UNITS = ("m", "ft", "dm", "cm", "mm")


@dataclass(frozen=True)
class Sample:
    """What is known of n footprints, each array (n,), NaN where it is unknown.

    ground_z_m: the ground by the points. height_m: median height above it of the points on the footprint. width_m: side
    of a square with the area of the footprint. stated_height_m: the height that the footprint states. terrain_z_m: the
    terrain at the centre of the footprint. num_points: points on the footprint. layers_m: height difference of layers
    of the ground around the footprint (:func:`_layers_m`). step_m: (2,), the smallest step in x and in y between points
    of all footprints; 0 if no footprint has enough points.
    """

    ground_z_m: np.ndarray
    height_m: np.ndarray
    width_m: np.ndarray
    stated_height_m: np.ndarray
    terrain_z_m: np.ndarray
    num_points: np.ndarray
    layers_m: np.ndarray
    step_m: np.ndarray

    @property
    def gap_m(self) -> np.ndarray:
        """Heights of the terrain above the ground of the points, for footprints where both are known."""
        gap_m = self.terrain_z_m - self.ground_z_m
        return gap_m[np.isfinite(gap_m)]


def sample_of(
    features: Features, points: CloudIndex, terrain: Terrain | None, most: int = RULES.num_sampled
) -> Sample:
    """Up to ``most`` footprints, spread over the rows. features: cleaned. points: around them."""
    rows = np.flatnonzero(~shapely.is_empty(features.geometry))
    rows = rows[:: stride(len(rows), most)] if len(rows) else rows
    values = np.full((7, len(rows)), np.nan)
    values[5] = 0
    stated_m = features.columns.get("stated_height_m", np.full(len(features), np.nan))
    shapes = features.geometry[rows]
    boxes = shapely.bounds(shapes) + RULES.around_m * np.array([-1, -1, 1, 1])
    values[2], values[3] = np.sqrt(shapely.area(shapes)), stated_m[rows]
    every, step_m = np.arange(len(rows)), np.full(2, np.inf)
    for some in [every] if points.count(boxes) <= RULES.together else every[:, None]:
        cloud = points.near(boxes[some], adds_classes=False)
        cropped = crop_cloud(cloud, polygon_arrays.to_polygons(shapes[some]))
        values[0, some] = np.where(cropped.is_foot, np.nan, cropped.ground_z_m)
        ground_m = np.array([cloud.x_m, cloud.y_m, cloud.z_m])[:, cloud.classification == GROUND_CLASS]
        for i, k in enumerate(some.tolist()):
            own = slice(cropped.offset[i], cropped.offset[i + 1])
            near = cropped.point[own]
            if len(near) >= RULES.step_m[1]:
                steps = [
                    np.diff(np.unique(each[near])).min(initial=np.inf) for each in (cloud.x_m, cloud.y_m)
                ]
                step_m = np.minimum(step_m, steps)
            on = near[cropped.inside[own]]
            is_roof = cloud.classification[on] == BUILDING_CLASS
            roof_z = cloud.z_m[on[is_roof] if is_roof.any() else on]
            values[1, k] = np.median(roof_z) - values[0, k] if len(roof_z) else np.nan
            values[5, k] = len(on)
            if k % stride(len(rows), RULES.num_layered) == 0:
                low, high = boxes[k].reshape(2, 2, 1)
                is_near = ((ground_m[:2] >= low) & (ground_m[:2] <= high)).all(axis=0)
                values[6, k] = _layers_m(ground_m[:, is_near])
    if terrain is not None and len(rows):
        values[4] = terrain.interpolated(features["centre_x_m"][rows], features["centre_y_m"][rows])
    step_m[np.isinf(step_m)] = 0
    return Sample(*[*values, step_m])


def _layers_m(ground_m: np.ndarray) -> float:
    """The median, over the square metres of ground with enough points, of the largest step between successive heights
    in a square; the highest and lowest sixth of a square's points are left out. NaN if there are too few squares.

    In one survey this is noise, also on slopes. Where two surveys differ in height, it is the difference. ground_m:
    ground points, (3, n).
    """
    square = np.floor(ground_m[0]) + 1j * np.floor(ground_m[1])
    order = np.lexsort((ground_m[2], square))
    begin = np.flatnonzero(differs(square[order]))
    size = np.diff(begin, append=len(order))
    place, num = np.arange(len(order)) - np.repeat(begin, size), np.repeat(size, size)
    # points at which a step begins, without the highest and lowest sixth
    is_inner = (num >= RULES.min_points) & (place >= num // 6) & (place + 1 < num - num // 6)
    steps = np.diff(ground_m[2, order], append=np.nan)[is_inner]
    steps = np.maximum.reduceat(steps, np.flatnonzero(differs(np.repeat(begin, size)[is_inner])))
    return float(np.median(steps)) if len(steps) >= RULES.min_squares else float("nan")


def check(sample: Sample, inputs: Inputs, height_unit: str, terrain_unit: str) -> None:
    """Raise :class:`InputError` for heights that contradict each other by a factor or an offset, unless the user states
    their unit; warn where they are doubtful. height_unit, terrain_unit: as the user states them, or ""."""
    if inputs.terrain is not None:
        try:
            check_terrain(sample, str(inputs.terrain[1]))
        except InputError as error:
            if not terrain_unit:
                raise
            log.warning("warning: %s", str(error).split(";")[0])
    layers_m = sample.layers_m[np.isfinite(sample.layers_m)]
    if len(layers_m) > 1 and np.median(layers_m) > RULES.layers_m:
        log.warning(
            "warning: %s: the ground is in two layers, about %.2f m apart, as where flights or files differ in their"
            " heights; roofs are as doubtful",
            inputs.headers[0].path,
            np.median(layers_m),
        )
    ground_m = sample.ground_z_m[np.isfinite(sample.ground_z_m)]
    if len(ground_m) >= RULES.zero_m[1] and np.abs(ground_m).max() < RULES.zero_m[0]:
        log.warning(
            "warning: %s: the ground is at zero everywhere, as where heights are above the ground (normalised): hills"
            " are flat, and roofs on slopes bent; give the cloud with its own heights, if the place is not flat",
            inputs.headers[0].path,
        )
    step = sample.step_m.max() / (inputs.metric.horizontal_m or 1.0)
    is_coarse = sample.step_m.max() > max(RULES.step_m[0], 2 * sample.step_m.min())
    if is_coarse and abs(np.log2(step) - np.round(np.log2(step))) < _BINARY:
        log.warning(
            "warning: %s: %s is in whole steps of %g, as float32 has them, and walls are as doubtful; convert the"
            " points again, with float64",
            inputs.headers[0].path,
            "xy"[int(sample.step_m.argmax())],
            np.round(step, 3),
        )
    if 1 / RULES.feet_ratio[1] < (times := times_stated(sample)) < 1 / RULES.feet_ratio[0]:
        log.warning(
            "warning: footprints state heights that are %.1f times those of points, as if in feet; where a building has"
            " no points, they count as metres",
            1 / times,
        )
    vertical_m, is_stated = inputs.metric.vertical_m, vertical_part(inputs.metric.source) is not None
    text = "" if height_unit else feet_instead_of_metres(sample, vertical_m)
    if text and not is_stated:
        raise InputError(f"{inputs.headers[0].path}: {text}")
    if text := text or odd_houses(sample, vertical_m, height_unit, inputs.footprints is not None):
        log.warning("warning: %s: %s", inputs.headers[0].path, text)


def check_terrain(sample: Sample, name: str) -> None:
    """Raise :class:`InputError` for a terrain far from the ground of the points; log a note for a smaller gap."""
    gap_m = sample.gap_m
    if not len(gap_m) or abs(np.median(gap_m)) <= RULES.odd_gap_m:
        return
    known = np.isfinite(sample.terrain_z_m) & np.isfinite(sample.ground_z_m)
    ground_m, terrain_m = sample.ground_z_m[known], sample.terrain_z_m[known]
    where = f"{name}: its heights are {np.median(gap_m):+.1f} m from the ground of the points"
    if abs(np.median(gap_m)) <= RULES.max_gap_m:
        log.info("note: %s: are both in the same height system?", where)
        return
    for factor, unit in _FACTORS.items():
        left_m = np.abs(terrain_m * factor - ground_m)
        if np.median(left_m) <= max(RULES.left_m, RULES.left_share * np.median(np.abs(ground_m))):
            guess = f"as if they were in {unit}" if unit else f"as if they had to be multiplied by {factor:g}"
            remedy = f"state --terrain-unit {unit}" if unit else "correct it"
            other = "" if unit == "m" else ", or --terrain-unit m to take it as it is"
            is_even = np.median(np.abs(gap_m - np.median(gap_m))) < RULES.left_m / 2
            if is_even and abs(np.median(gap_m)) < RULES.max_undulation_m:
                guess = f"as the ellipsoid is from the sea, or {guess}"
                remedy = f"convert it to the height system of the points, or {remedy}"
            raise InputError(f"{where}, {guess}; {remedy}{other}")
    raise InputError(
        f"{where}: are both in the same height system? correct it, or state --terrain-unit m to take it as it is"
    )


def feet_instead_of_metres(sample: Sample, vertical_m: float) -> str:
    """A text if stated heights show that heights of points are in feet and not, as assumed, in metres, or the other way
    round; else "". vertical_m: length of the assumed unit."""
    is_feet = abs(vertical_m - 0.3048) < 1e-3
    times = times_stated(sample)
    low, high = (1 / RULES.feet_ratio[1], 1 / RULES.feet_ratio[0]) if is_feet else RULES.feet_ratio
    unit, other = ("m", "ft") if is_feet else ("ft", "m")
    if not low < times < high:
        return ""
    return (
        f"roofs are {times:.2f} times as high as their footprints state, as if heights were in {unit};"
        f" state --height-unit {unit}, or --height-unit {other} if they are right"
    )


def times_stated(sample: Sample) -> float:
    """The median ratio of the heights of roofs and the heights that their footprints state; NaN if there are fewer than
    two, or if their ratios differ too much."""
    ratio = sample.height_m / sample.stated_height_m
    ratio = ratio[np.isfinite(ratio) & (sample.stated_height_m > 2.0) & (sample.height_m > 1.0)]
    if len(ratio) < 2 or (abs(ratio / np.median(ratio) - 1) < RULES.same_ratio).mean() <= 0.7:
        return float("nan")
    return float(np.median(ratio))


def odd_houses(sample: Sample, vertical_m: float, stated: str, are_mapped: bool = True) -> str:
    """A text if the shape of houses shows that heights are not in the assumed unit; else "". vertical_m: length of this
    unit. stated: the unit as the user states it, or "". are_mapped: whether footprints are of a map; those that are
    derived from points may be parts of houses, which are more slender."""
    is_known = np.isfinite(sample.height_m)
    if not is_known.any():
        return ""
    height_m = float(np.median(sample.height_m[is_known]))
    slender = float(np.median(sample.height_m[is_known] / sample.width_m[is_known]))
    k = int(bool(stated) or not are_mapped)
    if vertical_m > 0.99 and height_m < RULES.flat_m:
        return (
            f"houses are {height_m:.2f} m high; are z of the points heights, and are there points of roofs?"
        )
    if vertical_m > 0.99 and height_m > RULES.high_m[k] and slender > RULES.slender[k]:
        text = f"houses are {slender:.1f} times as high as wide"
    elif vertical_m < 0.99 and height_m < RULES.low_m[k]:
        text = f"houses are {height_m:.2f} m high"
    else:
        return ""
    in_units = max(height_m, 1e-3) / vertical_m
    unit = min(_UNITS, key=lambda each: abs(np.log(in_units * UNITS_M[each] / RULES.usual_m)))
    own = min(_UNITS, key=lambda each: abs(UNITS_M[each] - vertical_m))
    remedy = f" instead of {stated}" if stated else f", or --height-unit {own} if they are right"
    return f"{text}, as if heights were in {unit}; state --height-unit {unit}{remedy}"


def summary(sample: Sample) -> str:
    """One line of what a sample shows."""
    has_points = sample.num_points > 0
    text = f"a look at {len(has_points)} footprints: {int(has_points.sum())} with points"
    if np.isfinite(sample.height_m).any():
        roof_m, ground_m = np.nanmedian(sample.height_m), np.nanmedian(sample.ground_z_m)
        text += f", roofs {roof_m:.1f} m above the ground at {ground_m:.1f} m"
    if len(sample.gap_m):
        text += f", terrain {np.median(sample.gap_m):+.1f} m from it"
    return text
