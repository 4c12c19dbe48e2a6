"""Columns of common footprint sources: ids, heights, numbers of storeys."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from p2wss.footprints.osm_tags import with_others
from p2wss.footprints.vector_files import is_missing
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError, log

METRES_PER_FLOOR = 3.0
_MAX_HEIGHT_M = 1000.0
_FOOT_M = 0.3048
_SHAPEFILE_LENGTH = 10
_LENGTH = re.compile(r"(\d+\.?\d*|\.\d+)\s*(m|ft|'|)")
_PART = re.compile(r"(.*)-([1-9][0-9]{0,8})", re.DOTALL)


@dataclass(frozen=True)
class FootprintSchema:
    """Names of columns, in upper or lower case; of several names, the first one that a file has is used.

    evidence: a file has this schema if it has a column of each of these groups. ids: ids of buildings. heights_m:
    height of the building above the ground. roof_and_ground: pairs of columns, the height is their difference. floors:
    number of floors, of 3 m each.
    """

    evidence: tuple[tuple[str, ...], ...]
    ids: tuple[str, ...]
    heights_m: tuple[str, ...] = ()
    roof_and_ground: tuple[tuple[str, str], ...] = ()
    floors: tuple[str, ...] = ()


# the more special schemas first
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
# for a file that has none of these schemas
GENERIC = FootprintSchema(
    (),
    ("building_id", "cleabs", "id", "identificatie", "gml_id", "osm_id", "fid"),
    ("height", "height_m", "hauteur", "hauteur_m", "hoogte", "building_height"),
    # columns of the footprints that p2wss fetches
    (("altitude_minimale_toit_m", "altitude_minimale_sol_m"),),
    ("num_floors", "nombre_d_etages", "levels", "floors"),
)


# names that are longer than a shapefile allows
_LONG = tuple(
    name
    for each in (*SCHEMAS.values(), GENERIC)
    for names in (*each.evidence, each.ids, each.heights_m, *each.roof_and_ground, each.floors)
    for name in names
    if len(name) > _SHAPEFILE_LENGTH
)


def by_name(columns: Collection[str]) -> dict[str, str]:
    """The columns by their names in lower case. A name of ten characters also stands for longer names of schemas that
    begin with it, because a shapefile keeps only ten characters.

    >>> by_name(["building_i", "AREA"])["building_id"]
    'building_i'
    """
    lower = {str(column).lower(): column for column in columns}
    whole = {name: lower[name[:_SHAPEFILE_LENGTH]] for name in _LONG if name[:_SHAPEFILE_LENGTH] in lower}
    return {**whole, **lower}


def schema_of(columns: Collection[str], name: str = "auto") -> FootprintSchema:
    """The schema of this name; for "auto", the schema recognised by the columns, or :data:`GENERIC`."""
    return SCHEMAS.get(detected(columns) or "", GENERIC) if name == "auto" else SCHEMAS[name]


def detected(columns: Collection[str]) -> str | None:
    """Name of the first schema that a file with these columns has; None if none.

    >>> detected(["id", "sources", "height"]), detected(["identificatie"]), detected(["name"])
    ('overture', 'bag', None)
    """
    lower = set(by_name(columns))
    # a file that states our own id is not from a source
    if "building_id" in lower and "sources" not in lower:
        return None
    known = (name for name, each in SCHEMAS.items() if all(lower & set(group) for group in each.evidence))
    return next(known, None)


def building_ids(
    columns: Mapping[str, np.ndarray],
    number: np.ndarray,
    schema: FootprintSchema,
    id_field: str | None,
    path: str | Path,
) -> list[str]:
    """A unique id per feature. number: the number of each feature in its file.

    Ids are taken from the column ``id_field``. Without it, they are from the schema's first column without missing and
    repeated values, else from its first column with any value. A missing id becomes the number of the feature. A
    repeated id gets a suffix _2, _3, .. from its second occurrence on; all other ids stay. Without any such column, ids
    are the numbers. A warning tells if ids differ from the column, or are not from the first one.

    Raises :class:`InputError` if there is no column ``id_field``.
    """
    column_of = by_name(columns)
    # GDAL fills the first column for a relation, the second one for a way
    if {"osm_id", "osm_way_id"} <= set(column_of):
        relation, way = columns[column_of["osm_id"]], columns[column_of["osm_way_id"]]
        is_way = is_missing(relation) & ~is_missing(way)
        ids = np.where(is_way, np.array(_as_text(way), object), np.array(_as_text(relation), object))
        ids[is_missing(relation) & is_missing(way)] = None
        columns = {**columns, column_of["osm_id"]: ids}
    if id_field is not None:
        _column(columns, id_field, path)
        candidates = [id_field]
    else:
        known = [column_of[name] for name in schema.ids if name in column_of]
        candidates = [column for column in known if not is_missing(columns[column]).all() or not len(number)]
    problems = {column: _problem(columns[column]) for column in candidates}
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
    numbers = list(map(str, number.tolist()))
    if column is None:
        return numbers
    is_known = ~is_missing(columns[column])
    names = np.where(is_known, np.array(_as_text(columns[column]), object), numbers)
    return _unique(names.tolist(), is_known)


def _as_text(values: np.ndarray) -> list[str]:
    # whole numbers beside missing ones are read as floats
    if values.dtype.kind == "f" and (values[~np.isnan(values)] % 1 == 0).all():
        return [str(int(np.nan_to_num(value))) for value in values]
    return list(map(str, values.tolist()))


def _unique(names: list[str], is_known: np.ndarray) -> list[str]:
    """The names, made unique: repeated names get a suffix with which they equal no other name. Names that are not known
    are looked at last, so that they get the suffix."""
    result, used, count = list(names), set(names), dict.fromkeys(names, 1)
    order = np.argsort(~is_known, kind="stable")
    for i in order[_is_repeated([names[i] for i in order])]:
        while result[i] in used:
            count[names[i]] += 1
            result[i] = f"{names[i]}_{count[names[i]]}"
        used.add(result[i])
    return result


def _is_repeated(values: Sequence[Any]) -> np.ndarray:
    """bool (n,): whether the same value occurs before."""
    first = {value: i for i, value in reversed(list(enumerate(values)))}
    return np.array([first[value] < i for i, value in enumerate(values)], bool)


def taken_part_numbers(names: Sequence[str]) -> dict[str, set[int]]:
    """For each name N, the numbers k for which another name is ``N-k``: parts of N cannot have them.

    >>> taken_part_numbers(["A", "A-1", "A-1-7", "B-2"])
    {'A': {1}, 'A-1': {7}}
    """
    result: dict[str, set[int]] = {}
    known = set(names)
    for found in filter(None, map(_PART.fullmatch, names)):
        if found[1] in known:
            result.setdefault(found[1], set()).add(int(found[2]))
    return result


def _problem(values: np.ndarray) -> str | None:
    """Why a column cannot be the id of features as it is, or None."""
    missing = is_missing(values)
    known = values[~missing]
    problems = []
    if missing.any():
        problems.append(f"{missing.sum()} of {len(values)} values are missing")
    again = known[_is_repeated(known.tolist())]
    if len(again):
        problems.append(
            f"{again[0]} occurs more than once" + f" (as do {len(again) - 1} more)" * (len(again) > 1)
        )
    return ", ".join(problems) or None


def _column(columns: Mapping[str, np.ndarray], name: str, path: str | Path) -> np.ndarray:
    if name not in columns:
        raise InputError(f"{path}: has no column {name}; its columns are {', '.join(columns) or 'none'}")
    return columns[name]


def stated_heights_m(
    features: Features, schema: FootprintSchema, height_field: str | None, path: str | Path
) -> np.ndarray:
    """float64 (n,): the height above its ground that each footprint states; NaN if unknown.

    It is the first plausible value of: the column ``height_field``, the schema's heights, differences of roof and
    ground, and floors of 3 m. Text such as "12.5 m" or "40 ft" is understood. Raises :class:`InputError` if there is no
    column ``height_field``.
    """
    columns = with_others(features.columns, (*schema.heights_m, *schema.floors))
    values_of = {name: columns[column] for name, column in by_name(columns).items()}
    candidates = []
    if height_field is not None:
        values = _column(features.columns, height_field, path)
        candidates.append(_metres(values))
        stated = values[~is_missing(values)]
        if len(stated) and np.isnan(candidates[0]).all():
            log.warning(
                "warning: %s: no height is used of column %s, as none is a number: %r, for example",
                path,
                height_field,
                stated[0],
            )
    candidates += [_metres(values_of[name]) for name in schema.heights_m if name in values_of]
    candidates += [
        _metres(values_of[roof]) - _metres(values_of[ground])
        for roof, ground in schema.roof_and_ground
        if roof in values_of and ground in values_of
    ]
    candidates += [METRES_PER_FLOOR * _metres(values_of[name]) for name in schema.floors if name in values_of]
    result = np.full(len(features), np.nan)
    for height_m in candidates:
        is_plausible = np.isnan(result) & (height_m > 0) & (height_m <= _MAX_HEIGHT_M)
        result[is_plausible] = height_m[is_plausible]
    return result


def _metres(values: np.ndarray) -> np.ndarray:
    """float64: values in metres, of numbers, or of text with a number in metres (m or nothing) or feet (ft or ')."""
    if values.dtype.kind in "biuf":
        return values.astype(np.float64)
    found = [_LENGTH.fullmatch(str(each).strip().replace(",", ".")) for each in values.tolist()]
    return np.array(
        [
            np.nan if each is None else float(each[1]) * (_FOOT_M if each[2] in ("ft", "'") else 1.0)
            for each in found
        ]
    )
