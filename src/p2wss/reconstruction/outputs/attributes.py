"""The attributes of buildings, the same in every output format that has attributes.

`docs/manual/attributes.md` defines them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import date, datetime
from typing import Any

import numpy as np
import pyproj
import shapely

from p2wss.data import reasons
from p2wss.reconstruction.outputs import measures
from p2wss.reconstruction.result import Result
from p2wss.storage.features import Features
from p2wss.storage.las_crs import horizontal

P2WSS, NAMES_3DBAG = "p2wss", "3dbag"
# our names, and the names of 3DBAG for them (https://docs.3dbag.nl/en/schema/attributes)
TO_3DBAG = {
    "ground_z_m": "b3_h_maaiveld",
    "roof_z_min_m": "b3_h_dak_min",
    "roof_z_p50_m": "b3_h_dak_50p",
    "roof_z_p70_m": "b3_h_dak_70p",
    "roof_z_max_m": "b3_h_dak_max",
    "ridge_z_m": "b3_h_nok",
    "roof_type": "b3_dak_type",
    "volume_m3": "b3_volume_lod22",
    "ground_area_m2": "b3_opp_grond",
    "flat_roof_area_m2": "b3_opp_dak_plat",
    "sloped_roof_area_m2": "b3_opp_dak_schuin",
    "outer_wall_area_m2": "b3_opp_buitenmuur",
    "party_wall_area_m2": "b3_opp_scheidingsmuur",
    "rmse_m": "b3_rmse_lod22",
    "is_reliable": "b3_kwaliteitsindicator",
    "points_date": "b3_pw_datum",
    "slope_deg": "b3_hellingshoek",
    "azimuth_deg": "b3_azimut",
}
_MAX_WHOLE = np.iinfo(np.int64).max
_LEVEL_ROOFS_3DBAG = {measures.FLAT: "horizontal", measures.FLATS: "multiple horizontal"}


def with_columns(result: Result, names: Sequence[str]) -> Result:
    """The result with only these columns of its footprint; with "all" among the names, all columns stay."""
    if "all" in names:
        return result
    return replace(result, columns={name: result.columns[name] for name in names if name in result.columns})


def attributes(result: Result, facts: Mapping[str, Any] | None = None, names: str = P2WSS) -> dict[str, Any]:
    """The attributes of a building: the columns of its footprint, then p2wss's own attributes; None for unknown values.

    A column of the input gets the prefix ``input_`` if it has the name of one of these attributes or of another column.
    Case does not count, as SQL tables ignore it. names: ``p2wss``, or ``3dbag`` for the names of 3DBAG where there is
    one. facts: of the run; its ``clouds`` are an attribute of 3DBAG.
    """
    ours = _attributes(result)
    if names == NAMES_3DBAG:
        ours = _as_in_3dbag(ours, result, (facts or {}).get("clouds", []))
    # GeoPackage has columns geom and fid
    taken, columns = {name.lower() for name in (*ours, "building_id", "geometry", "geom", "fid")}, {}
    for name, value in result.columns.items():
        while name.lower() in taken:
            name = f"input_{name}"
        taken.add(name.lower())
        columns[name] = _plain(value)
    return columns | ours


def _attributes(result: Result) -> dict[str, Any]:
    reconstruction, given = result.reconstruction, result.num_lines
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
        "ground_source": result.ground and result.ground[0],
        "ground_sd_m": result.ground and _rounded(result.ground[1]),
        "residual_m": _rounded(result.residual_m),
        "rmse_m": _rounded(result.rmse_m),
        "share_within_20cm": _rounded(result.share_within_20cm),
        "not_representable": result.not_representable,
        "is_reliable": result.is_reliable,
        "visible_share": _rounded(result.visible_share),
        "num_points": result.num_points,
        "num_parts": reconstruction.num_parts if reconstruction.has_mesh else None,
        "num_triangles": reconstruction.num_triangles,
        **_mesh_attributes(result),
        "overhang_m": _rounded(result.overhang_m),
        **_registration_attributes(result),
        "points_date": None if result.dates is None else result.dates[1].isoformat(),
        **({} if given is None else {"lines_given": given, "lines_used": reconstruction.num_lines_used}),
    }


def _registration_attributes(result: Result) -> dict[str, Any]:
    registration = result.registration
    return {
        "shift_x_m": registration and _rounded(registration.shift_m[0]),
        "shift_y_m": registration and _rounded(registration.shift_m[1]),
        "shift_sd_m": registration and _rounded(registration.shift_sd_m),
        "shift_source": registration and registration.source,
        "footprint_flags": " ".join(result.flags) or None,
        "ground_inside_m2": registration and _rounded(registration.ground_inside_m2),
        "roof_outside_m2": registration and _rounded(registration.roof_outside_m2),
    }


_MESH_ATTRIBUTES = (
    "roof_type",
    "roof_z_min_m",
    "roof_z_p50_m",
    "roof_z_p70_m",
    "roof_z_max_m",
    "ridge_z_m",
    "volume_m3",
    "ground_area_m2",
    "flat_roof_area_m2",
    "sloped_roof_area_m2",
    "outer_floor_area_m2",
    "outer_wall_area_m2",
    "party_wall_area_m2",
    "extrapolated_area_m2",
)


def _mesh_attributes(result: Result) -> dict[str, Any]:
    measured = result.measures
    if measured is None:
        return dict.fromkeys(_MESH_ATTRIBUTES)
    values = vars(measured) | {
        "party_wall_area_m2": result.party_wall_area_m2,
        "outer_wall_area_m2": max(measured.wall_area_m2 - result.party_wall_area_m2, 0.0),
        "extrapolated_area_m2": result.unseen_roof_area_m2,
    }
    return {
        name: values[name] if name == "roof_type" else _rounded(values[name]) for name in _MESH_ATTRIBUTES
    }


def _as_in_3dbag(ours: dict[str, Any], result: Result, clouds: Sequence[str]) -> dict[str, Any]:
    values = dict(ours)
    if result.status == "ok":
        values["roof_type"] = _LEVEL_ROOFS_3DBAG.get(ours["roof_type"], "slanted")
    else:
        values["roof_type"] = "no points" if result.reason in reasons.UNSEEN else "no planes"
    values["points_date"] = None if result.dates is None else result.dates[1].year
    renamed = {TO_3DBAG.get(name, name): value for name, value in values.items()}
    # a list of error codes as text; all that is written is valid
    return renamed | {
        "b3_val3dity_lod22": "[]" if result.reconstruction.has_mesh else None,
        "b3_pw_bron": ", ".join(clouds) or None,
    }


def _plain(value: Any) -> Any:
    """A value of a column as a type of JSON: None for floats that are not finite, text for unknown types."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, datetime | date):
        return value.isoformat()
    return str(value)


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), 3)


def table(
    results: Sequence[Result],
    crs: pyproj.CRS,
    facts: Mapping[str, Any] | None = None,
    names: str = P2WSS,
) -> Features:
    """A row per footprint: the cleaned geometry (none if it was rejected) and the :func:`attributes`.

    ``angle_deg`` is text with one number per edge; edge i begins at vertex i of the geometry, rings in order.
    """
    rows: list[dict[str, Any]] = []
    shapes: list[shapely.Polygon | None] = []
    for result in results:
        reconstruction = result.reconstruction
        rows.append({"building_id": reconstruction.building_id, **attributes(result, facts, names)})
        rings = [ring + reconstruction.origin_xy_m for ring in reconstruction.rings]
        shapes.append(shapely.Polygon(rings[0], rings[1:]) if rings else None)
    columns = {name: _column([row.get(name) for row in rows]) for row in rows[:1] for name in row}
    return Features(np.array(shapes, object), columns, horizontal(crs))


def _column(values: list[Any]) -> np.ndarray:
    """The values as an array: floats with NaN for unknown values, or objects with None. Values of several types become
    text, and so do integers if one is beyond 64 bits."""
    kinds = {type(value) for value in values}
    known = kinds - {type(None)}
    if float in known and known <= {int, float}:
        return np.array(values, float)
    if len(known) > 1 or (known == {int} and max(abs(value or 0) for value in values) > _MAX_WHOLE):
        return np.array([value if value is None else str(value) for value in values], object)
    return np.array(values, None if kinds in ({int}, {bool}) else object)


def input_footprints(results: Sequence[Result], crs: pyproj.CRS) -> Features | None:
    """A row per footprint with its cleaned polygon before the registration; None if no footprint has a registration."""
    rows = [(result.reconstruction.building_id, result.registration) for result in results]
    if not any(registration for _, registration in rows):
        return None
    names = [name for name, _ in rows]
    shapes = [None if row is None or row.input_polygon.is_empty else row.input_polygon for _, row in rows]
    return Features(np.array(shapes, object), {"building_id": np.array(names, object)}, horizontal(crs))
