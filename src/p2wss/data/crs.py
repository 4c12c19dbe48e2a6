"""Compare CRSs; choose one projected CRS in metres for clouds, footprints and terrain, and transform them into it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj
import shapely

from p2wss.data.tiling import Bounds
from p2wss.storage.las_crs import (
    UNKNOWN,
    as_of_epsg,
    epsg_of,
    horizontal,
    in_degrees,
    in_unit,
    is_ellipsoidal,
    is_plausible,
    meridian_deg,
    same_crs,
    unit_m,
    vertical_part,
    with_heights,
)
from p2wss.storage.messages import InputError, log

if TYPE_CHECKING:
    from p2wss.data.terrain import Terrain
    from p2wss.mesh import Mesh

# a transformation that is less accurate moves footprints visibly
_ACCURATE_M = 0.5
_SAME_PLACE_M = 1e-4
# lengths in a projection may differ from those on the ground by this share
_MAX_DISTORTION = 0.005
STATE_CRS = (
    "state it with --crs, such as EPSG:28992, or for local coordinates any in metres, such as EPSG:32631"
)
# coordinates this near to zero, outside the area of use, are local ones
_LOCAL = 10_000.0
# latitude and longitude this near to zero are in the sea
_NOWHERE_DEG = 0.1


@dataclass(frozen=True)
class MetricCrs:
    """The CRS of a run, and the conversion from the CRS of the clouds into it.

    source: the CRS of the clouds. crs: the CRS of the run: ``source`` with metres in place of other units, or a UTM
    zone if the clouds are in degrees or in a projection whose lengths or directions differ from those on the ground.
    horizontal_m, vertical_m: lengths of the source's units; the first is None where coordinates are transformed to UTM.
    """

    source: pyproj.CRS
    crs: pyproj.CRS
    horizontal_m: float | None = 1.0
    vertical_m: float = 1.0

    @property
    def is_source(self) -> bool:
        """Whether clouds are in metres already."""
        return self.horizontal_m == 1.0 and self.vertical_m == 1.0

    def window_of_clouds(self, bounds: Bounds) -> Bounds:
        """A window of the run, in the CRS of the clouds."""
        low_x, low_y, high_x, high_y = (
            self._transformer.transform_bounds(*bounds, direction="INVERSE")
            if self.horizontal_m is None
            else np.divide(bounds, self.horizontal_m).tolist()
        )
        return low_x, low_y, high_x, high_y

    def bounds_of_run(self, bounds: Bounds) -> Bounds:
        """A window of the clouds, in the CRS of the run."""
        low_x, low_y, high_x, high_y = (
            self._transformer.transform_bounds(*bounds)
            if self.horizontal_m is None
            else np.multiply(bounds, self.horizontal_m).tolist()
        )
        return low_x, low_y, high_x, high_y

    def points(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x, y and z in the CRS of the run, each (n,), of points in the units of the clouds."""
        x_m, y_m = (
            self._transformer.transform(x, y)
            if self.horizontal_m is None
            else (x * self.horizontal_m, y * self.horizontal_m)
        )
        return x_m, y_m, z * self.vertical_m

    def mesh(self, mesh: Mesh) -> Mesh:
        """A mesh in the units of the source, converted into the CRS of the run."""
        return replace(mesh, vertex_m=np.column_stack(self.points(*mesh.vertex_m.T)))

    def unstated_m(self, terrain_crs: pyproj.CRS) -> float:
        """Length in metres of the unit of heights of a raster that does not state it. It is the clouds' unit of heights
        if the raster is in their CRS, else the unit of the raster's x and y; 1 for degrees."""
        if same_crs(terrain_crs, self.source):
            return self.vertical_m
        return (
            float(horizontal(terrain_crs).axis_info[0].unit_conversion_factor)
            if terrain_crs.is_projected
            else 1.0
        )

    def terrain(self, terrain: Terrain, terrain_crs: pyproj.CRS, path: str | Path) -> Terrain:
        """A raster with heights in metres, converted into the CRS of the run. A message says if it is reprojected."""
        if same_crs(terrain_crs, self.crs):
            return terrain
        if same_crs(terrain_crs, self.source) and self.horizontal_m is not None:
            scale = self.horizontal_m
            return replace(
                terrain,
                x_min_m=terrain.x_min_m * scale,
                y_max_m=terrain.y_max_m * scale,
                cell_m=terrain.cell_m * scale,
            )
        log.info("note: %s: reprojected from %s to %s", path, terrain_crs.name, self.crs.name)
        return terrain.warped(horizontal(terrain_crs).to_wkt(), horizontal(self.crs).to_wkt())

    @property
    def _transformer(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_crs(horizontal(self.source), horizontal(self.crs), always_xy=True)


def common_crs(
    cloud: pyproj.CRS | None,
    frame: pyproj.CRS | None,
    stated: str | None,
    names: tuple[str, str],
    bounds: Bounds | None = None,
) -> tuple[pyproj.CRS, str | None]:
    """The CRS of the clouds, and a note if it was assumed.

    cloud, frame: the CRS that clouds and footprints state, if any. stated: the CRS of the clouds that the user states.
    It overrides the one of the clouds, with a warning if they differ. names: of the two files. bounds: of the clouds.

    Raises :class:`InputError` if no CRS is stated, if the only one is that of footprints in degrees, and if the clouds
    lie in the area of the CRS that they state, but not in the area of the CRS that the user states.
    """
    note = None
    if stated is not None:
        stated_crs = parsed_crs(stated, "--crs")
        is_other = cloud is not None and not same_crs(cloud, stated_crs)
        if cloud is not None and is_other:
            place = None if bounds is None else ((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
            if place is not None and is_plausible(cloud, place) and not is_plausible(stated_crs, place):
                raise InputError(
                    f"{names[0]} is in {cloud.name}, in whose area it lies, but --crs states {stated_crs.name}, in"
                    " whose area it does not lie; omit --crs"
                )
            text = "warning: %s states that it is in %s; --crs overrides that: %s"
            log.warning(text, names[0], cloud.name, stated_crs.name)
        # heights that the user states are part of the CRS
        if cloud is None or is_other or vertical_part(cloud) is None or vertical_part(stated_crs) is not None:
            cloud = stated_crs
    if cloud is None and frame is not None and frame.is_geographic:
        raise InputError(
            f"{names[0]} does not state its CRS, and {names[1]} is in degrees, which is unlikely for clouds; state that"
            " of the clouds with --crs, such as EPSG:28992"
        )
    crs = cloud or frame
    if crs is None:
        raise InputError(f"neither {names[0]} nor {names[1]} states its CRS; {STATE_CRS}")
    if cloud is None:
        note = (
            f"{names[0]} does not state its CRS; assuming {crs.name} as in {names[1]} (--crs overrides this)"
        )
    return crs, note


def metric_crs(
    source: pyproj.CRS, bounds: Bounds | None, name: str, vertical_m: float | None = None
) -> tuple[MetricCrs, str | None]:
    """The CRS of a run on clouds in ``source``, and a note if it differs.

    A CRS in feet is replaced by the same CRS of EPSG in metres, else by a CRS of the same name and "(metres)"; heights
    in feet by heights in metres above the same datum. Heights whose unit is not stated are taken to be in the unit of x
    and y. A UTM zone replaces degrees, a projection in which lengths differ by more than 0.5 % from those on the
    ground, and a projection whose axes point south or west. bounds: of a cloud, the place for which the zone and the
    lengths are found. name: of a cloud. vertical_m: length of the unit of heights, whatever ``source`` states.

    Raises :class:`InputError` for a CRS that is neither projected nor geographic, for degrees without bounds, and where
    there is no UTM zone.
    """
    source = as_of_epsg(source)
    flat = horizontal(source)
    heights = vertical_part(source)
    name_of = f"{source.name}, with heights above the ellipsoid" if is_ellipsoidal(source) else source.name
    stated_m = unit_m(heights) if vertical_m is None and heights is not None else vertical_m
    if flat.is_geographic and bounds is None:
        raise InputError(
            f"{name}: is in {source.name}, in degrees, and has no points that tell in which zone of UTM"
        )
    factors = {1.0 if flat.is_geographic else axis.unit_conversion_factor for axis in flat.axis_info}
    if not (flat.is_projected or flat.is_geographic) or len(factors) != 1:
        raise InputError(
            f"{name}: {source.name} is not a projected CRS and cannot be transformed to one in metres; state another"
            " with --crs, or reproject it"
        )
    (horizontal_m,) = factors
    vertical_m = stated_m or horizontal_m
    if bounds is not None and (
        why := "in degrees" if flat.is_geographic else _unlike_the_ground(flat, bounds)
    ):
        crs = _with_heights_of(source, pyproj.CRS.from_epsg(_utm_code(flat, bounds, name)))
        note = f"the clouds are in {name_of}, {why}; processing and outputs are in {crs.name}"
        return MetricCrs(source, crs, None, vertical_m), note
    if horizontal_m == 1.0 and vertical_m == 1.0:
        return MetricCrs(source, flat if source.is_bound else source), None
    crs = _with_heights_of(source, _in_metres(flat) if horizontal_m != 1.0 else flat)
    assumed = "" if stated_m is not None else " (heights assumed to be in the unit of x and y)"
    note = (
        f"the clouds are in {name_of}, with units of {horizontal_m:.10g} m, and {vertical_m:.10g} m for heights"
        f"{assumed}; processing and outputs are in metres, in {crs.name}"
    )
    return MetricCrs(source, crs, horizontal_m, vertical_m), note


def odd_place(crs: pyproj.CRS, bounds: Bounds) -> str:
    """A message about coordinates with a known fault, else "".

    Either they lie outside the area of use of their projection, and would be inside if they were swapped, or had
    another sign, another unit or no zone number; or they lie in the sea at latitude and longitude zero.
    """
    x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    if not crs.is_projected:
        return ""
    if is_plausible(crs, (x, y)):
        if np.abs(in_degrees(horizontal(crs), x, y)).max() > _NOWHERE_DEG:
            return ""
        return (
            "is at latitude 0, longitude 0, in the sea; if its origin was moved, move it back, as how long a metre on"
            f" the ground is in {crs.name} depends on the place"
        )
    own_m = horizontal(crs).axis_info[0].unit_conversion_factor
    # as in Germany: 32389000 for 389000 in zone 32
    wrong = {"x and y were swapped": (y, x), "x did not begin with a zone": (np.fmod(x, 1e6), y)}
    # as in South Africa and Bohemia
    wrong |= {"x and y had the other sign": (-x, -y), "x and y were southings and westings": (-y, -x)}
    for unit, length_m in {"mm": 0.001, "cm": 0.01, "ft": 0.3048, "m": 1.0}.items():
        wrong[f"x and y were in {unit}"] = x * length_m / own_m, y * length_m / own_m
    # the origin is inside of some areas
    fitting = [
        text for text, place in wrong.items() if np.abs(place).max() > _LOCAL and is_plausible(crs, place)
    ]
    if not fitting:
        return ""
    return (
        f"is outside of the area of {crs.name}, and would be inside if {' or '.join(fitting)}; correct its coordinates,"
        " or state its CRS with --crs"
    )


def doubtful_place(crs: pyproj.CRS, bounds: Bounds) -> str:
    """A message about where coordinates lie, if nothing but the place would tell that they are wrong, else "".

    Either they lie outside the area of use of their projection, and :func:`odd_place` knows no fault; or the CRS has
    northings before eastings, and they lie inside its area in either order.
    """
    flat, (x, y) = horizontal(crs), ((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
    is_there = is_plausible(crs, (x, y))
    if not is_there and crs.is_projected and not odd_place(crs, bounds):
        remedy = (
            f"it is not in the area of {crs.name}: state its CRS with --crs, unless its coordinates are local"
        )
    elif (
        flat.axis_info[0].direction == "north"
        and flat.axis_info[1].direction == "east"
        and is_there
        and is_plausible(crs, (y, x))
    ):
        remedy = "x and y are swapped, and the buildings would be mirrored"
    else:
        return ""
    longitude, latitude = in_degrees(flat, x, y)
    return f"is at latitude {latitude:.2f}, longitude {longitude:.2f}; if that is another place, {remedy}"


def parsed_crs(stated: str, where: str) -> pyproj.CRS:
    """The CRS that a user states. where: the option or key, for the :class:`InputError` that there is no such CRS."""
    try:
        return pyproj.CRS.from_user_input(stated)
    except pyproj.exceptions.CRSError as error:
        raise InputError(f"{where} {stated}: no such CRS; state one such as EPSG:28992") from error


def bounds_in_crs(bounds: Bounds, crs: str | pyproj.CRS, target_crs: Any) -> Bounds:
    """The smallest window in ``target_crs`` that contains ``bounds`` in ``crs``; x comes first in both."""
    source, target = pyproj.CRS.from_user_input(crs), pyproj.CRS.from_user_input(target_crs)
    if same_crs(source, target):
        return bounds
    transformer = pyproj.Transformer.from_crs(source, target, always_xy=True)
    west, south, east, north = transformer.transform_bounds(*bounds)
    return west, south, east, north


def check_crs(
    found: pyproj.CRS | None,
    expected: Any,
    path: str | Path,
    other: str = "the region is",
    remedy: str = "reproject the file or change region.crs",
) -> None:
    """Raise :class:`InputError` if a file states another CRS than ``expected``. None in place of either CRS passes.
    other: what is in ``expected``, for the message."""
    if found is None or expected is None:
        return
    expected = pyproj.CRS.from_user_input(expected)
    if not same_crs(found, expected):
        raise InputError(f"{path}: is in {found.name}, but {other} in {expected.name}; {remedy}")


def ground_scales(crs: pyproj.CRS, bounds: Bounds) -> tuple[float, float] | None:
    """(smallest, largest) length in the projection of a metre on the ground, over all directions, at the middle of
    ``bounds``; None if unknown."""
    flat = horizontal(crs)
    longitude, latitude = in_degrees(flat, (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
    if not np.isfinite([longitude, latitude]).all():
        return None
    factors = pyproj.Proj(flat).get_factors(longitude - meridian_deg(flat), latitude)
    # the axes of the ellipse of distortion
    low, high = float(factors.tissot_semiminor), float(factors.tissot_semimajor)
    return (low, high) if np.isfinite([low, high]).all() else None


def _unlike_the_ground(crs: pyproj.CRS, bounds: Bounds) -> str:
    """How the plane of a projection differs from the ground at ``bounds``, in words: axes that point south or west, or
    lengths that differ by more than 0.5 %; else ""."""
    centre = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    is_there = is_plausible(crs, centre)
    if np.abs(bounds).max() < _LOCAL and not is_there:
        return ""  # drawn or measured around an origin of its own
    directions = [axis.direction for axis in crs.axis_info]
    # both axes of a map around a pole point in one direction
    if is_there and directions[0] != directions[1] and {"south", "west"} & set(directions):
        return f"whose axes point {' and '.join(directions)}"
    scales = ground_scales(crs, bounds)
    worst = 1.0 if scales is None else max(scales, key=lambda scale: abs(scale - 1.0))
    is_long = abs(worst - 1.0) > _MAX_DISTORTION
    return f"in which a metre on the ground is {worst:.4g} m long here" if is_long else ""


def _with_heights_of(source: pyproj.CRS, plane: pyproj.CRS) -> pyproj.CRS:
    """``plane`` with the heights of ``source``, in metres: above the same datum, or above the ellipsoid if both have
    the same one. Without heights if ``source`` states no more than their unit."""
    heights = vertical_part(source)
    if is_ellipsoidal(source) and source.ellipsoid.semi_major_metre == plane.ellipsoid.semi_major_metre:
        return plane.to_3d()
    return plane if heights is None or heights.name == UNKNOWN else with_heights(plane, _in_metres(heights))


def _in_metres(crs: pyproj.CRS) -> pyproj.CRS:
    """The same CRS in metres; the one of EPSG if there is one."""
    if all(axis.unit_conversion_factor == 1.0 for axis in crs.axis_info):
        return crs
    result = in_unit(crs, 1.0, " (metres)")
    code = epsg_of(result.to_wkt(), 60)
    if code is None or not crs.is_projected:
        return result
    known = pyproj.CRS.from_epsg(code)
    area = crs.area_of_use
    if area is None or any(axis.unit_conversion_factor != 1.0 for axis in known.axis_info):
        return result
    centre = (area.west + area.east) / 2, (area.south + area.north) / 2
    places = [
        pyproj.Transformer.from_crs(c.geodetic_crs, c, always_xy=True).transform(*centre)
        for c in (result, known)
    ]
    is_same = np.hypot(*np.subtract(*places)) < _SAME_PLACE_M and known.geodetic_crs == result.geodetic_crs
    return known if is_same else result


def _utm_code(crs: pyproj.CRS, bounds: Bounds, name: str) -> int:
    """The EPSG code of the UTM zone of ``bounds``, which are in ``crs``. Raises :class:`InputError` if there is none.
    name: of the file."""
    corners = [in_degrees(crs, x, y) for x in bounds[::2] for y in bounds[1::2]]
    (x_min, y_min), (x_max, y_max) = np.min(corners, axis=0), np.max(corners, axis=0)
    if not (-180 <= x_min <= x_max <= 180 and -90 <= y_min <= y_max <= 90):
        unlike = (
            "in degrees, but its bounds are not"
            if crs.is_geographic
            else "but its bounds are not on the Earth"
        )
        raise InputError(f"{name}: is in {crs.name}, {unlike}; state its CRS with --crs")
    code = _zone(x_min, y_min, x_max, y_max)
    if code is None:
        raise InputError(f"{name}: is in {crs.name}, outside all UTM zones; reproject it")
    return code


@lru_cache(maxsize=256)
def _zone(west: float, south: float, east: float, north: float) -> int | None:
    """The EPSG code of the first UTM zone (WGS 84) that a window in degrees intersects; None without one."""
    area = pyproj.aoi.AreaOfInterest(west, south, east, north)
    zones = pyproj.database.query_utm_crs_info(datum_name="WGS 84", area_of_interest=area)
    return int(zones[0].code) if zones else None


def reprojected(shapes: np.ndarray, source: pyproj.CRS, crs: pyproj.CRS, path: str | Path) -> np.ndarray:
    """Footprints of a file, object (n,), in the horizontal part of ``crs``, without heights of vertices. A message says
    what was done.

    Coordinates that cannot be transformed become infinite. Raises :class:`InputError` if none can be, or if there is no
    transformation.
    """
    target = horizontal(crs)
    if same_crs(source, target):
        return shapes
    try:
        transformer = pyproj.Transformer.from_crs(horizontal(source), target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise InputError(f"{path}: no transformation from {source.name} to {target.name}: {error}") from error
    result = np.asarray(shapely.transform(shapes, transformer.transform, interleaved=False))
    before, after = shapely.get_coordinates(shapes), shapely.get_coordinates(result)
    if np.isfinite(before).all(axis=1).any() and not np.isfinite(after).all(axis=1).any():
        no_degrees = source.is_geographic and np.abs(before[np.isfinite(before)]).max() > 360
        remedy = "; they are no degrees: save it with its CRS (GeoJSON without one counts as degrees)"
        raise InputError(
            f"{path}: is in {source.name}, whose coordinates cannot be transformed to {target.name}"
            f"{remedy if no_degrees else ''}"
        )
    accuracy_m = _accuracy_m(transformer)
    text = "unknown accuracy" if accuracy_m is None else f"accuracy {accuracy_m:g} m"
    log.info("note: %s: reprojected from %s to %s, %s", path, source.name, target.name, text)
    if accuracy_m is None or accuracy_m > _ACCURATE_M:
        log.warning(
            "warning: %s: footprints may be displaced by up to this accuracy; a more accurate transformation needs"
            " PROJ's grids (projsync installs them); footprints in %s need no transformation",
            path,
            target.name,
        )
    return result


def _accuracy_m(transformer: pyproj.Transformer) -> float | None:
    """Accuracy of the transformation that was used last, in metres; None if unknown."""
    # 0 for a conversion between projections of one datum, which is exact
    try:
        accuracy = transformer.get_last_used_operation().accuracy
    except pyproj.exceptions.ProjError:  # PROJ found that the two are the same
        accuracy = transformer.accuracy
    return None if accuracy is None or accuracy < 0 else float(accuracy)
