"""Lines of roofs on a map, such as ridges and valleys: they are read, and cut to the footprints in which they lie."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from p2wss.data.crs import MetricCrs, reprojected
from p2wss.footprints.vector_files import read_vector
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError, log

if TYPE_CHECKING:
    import geopandas as gpd

# column of features: the lines of each footprint, float64 (l, 2, 2)
LINES = "p2wss_lines"
# metres: a vertex nearer than this to the straight line does not divide it into pieces
_STRAIGHT_M = 0.05


def read_lines(lines: Path | gpd.GeoDataFrame, metric: MetricCrs) -> np.ndarray:
    """float64 (l, 2, 2): the ends of the straight pieces of the lines of a file or a table, in the CRS of a run and
    without heights.

    Raises :class:`InputError` if the file is missing or broken, or has no lines.
    """
    name = str(lines) if isinstance(lines, Path) else "lines"
    features = read_vector(lines, of="lines")[0] if isinstance(lines, Path) else Features.of(lines)
    # twice, as parts of collections may have parts
    parts = shapely.get_parts(shapely.get_parts(shapely.force_2d(features.geometry)))
    parts = parts[shapely.get_type_id(parts) == shapely.GeometryType.LINESTRING]
    if not len(parts):
        raise InputError(f"{name}: has no lines; lines of roofs must be LineStrings")
    parts = reprojected(parts, features.crs or metric.source, metric.crs, name)
    xy_m, line = shapely.get_coordinates(shapely.simplify(parts, _STRAIGHT_M), return_index=True)
    is_piece = (line[1:] == line[:-1]) & np.isfinite(xy_m[1:] + xy_m[:-1]).all(axis=1)
    return np.stack([xy_m[:-1], xy_m[1:]], axis=1)[is_piece]


def with_lines(
    features: Features, end_m: np.ndarray, inside_m: float = 0.2, least_m: float = 0.5
) -> Features:
    """The footprints with the column :data:`LINES`: the pieces of lines that lie in each footprint, at least
    ``inside_m`` from its edges, and at least ``least_m`` long. end_m: float64 (l, 2, 2), the ends of the lines."""
    lines, inner = np.asarray(shapely.linestrings(end_m)), shapely.buffer(features.geometry, -inside_m)
    row, line = shapely.STRtree(lines).query(inner, predicate="intersects")
    order = np.lexsort((line, row))
    row, line = row[order], line[order]
    pieces, of_pair = shapely.get_parts(shapely.intersection(lines[line], inner[row]), return_index=True)
    is_long = shapely.length(pieces) >= least_m
    pieces, row = pieces[is_long], row[of_pair[is_long]]
    ends = [shapely.get_coordinates(shapely.get_point(pieces, number)) for number in (0, -1)]
    first = np.searchsorted(row, np.arange(len(features) + 1))
    column = np.empty(len(features), object)
    column[:] = np.split(np.stack(ends, axis=1), first[1:-1]) if len(features) else []
    log.info(
        "%d straight pieces of lines in %d of %d footprints", len(row), len(np.unique(row)), len(features)
    )
    return features.having(**{LINES: column})
