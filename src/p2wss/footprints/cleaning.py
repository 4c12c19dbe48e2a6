"""Read footprints and clean them into polygons for the kernel. Excluded footprints keep a row, with a reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from p2wss import skeleton
from p2wss.config import Scenes
from p2wss.data import polygon_arrays, reasons
from p2wss.data.crs import MetricCrs, reprojected
from p2wss.data.tiling import Bounds, grown
from p2wss.footprints.coverage import block_numbers, clean_coverage, kernel_status
from p2wss.footprints.limits import repaired
from p2wss.footprints.overlaps import COLUMN, tell, without_overlaps
from p2wss.footprints.schemas import building_ids, by_name, schema_of, stated_heights_m, taken_part_numbers
from p2wss.footprints.vector_files import NO_POLYGONS, file_of, no_geometry, read_attributes, read_vector
from p2wss.storage.features import Features
from p2wss.storage.las_crs import horizontal, placed
from p2wss.storage.messages import InputError

if TYPE_CHECKING:
    import geopandas as gpd

_TYPES_WITH_POLYGONS = [
    shapely.GeometryType.POLYGON,
    shapely.GeometryType.MULTIPOLYGON,
    shapely.GeometryType.GEOMETRYCOLLECTION,
]
# footprints that touch themselves are cut apart with a gap of this width; cleaning would close a smaller one
_OPENING_M = 0.15
# columns that reading and cleaning add
ADDED_COLUMNS = ("building_id", "stated_height_m", "status", "centre_x_m", "centre_y_m")
# prefix that a column of the input gets for the time being if it has the name of one of these columns
OF_INPUT = "p2wss_input "
# column of sets: numbers that parts of a feature must not get, as their ids would be ids of other features of the file
_TAKEN = "p2wss_taken_part_numbers"


def read_footprints(
    path: str | Path | gpd.GeoDataFrame,
    id_field: str | None = None,
    bounds: Bounds | None = None,
    needs_crs: bool = True,
    schema: str = "auto",
    height_field: str | None = None,
    metric: MetricCrs | None = None,
    layer: str = "",
) -> Features:
    """The footprints of a vector file, in the order of the file, or of a table, with the columns ``building_id`` (text)
    and ``stated_height_m`` (NaN if unknown) added, and one that :func:`split_parts` removes again.

    An own column of the input with a name that reading or cleaning adds gets the prefix :data:`OF_INPUT`; an own column
    ``building_id`` with just these ids is dropped. id_field, schema: where the ids come from
    (:func:`p2wss.footprints.schemas.building_ids`); they do not depend on ``bounds``. height_field, schema: columns
    with the height of a building (:func:`~p2wss.footprints.schemas.stated_heights_m`). bounds: read only features that
    intersect this window, in the CRS of the file. needs_crs: whether a missing CRS is an error. metric: the CRS to
    which footprints are reprojected; footprints without a CRS are taken to be in the CRS of the clouds. layer: of the
    file; "" is the first with polygons.

    Raises :class:`InputError` if the file is missing or broken, if it has no polygons, no CRS, or without ``metric`` a
    CRS in degrees, or if ``id_field`` or ``height_field`` is missing.
    """
    if isinstance(path, str | Path):
        features, number = read_vector(path, bounds, layer)
    else:
        features, number, path = Features.of(path), np.arange(len(path)), file_of(path)
    types = shapely.get_type_id(features.geometry)
    if len(features) and not np.isin(types, _TYPES_WITH_POLYGONS).any():
        is_lost = shapely.is_missing(features.geometry).all()
        raise InputError(f"{path}: {no_geometry(path) if is_lost else NO_POLYGONS}")
    crs = placed(features.crs)
    if crs is None and needs_crs:
        raise InputError(f"{path}: has no CRS; set one with ogr2ogr -a_srs")
    if metric is None and crs is not None and crs.is_geographic:
        raise InputError(f"{path}: is in {crs.name}, in degrees; reproject it to a projected CRS in metres")
    columns = schema_of(features.columns, schema)
    of_ids: tuple[Mapping[str, np.ndarray], np.ndarray] = features.columns, number
    if bounds is not None:
        named = by_name(features.columns).items()
        names = {column: None for name, column in named if column == id_field or name in columns.ids}
        of_ids = read_attributes(path, tuple(names), layer) if names else of_ids
    all_ids = building_ids(*of_ids, columns, id_field, path)
    taken, by_number = taken_part_numbers(all_ids), dict(zip(of_ids[1].tolist(), all_ids, strict=True))
    ids = [by_number[each] for each in number.tolist()]
    height_m = stated_heights_m(features, columns, height_field, path)
    of_input = {
        f"{OF_INPUT}{name}" if name in (*ADDED_COLUMNS, COLUMN) else name: values
        for name, values in features.columns.items()
        if name != "building_id" or list(map(str, values.tolist())) != ids
    }
    features = replace(features, columns=of_input).having(
        building_id=np.array(ids, object),
        stated_height_m=height_m,
        **{_TAKEN: np.array([taken.get(name, set()) for name in ids], object)},
    )
    if metric is None:
        return features
    shapes = reprojected(features.geometry, crs or metric.source, metric.crs, path)
    return replace(features, geometry=shapes, crs=horizontal(metric.crs))


def read_whole_blocks(path: str | Path, bounds: Bounds, snap_m: float) -> Features:
    """The features that intersect a window, and all other features of their blocks
    (:func:`p2wss.footprints.coverage.block_numbers`), on which their cleaning depends. So :func:`clean_footprints`
    returns the same footprint for any window.

    Otherwise as :func:`read_footprints`.
    """
    # grow the window until no block of these features continues beyond it
    reach, window = grown(bounds, snap_m), grown(bounds, snap_m)
    while True:
        features = read_footprints(path, bounds=window)
        shapes, _ = repaired(features.geometry)
        block = block_numbers(shapes, snap_m)
        # a feature that cannot be repaired is empty now, but was read: it keeps a row, with its reason
        touches = shapely.intersects(shapes, shapely.box(*bounds)) | shapely.is_empty(shapes)
        is_member = np.isin(block, block[touches])
        if not is_member.any():
            return features.take(is_member)
        low_x, low_y, high_x, high_y = grown(shapely.total_bounds(shapes[is_member]).tolist(), snap_m)
        reach = (min(reach[0], low_x), min(reach[1], low_y), max(reach[2], high_x), max(reach[3], high_y))
        if reach == window:
            return features.take(is_member)
        window = reach


def split_parts(features: Features, min_area_m2: float, tolerance_m: float = 0.2) -> Features:
    """Split multipolygons into rows with one valid 2D polygon each, and add the columns ``status``, ``centre_x_m`` and
    ``centre_y_m``: the centre of the bounding box of the polygon, or of the geometry if there is no polygon.

    Geometries are repaired by :func:`p2wss.footprints.limits.repaired`, with ``tolerance_m``. If a geometry then has
    several polygons, the largest one is kept, and every other one of at least ``min_area_m2``. Their ids get the
    suffixes -1, -2, .. in order. A suffix is skipped if another feature in the file has the id, even outside
    the window that was read (:func:`read_footprints`). So no part has the id of another part or feature in any tile.
    A geometry without polygons keeps its row, with an empty polygon and the reason as ``status``.
    """
    shapes = features.geometry
    is_empty = shapely.is_missing(shapes) | shapely.is_empty(shapes)
    centre = _box_centres(shapes)
    shapes, status = repaired(shapes, tolerance_m)
    is_areal = np.isin(
        shapely.get_type_id(shapes), [shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON]
    )
    status[(status == reasons.OK) & ~is_areal] = reasons.NOT_A_POLYGON
    status[is_empty | (status == reasons.OK) & shapely.is_empty(shapes)] = reasons.EMPTY
    # a row without a polygon has one part, an empty polygon
    shapes[~is_areal | shapely.is_empty(shapes)] = shapely.Polygon()
    parts, row = shapely.get_parts(shapes, return_index=True)
    area = shapely.area(parts)
    largest = np.zeros(len(features))
    np.maximum.at(largest, row, area)
    keep = (area >= min_area_m2) | (area >= largest[row])
    parts, row = parts[keep], row[keep]
    is_split = np.bincount(row, minlength=len(features))[row] > 1
    names = features["building_id"].tolist()
    is_known = _TAKEN in features.columns
    taken = dict(zip(names, features[_TAKEN], strict=True)) if is_known else taken_part_numbers(names)
    ids = features["building_id"][row]
    suffix = dict.fromkeys(row[is_split], 0)
    for index in np.flatnonzero(is_split):
        name, feature = ids[index], row[index]
        suffix[feature] += 1
        while suffix[feature] in taken.get(name, ()):
            suffix[feature] += 1
        ids[index] = f"{name}-{suffix[feature]}"
    part_centre = _box_centres(parts)
    centre_x_m, centre_y_m = np.where(np.isfinite(part_centre), part_centre, centre[row]).T
    columns = {name: values[row] for name, values in features.columns.items() if name != _TAKEN}
    result = Features(parts, columns, features.crs)
    return result.having(building_id=ids, status=status[row], centre_x_m=centre_x_m, centre_y_m=centre_y_m)


def _box_centres(shapes: np.ndarray) -> np.ndarray:
    """The centre of the bounding box of each geometry, (n, 2); NaN for an empty one."""
    bounds = shapely.bounds(shapes)
    return (bounds[:, :2] + bounds[:, 2:]) / 2


def clean_footprints(features: Features, config: Scenes) -> Features:
    """Polygons for the kernel: exterior counter-clockwise, courtyards clockwise, without superfluous vertices.

    After :func:`split_parts`, overlaps are removed, so that each place belongs to one footprint
    (:func:`p2wss.footprints.overlaps.without_overlaps`). Then footprints that touch, overlap or are at most ``snap_m``
    apart are cleaned as one coverage (:func:`p2wss.footprints.coverage.clean_coverage`), so they keep their shared
    walls. A footprint that cannot be part of a coverage, for instance because it touches itself, is cut apart there and
    cleaned by itself. Every footprint keeps a row: ``status`` is "ok" or the reason for exclusion, and an excluded
    footprint has an empty polygon.

    The result of a footprint depends only on the footprints of its block, and not on the order of the rows.
    """
    features = split_parts(features, config.min_area_m2, config.simplify_m)
    is_small = (features["status"] == reasons.OK) & (shapely.area(features.geometry) < config.min_area_m2)
    features = _excluding(features, is_small, reasons.TOO_SMALL)
    while True:
        alone, is_covering = without_overlaps(features)
        result = _cleaned(alone, config)
        # a footprint that takes the place of others must be built; if it is not, the others are
        is_lost = is_covering & (alone["status"] == reasons.OK) & (result["status"] != reasons.OK)
        if not is_lost.any():
            tell(result)
            return result
        features = _excluding(features, is_lost, result["status"])


def _excluding(features: Features, is_excluded: np.ndarray, reason: str | np.ndarray) -> Features:
    """The footprints, in which ``is_excluded`` ones get the ``reason`` as status, and an empty polygon."""
    status, shapes = np.where(is_excluded, reason, features["status"]), features.geometry.copy()
    shapes[is_excluded] = shapely.Polygon()
    return replace(features.having(status=status), geometry=shapes)


def _cleaned(result: Features, config: Scenes) -> Features:
    """The footprints, cleaned as coverages, or alone if a footprint cannot be part of one."""
    status, shapes = result["status"].copy(), result.geometry.copy()
    usable = np.flatnonzero(status == reasons.OK)
    shapes[usable] = [_without_small_courtyards(shape, config.min_area_m2) for shape in shapes[usable]]
    cleaned = clean_coverage(shapes[usable], config)
    for i in np.flatnonzero(shapely.is_missing(cleaned)):
        cleaned[i], status[usable[i]] = _clean_alone(shapes[usable[i]], config)
    shapes[usable] = cleaned
    return _without_excluded(result, shapes, status, config)


def uncleaned_footprints(features: Features, config: Scenes) -> Features:
    """The footprints for a block at which :func:`clean_footprints` fails: the polygons of :func:`split_parts`, only
    oriented and with a status in the same way."""
    result = split_parts(features, config.min_area_m2, config.simplify_m)
    shapes = shapely.orient_polygons(result.geometry)
    return _without_excluded(result, shapes, result["status"].copy(), config)


def _without_excluded(features: Features, shapes: np.ndarray, status: np.ndarray, config: Scenes) -> Features:
    """The features with these polygons and this status. Polygons that are too small or have too many edges are
    excluded: they get the reason as status, and become empty."""
    status[(status == reasons.OK) & (shapely.area(shapes) < config.min_area_m2)] = reasons.TOO_SMALL
    num_edges = shapely.get_num_coordinates(shapes) - shapely.get_num_interior_rings(shapes) - 1
    status[(status == reasons.OK) & (num_edges > config.max_edges)] = skeleton.Status.TOO_MANY_EDGES.reason
    shapes[status != reasons.OK] = shapely.Polygon()
    return replace(features.having(status=status), geometry=shapes)


def _clean_alone(shape: shapely.Polygon, config: Scenes) -> tuple[shapely.Polygon, str]:
    """(the cleaned largest piece of a footprint that cannot be cleaned as a whole, "ok"); or an empty polygon and the
    reason, if the piece cannot be cleaned either."""
    piece = _cut_apart(shape)
    if piece is None:
        return shapely.Polygon(), reasons.TOO_SMALL
    (cleaned,) = clean_coverage(np.array([piece]), config)
    if cleaned is not None:
        return cleaned, reasons.OK
    (code,) = kernel_status(polygon_arrays.to_polygons([shapely.orient_polygons(piece)]))
    return shapely.Polygon(), skeleton.Status(code or skeleton.Status.NOT_SIMPLE).reason


def _without_small_courtyards(shape: shapely.Polygon, min_area_m2: float) -> shapely.Polygon:
    courtyards = [ring for ring in shape.interiors if shapely.Polygon(ring).area >= min_area_m2]
    return shapely.Polygon(shape.exterior, courtyards)


def _cut_apart(shape: shapely.Polygon) -> shapely.Polygon | None:
    """The largest piece of a polygon cut where rings touch and where it is narrow; None if none is left."""
    rings = shapely.get_rings(shape)
    contacts = [first.intersection(second) for first, second in combinations(rings, 2)]
    cut = shape.difference(shapely.union_all(contacts).buffer(2 * _OPENING_M, cap_style="square"))
    eroded = cut.buffer(-_OPENING_M, join_style="mitre")
    pieces = shapely.get_parts(eroded.buffer(_OPENING_M, join_style="mitre"))
    return max(pieces, key=shapely.area) if shapely.area(pieces).any() else None
