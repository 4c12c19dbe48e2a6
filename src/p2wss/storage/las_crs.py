"""What a LAS header states of its CRS and of the unit of its heights: in WKT, in GeoTIFF keys, or partly in each.

laspy reads the first record that it knows, and of GeoTIFF keys the horizontal CRS only. The rest is read here.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache

import laspy
import numpy as np
import pyproj

from p2wss.storage.messages import log

# name of a vertical CRS if only its unit is known
UNKNOWN = "unknown height"
# GeoTIFF keys
_GEOGRAPHIC_CRS, _PROJECTED_CRS, _LINEAR_UNIT, _VERTICAL_CRS, _VERTICAL_UNIT = 2048, 3072, 3076, 4096, 4099
# the value of a key for a projection without a code; the record id of WKT, which libLAS already wrote beside keys
# before LAS 1.4 defined it
_NO_CODE, _WKT = 32767, 2112
# codes of vertical CRSs in GeoTIFF 1.0, and the codes of EPSG for the same CRSs
_OLD_VERTICAL = {5101: 5701, 5102: 7968, 5103: 5703, 5104: 5704, 5105: 5705}
_VERTICAL_WKT = re.compile(r"\b(VERT_CS|VERTCS|VERTCRS|VERTICALCRS)\s*\[", re.IGNORECASE)
# longer than all feet
_FOOT_M = 0.31
# coordinates count as plausible this far beyond the area of use
_MARGIN_DEG = 2.0


@dataclass(frozen=True)
class Stated:
    """What a header states. crs: of the plane, and of heights if they are stated; None if PROJ knows none. heights:
    vertical CRS, which may be stated without ``crs``. doubts: what is not used or contradicts itself, a line each."""

    crs: pyproj.CRS | None
    heights: pyproj.CRS | None
    doubts: tuple[str, ...]


def stated_crs(header: laspy.LasHeader) -> Stated:
    """All that a header states. Where two statements contradict each other, one is chosen and a doubt names both."""
    doubts: list[str] = []
    records = [*header.vlrs, *(header.evlrs or [])]
    of_keys, heights, keys = None, None, {}
    for record in records:
        if isinstance(record, laspy.vlrs.known.GeoKeyDirectoryVlr):
            keys = {key.id: key.value_offset for key in record.geo_keys if key.tiff_tag_location == 0}
            of_keys = _of_keys(keys, header, doubts)
            heights = _heights(keys, doubts)
    of_wkts = list(_of_wkt(records, "LASF_Projection", doubts))
    if of_keys is None and not of_wkts:
        of_wkts += _of_wkt(records, "liblas", doubts)
    of_wkt = next(filter(placed, of_wkts), None)
    crs = of_wkt or of_keys
    if crs is None and keys.get(_PROJECTED_CRS) == _NO_CODE:
        doubts.append(
            "its GeoTIFF keys describe a projection without a code, which is not read (--crs states it)"
        )
    if of_wkt is not None and of_keys is not None and not _same_plane(of_wkt, of_keys):
        crs = _one_of((of_wkt, of_keys), header)
        doubts.append(
            f"WKT states {of_wkt.name}, GeoTIFF keys {of_keys.name}; {crs.name} is taken, in which its bounds are"
            " plausible"
        )
    vertical = next((part for part in map(vertical_part, of_wkts) if part is not None), None)
    if vertical is not None:
        if heights is not None and unit_m(heights) != unit_m(vertical):
            doubts.append(
                f"WKT states heights in units of {unit_m(vertical):.10g} m, GeoTIFF keys of {unit_m(heights):.10g} m;"
                " the former is taken (--height-unit overrides)"
            )
        heights = vertical
    if heights is not None and "foot" in heights.axis_info[0].unit_name.lower() and unit_m(heights) > _FOOT_M:
        name = heights.axis_info[0].unit_name
        doubts.append(
            f"it states heights in units of {unit_m(heights):.10g} m with the name {name}; the length is taken"
            " (--height-unit overrides)"
        )
    if crs is not None and heights is not None:
        crs = with_heights(crs, heights)
    return Stated(crs, heights, tuple(doubts))


def crs_of(header: laspy.LasHeader) -> pyproj.CRS | None:
    """The CRS that a header states, with a warning for each doubt."""
    stated = stated_crs(header)
    for doubt in stated.doubts:
        log.warning("warning: a cloud: %s", doubt)
    return stated.crs


def vertical_part(crs: pyproj.CRS) -> pyproj.CRS | None:
    """The vertical CRS of a compound CRS; a vertical CRS itself; :data:`UNKNOWN` with a unit for heights above an
    ellipsoid; None without heights."""
    if crs.is_compound:
        return crs.sub_crs_list[1]
    if crs.is_vertical:
        return crs
    return _in_unit(crs.axis_info[2].unit_conversion_factor) if is_ellipsoidal(crs) else None


def is_ellipsoidal(crs: pyproj.CRS) -> bool:
    """Whether heights are above an ellipsoid: the CRS has a third axis, but is not compound."""
    return len(crs.axis_info) == 3 and not crs.is_compound


def unit_m(crs: pyproj.CRS) -> float:
    """Length in metres of the unit of a vertical CRS."""
    return float(crs.axis_info[0].unit_conversion_factor)


def with_heights(crs: pyproj.CRS, heights: pyproj.CRS) -> pyproj.CRS:
    """The compound of ``crs`` and ``heights``. ``crs`` itself if it has heights, or if ``heights`` only states
    metres."""
    if crs.is_compound or is_ellipsoidal(crs) or (heights.name == UNKNOWN and unit_m(heights) == 1.0):
        return crs
    return pyproj.crs.CompoundCRS(f"{crs.name} + {heights.name}", [crs, heights])


def in_unit(crs: pyproj.CRS, length_m: float, suffix: str = "") -> pyproj.CRS:
    """The same CRS with axes in a unit of ``length_m``; lengths among its parameters keep their units. suffix: added to
    its name."""
    stated = crs.to_json_dict()
    # if a CRS states a shift to another datum (TOWGS84), its source CRS has the axes
    flat = stated.get("source_crs", stated)
    unit = {"type": "LinearUnit", "name": f"{length_m:.10g} m", "conversion_factor": length_m}
    for axis in flat["coordinate_system"]["axis"]:
        axis["unit"] = "metre" if length_m == 1.0 else unit
    flat.pop("id", None)
    flat["name"] = crs.name + suffix
    return pyproj.CRS.from_json_dict(stated)


def _of_wkt(
    records: Iterable[laspy.vlrs.vlr.BaseVLR], user_id: str, doubts: list[str]
) -> Iterator[pyproj.CRS]:
    for record in records:
        if (record.user_id, record.record_id) != (user_id, _WKT):
            continue
        wkt = record.record_data_bytes().rstrip(b"\0 ").decode("utf-8-sig", "replace")
        if not wkt:
            continue
        try:
            # a code, PROJJSON or a PROJ string are there, too
            crs = as_of_epsg(pyproj.CRS.from_user_input(wkt))
        except pyproj.exceptions.CRSError as error:
            doubts.append(f"its WKT is not used: {error!s:.150}")
            continue
        if placed(crs) is None and vertical_part(crs) is not crs:
            doubts.append(f"its CRS, {crs.name}, is not used: it is neither projected nor in degrees")
            continue
        # PROJ reads no further than to the end of the first CRS
        beside = _VERTICAL_WKT.search(wkt)
        if vertical_part(crs) is None and beside is not None:
            try:
                crs = with_heights(crs, pyproj.CRS.from_wkt(_balanced(wkt[beside.start() :])))
            except pyproj.exceptions.CRSError as error:
                doubts.append(f"the heights in its WKT are not used: {error}")
        yield crs


def _balanced(wkt: str) -> str:
    """The first element of a WKT, to the bracket that closes it."""
    depth = np.cumsum([(each == "[") - (each == "]") for each in wkt])
    ends = np.flatnonzero((depth == 0) & (np.array(list(wkt)) == "]"))
    return wkt[: ends[0] + 1] if len(ends) else wkt


def _of_keys(keys: dict[int, int], header: laspy.LasHeader, doubts: list[str]) -> pyproj.CRS | None:
    """The horizontal CRS that GeoTIFF keys state by a code of EPSG, else None. A projected CRS comes first: some clouds
    state an unknown geographic CRS beside it."""
    code = keys.get(_PROJECTED_CRS) or keys.get(_GEOGRAPHIC_CRS)
    if not code or not 1024 <= code <= 32766:
        return None
    try:
        crs = pyproj.CRS.from_epsg(code)
    except pyproj.exceptions.CRSError as error:
        doubts.append(f"its GeoTIFF keys are not used: {error}")
        return None
    length_m = _units().get(keys.get(_LINEAR_UNIT, 0))
    own_m = crs.axis_info[0].unit_conversion_factor
    if not crs.is_projected or length_m is None or np.isclose(length_m, own_m, rtol=1e-9):
        return crs
    other = in_unit(crs, length_m)
    chosen = _one_of((crs, other), header)
    doubts.append(
        f"it is in {crs.name}, with units of {own_m:.10g} m, but states units of {length_m:.10g} m; those of"
        f" {chosen.axis_info[0].unit_conversion_factor:.10g} m are taken, in which its bounds are plausible"
    )
    return chosen


def _heights(keys: dict[int, int], doubts: list[str]) -> pyproj.CRS | None:
    code, length_m = keys.get(_VERTICAL_CRS, 0), _units().get(keys.get(_VERTICAL_UNIT, 0))
    heights = None
    if 1024 <= code <= 32766:
        with suppress(pyproj.exceptions.CRSError):  # of an ellipsoid, in old files
            heights = pyproj.CRS.from_epsg(_OLD_VERTICAL.get(code, code))
    if heights is not None and not heights.is_vertical:
        heights = None
    if length_m is None:
        return heights
    if heights is None:
        return _in_unit(length_m)
    if not np.isclose(length_m, unit_m(heights), rtol=1e-9):
        doubts.append(
            f"it states heights of {heights.name}, in units of {unit_m(heights):.10g} m, but also units of"
            f" {length_m:.10g} m; the latter are taken (--height-unit overrides)"
        )
        heights = in_unit(heights, length_m)
    return heights


def _in_unit(length_m: float) -> pyproj.CRS:
    unit = f'LENGTHUNIT["{length_m:.10g} m",{length_m!r}]'
    return pyproj.CRS.from_wkt(
        f'VERTCRS["{UNKNOWN}",VDATUM["unknown"],CS[vertical,1],AXIS["height",up],{unit}]'
    )


@cache
def _units() -> dict[int, float]:
    """Lengths in metres of EPSG's units of length, by their codes."""
    units = pyproj.database.get_units_map(auth_name="EPSG", category="linear", allow_deprecated=True)
    return {int(unit.code): float(unit.conv_factor) for unit in units.values() if unit.code.isdigit()}


def same_crs(first: pyproj.CRS, second: pyproj.CRS, min_confidence: int = 70) -> bool:
    """Whether two CRSs have the same horizontal part; heights, axis order and names are ignored. min_confidence:
    percent, with which PROJ must identify both as the same CRS of EPSG."""
    a, b = horizontal(first), horizontal(second)
    if a.equals(b, ignore_axis_order=True):
        return True
    codes = [epsg_of(each.to_wkt(), min_confidence) for each in (a, b)]
    return codes[0] is not None and codes[0] == codes[1]


def _same_plane(first: pyproj.CRS, second: pyproj.CRS) -> bool:
    units = {crs.axis_info[0].unit_conversion_factor for crs in (first, second)}
    return len(units) == 1 and same_crs(first, second, 25)


def _one_of(candidates: tuple[pyproj.CRS, pyproj.CRS], header: laspy.LasHeader) -> pyproj.CRS:
    """The first candidate in whose area of use the bounds of the header lie; the first candidate if there is none."""
    centre = (header.mins[:2] + header.maxs[:2]) / 2
    return next((crs for crs in candidates if is_plausible(crs, centre)), candidates[0])


def in_degrees(flat: pyproj.CRS, x: float, y: float) -> tuple[float, float]:
    """Longitude from Greenwich and latitude, degrees, of a place in a projected or geographic CRS. The CRS may count in
    grads and from another meridian, as older French CRSs do (from Paris)."""
    base = flat.geodetic_crs
    if flat.is_projected:
        x, y = pyproj.Transformer.from_crs(flat, base, always_xy=True).transform(x, y)
    unit = float(np.rad2deg(base.axis_info[0].unit_conversion_factor))
    return x * unit + meridian_deg(flat), y * unit


def meridian_deg(flat: pyproj.CRS) -> float:
    """Longitude of the prime meridian of a CRS, degrees from Greenwich."""
    meridian = flat.prime_meridian
    return (
        0.0 if meridian is None else float(np.rad2deg(meridian.longitude * meridian.unit_conversion_factor))
    )


def placed(crs: pyproj.CRS | None) -> pyproj.CRS | None:
    """The CRS; None if its x and y do not tell a place on the Earth, as in local (engineering) CRSs."""
    return crs if crs is not None and (crs.is_projected or crs.is_geographic) else None


@lru_cache(maxsize=256)
def epsg_of(wkt: str, min_confidence: int) -> int | None:
    """The EPSG code of a CRS, or None. PROJ searches its database for it, for a tenth of a second or so.

    The order of the axes does not count: in many countries, such as Sweden, Poland, Japan and New Zealand, northings
    come first, but WKT 1 states eastings first, so that PROJ does not recognise their CRSs. min_confidence: of PROJ in
    a code, in percent; it is not asked for a code whose definition is the same.
    """
    crs = pyproj.CRS.from_wkt(wkt)
    stated = crs.to_json_dict().get("id", {})
    if stated.get("authority") == "EPSG" and _is_of_epsg(crs, stated["code"]):
        return int(stated["code"])
    code = crs.to_epsg(min_confidence=min_confidence)
    if code is None:
        similar = (each.code for each in crs.list_authority("EPSG", min_confidence=20))
        code = next((int(each) for each in similar if _is_of_epsg(crs, each)), None)
    return code


def _is_of_epsg(crs: pyproj.CRS, code: str | int) -> bool:
    """Whether a CRS has the definition of an EPSG code, as EPSG states it or as WKT 1 does."""
    try:
        known = pyproj.CRS.from_epsg(code)
        return bool(crs in (known, pyproj.CRS.from_wkt(known.to_wkt("WKT1_GDAL"))))
    except pyproj.exceptions.CRSError:  # no such code, or none that WKT 1 can state
        return False


def as_of_epsg(crs: pyproj.CRS) -> pyproj.CRS:
    """The CRS as EPSG defines it, if the two differ in no more than the order of axes; otherwise the CRS itself."""
    if crs.is_compound:
        parts = [as_of_epsg(part) for part in crs.sub_crs_list]
        return crs if parts == crs.sub_crs_list else pyproj.crs.CompoundCRS(crs.name, parts)
    base = crs.source_crs if crs.is_bound else crs
    code = epsg_of(base.to_wkt(), 70) if base is not None and base.is_projected else None
    known = base if code is None else pyproj.CRS.from_epsg(code)
    return crs if base == known else known


def horizontal(crs: pyproj.CRS) -> pyproj.CRS:
    """The horizontal part of a compound or 3D CRS. A CRS of EPSG is returned without the shift to WGS 84 (TOWGS84) that
    programs used to add."""
    flat = crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()
    base = flat.source_crs if flat.is_bound else None
    return flat if base is None or epsg_of(base.to_wkt(), 70) is None else base


def is_plausible(crs: pyproj.CRS, centre: Sequence[float] | np.ndarray) -> bool:
    """Whether a place (x, y) lies in the area of use of a CRS, or at most two degrees outside."""
    flat = horizontal(crs)
    x, y = in_degrees(flat, *centre)
    area = flat.area_of_use
    if area is None and (code := epsg_of(flat.to_wkt(), 70)) is not None:
        area = pyproj.CRS.from_epsg(code).area_of_use  # WKT 1, which most files have, states none
    west, south, east, north = (-180, -90, 180, 90) if area is None else area.bounds
    is_within = west - _MARGIN_DEG <= x <= east + _MARGIN_DEG or (west > east and (x >= west or x <= east))
    return bool(np.isfinite([x, y]).all() and is_within and south - _MARGIN_DEG <= y <= north + _MARGIN_DEG)
