"""Columns of common footprint sources: ids, heights, numbers of storeys."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from p2wss.footprints.vector_files import is_missing
from p2wss.storage.errors import InputError

log = logging.getLogger(__name__)

METRES_PER_FLOOR = 3.0
_MAX_HEIGHT_M = 1000.0
_FOOT_M = 0.3048


@dataclass(frozen=True)
class FootprintSchema:
    """Names of columns, in any case; the first one that a file has is used.

    evidence: a file has this schema if it has a column of each of these groups. ids, heights_m: height of the building
    above the ground. roof_and_ground: columns whose difference is the height. floors: number of floors, of 3 m each.
    """

    evidence: tuple[tuple[str, ...], ...]
    ids: tuple[str, ...]
    heights_m: tuple[str, ...] = ()
    roof_and_ground: tuple[tuple[str, str], ...] = ()
    floors: tuple[str, ...] = ()


# more special ones first
SCHEMAS = {
    "bdtopo": FootprintSchema(
        (("cleabs", "id"), ("hauteur",)),
        ("cleabs", "id"),
        ("hauteur", "hauteur_m"),
        (("altitude_minimale_toit", "altitude_minimale_sol"), ("z_min_toit", "z_min_sol")),
        ("nombre_d_etages", "nb_etages"),
    ),
    "3dbag": FootprintSchema(
        (("identificatie",), ("b3_h_maaiveld", "b3_h_dak_70p", "b3_h_70p", "b3_dak_type")),
        ("identificatie",),
        (),
        (("b3_h_dak_70p", "b3_h_maaiveld"), ("b3_h_70p", "b3_h_maaiveld"), ("b3_h_dak_max", "b3_h_maaiveld")),
        ("b3_bouwlagen",),
    ),
    "bag": FootprintSchema((("identificatie",),), ("identificatie",)),
    "swissbuildings": FootprintSchema(
        (("uuid", "egid"), ("dach_max", "gelaendepunkt", "gesamthoehe", "objektart")),
        ("uuid", "egid"),
        ("gesamthoehe",),
        (("dach_max", "gelaendepunkt"),),
    ),
    "osm": FootprintSchema(
        (("osm_id", "osm_way_id", "@id", "full_id", "building:levels"),),
        ("osm_id", "@id", "full_id", "osm_way_id", "id"),
        ("height", "building:height", "est_height"),
        (),
        ("building:levels", "building_levels", "levels"),
    ),
    "overture": FootprintSchema(
        (("id",), ("sources", "num_floors", "names", "roof_shape")), ("id",), ("height",), (), ("num_floors",)
    ),
}
# of a file of none of these
GENERIC = FootprintSchema(
    (),
    ("building_id", "cleabs", "id", "identificatie", "gml_id", "osm_id", "fid"),
    ("height", "height_m", "hauteur", "hauteur_m", "hoogte", "building_height"),
    (),
    ("num_floors", "nombre_d_etages", "levels", "floors"),
)


def schema_of(columns: Sequence[str], name: str = "auto") -> FootprintSchema:
    """The schema of this name, or for "auto" the one recognised from the columns, :data:`GENERIC` if none."""
    if name != "auto":
        return SCHEMAS[name]
    return SCHEMAS.get(detected(columns) or "", GENERIC)


def detected(columns: Sequence[str]) -> str | None:
    """Name of the first schema that a file with these columns has; None if none.

    >>> detected(["id", "sources", "height"]), detected(["identificatie"]), detected(["name"])
    ('overture', 'bag', None)
    """
    lower = {str(column).lower() for column in columns}
    # a file that states our own id is not from a source
    if "building_id" in lower and "sources" not in lower:
        return None
    for name, schema in SCHEMAS.items():
        if all(lower & set(group) for group in schema.evidence):
            return name
    return None


def building_ids(
    table: pd.DataFrame, schema: FootprintSchema, id_field: str | None, path: str | Path
) -> pd.Series:
    """A unique id per row, as text; the index of ``table`` has the number of each feature in its file.

    Ids are those of the column ``id_field``, else of the first column of the schema without missing or repeated values,
    else of its first with any. A missing id becomes the number of the feature. A repeated one gets a suffix _2, _3, ..
    from its second occurrence on; all others stay. Without such a column, ids are the numbers. A warning reports
    all that differs from the file.

    Raises :class:`InputError` if there is no column ``id_field``.
    """
    by_name = {str(column).lower(): column for column in table.columns}
    if id_field is not None:
        if id_field not in table.columns:
            columns = ", ".join(map(str, table.columns))
            raise InputError(f"{path}: has no column {id_field}; its columns are {columns or 'none'}")
        candidates = [id_field]
    else:
        candidates = [by_name[name] for name in schema.ids if name in by_name]
        candidates = [
            column for column in candidates if not is_missing(table[column]).all() or not len(table)
        ]
    problems = {column: _problem(table[column]) for column in candidates}
    column = next((column for column, problem in problems.items() if problem is None), None)
    if column is None and candidates:
        column = candidates[0]
        log.warning(
            "warning: %s: id column %s: %s; repeated ids get the suffixes _2, _3, .., and missing ids become the number"
            " of the feature (--id-field selects another column)",
            path,
            column,
            problems[column],
        )
    elif candidates and column != candidates[0]:
        log.warning(
            "warning: %s: column %s: %s; ids are taken from column %s instead (--id-field selects another)",
            path,
            candidates[0],
            problems[candidates[0]],
            column,
        )
    number = pd.Series(table.index.astype(str), index=table.index, dtype=str)
    if column is None:
        return number
    is_known = ~is_missing(table[column])
    return _unique(_as_text(table[column]).where(is_known, number), is_known)


def _as_text(values: pd.Series) -> pd.Series:
    # whole numbers beside missing ones are read as floats
    if pd.api.types.is_float_dtype(values) and (values.dropna() % 1 == 0).all():
        return values.map(lambda value: "" if pd.isna(value) else str(int(value)))
    return values.astype(str)


def _unique(names: pd.Series, is_known: np.ndarray) -> pd.Series:
    """The names, repeated ones with a suffix that leads to no other name; first those that are known."""
    result = names.to_numpy(dtype=object).copy()
    repeated = np.zeros(len(names), bool)
    repeated[is_known] = names[is_known].duplicated()
    repeated[~is_known] = names[~is_known].isin(names[is_known])
    used, count = set(result[~repeated]), dict.fromkeys(result[repeated], 1)
    used |= set(names)
    for i in np.flatnonzero(repeated):
        name = result[i]
        while result[i] in used:
            count[name] += 1
            result[i] = f"{name}_{count[name]}"
        used.add(result[i])
    return pd.Series(result, index=names.index, dtype=str)


def taken_part_numbers(names: pd.Series) -> dict[str, set[int]]:
    """For each name N, the numbers k for which another name is ``N-k``: parts of N cannot have them.

    >>> taken_part_numbers(pd.Series(["A", "A-1", "A-1-7", "B-2"]))
    {'A': {1}, 'A-1': {7}}
    """
    result: dict[str, set[int]] = {}
    known = set(names)
    for name in names[names.str.contains(r"-[1-9][0-9]{0,8}$")]:
        whole, _, number = name.rpartition("-")
        if whole in known:
            result.setdefault(whole, set()).add(int(number))
    return result


def _problem(values: pd.Series) -> str | None:
    """Why a column cannot be the id of features as it is, or None."""
    missing = is_missing(values)
    known = values[~missing]
    problems = []
    if missing.any():
        problems.append(f"{missing.sum()} of {len(values)} values are missing")
    if known.duplicated().any():
        again = known[known.duplicated()]
        problems.append(
            f"{again.iloc[0]} occurs more than once" + f" (as do {len(again) - 1} more)" * (len(again) > 1)
        )
    return ", ".join(problems) or None


def stated_heights_m(
    table: pd.DataFrame, schema: FootprintSchema, height_field: str | None, path: str | Path
) -> np.ndarray:
    """The height that each footprint states, above its ground, float64 (n,); NaN if unknown.

    From the column ``height_field`` or, in this order, the schema's heights, differences and floors of 3 m; text such
    as "12.5 m" or "40 ft" too. Raises :class:`InputError` if there is no column ``height_field``.
    """
    if height_field is not None and height_field not in table.columns:
        columns = ", ".join(map(str, table.columns))
        raise InputError(f"{path}: has no column {height_field}; its columns are {columns or 'none'}")
    by_name = {str(column).lower(): table[column] for column in table.columns}
    candidates = [] if height_field is None else [_metres(table[height_field])]
    candidates += [_metres(by_name[name]) for name in schema.heights_m if name in by_name]
    candidates += [
        _metres(by_name[roof]) - _metres(by_name[ground])
        for roof, ground in schema.roof_and_ground
        if roof in by_name and ground in by_name
    ]
    candidates += [METRES_PER_FLOOR * _metres(by_name[name]) for name in schema.floors if name in by_name]
    result = np.full(len(table), np.nan)
    for height_m in candidates:
        is_plausible = np.isnan(result) & (height_m > 0) & (height_m <= _MAX_HEIGHT_M)
        result[is_plausible] = height_m[is_plausible]
    return result


def _metres(values: pd.Series) -> np.ndarray:
    """Numbers, or text with a number in metres (m or nothing) or feet (ft or ')."""
    if pd.api.types.is_numeric_dtype(values):
        return values.to_numpy(dtype=np.float64, na_value=np.nan)
    parts = values.astype(str).str.strip().str.replace(",", ".").str.extract(r"^([\d.]+)\s*(m|ft|'|)$")
    number = pd.to_numeric(parts[0], errors="coerce").to_numpy(dtype=np.float64)
    return np.where(parts[1].isin(["ft", "'"]), _FOOT_M, 1.0) * number
