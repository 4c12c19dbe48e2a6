"""Repair of geometries within limits: a geometry is repaired in seconds, or excluded with a reason.

A ring with many vertices is simplified before any step whose cost grows with the square of their number. All other
rings stay unchanged.
"""

from typing import Any

import numpy as np
import shapely

from p2wss.data import reasons
from p2wss.data.points import stride

# no building is longer; the largest has 1.7 km
MAX_EXTENT_M = 5000.0
# beyond this, float64 cannot resolve micrometres
_FARTHEST_M = 1e9
# rings with more vertices are simplified
_MANY_VERTICES = 2000
# Douglas-Peucker takes seconds for a ring with this many vertices if it cannot remove any
_MAX_THINNED = 30_000
# the kernel takes at most this many edges
_MAX_VERTICES = 4096
# make_valid takes about 0.1 ms for each crossing
_MAX_CROSSINGS = 10_000
_NUM_SAMPLED_EDGES = 64
# this many edges, or fewer, cannot have more crossings than that
_FEW_EDGES = 140
_SMALLEST_TOLERANCE_M = 0.01


def repaired(shapes: np.ndarray, tolerance_m: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """(valid 2D geometries, "ok" or a reason for each); a geometry with a reason becomes an empty polygon.

    Invalid geometries are repaired by shapely's ``make_valid`` (method "structure"). tolerance_m: a ring of more than
    2000 vertices is simplified by at most this much. A collection is reduced to its polygons, if it has any; other
    geometries that are not polygons stay unchanged.
    """
    shapes = shapely.force_2d(shapes)
    for i in np.flatnonzero(shapely.get_type_id(shapes) == shapely.GeometryType.GEOMETRYCOLLECTION):
        shapes[i] = _polygons_of(shapes[i])
    reason = np.full(len(shapes), reasons.OK, dtype=object)
    xy, row = shapely.get_coordinates(shapes, return_index=True)
    reason[np.unique(row[~(np.abs(xy) < _FARTHEST_M).all(axis=1)])] = reasons.NON_FINITE
    bounds = shapely.bounds(shapes)
    is_large = (bounds[:, 2:] - bounds[:, :2] > MAX_EXTENT_M).any(axis=1)
    reason[(reason == reasons.OK) & is_large] = reasons.IMPLAUSIBLE_SIZE
    is_areal = np.isin(shapely.get_type_id(shapes), (3, 6))
    num_vertices = np.bincount(row, minlength=len(shapes))
    for i in np.flatnonzero((reason == reasons.OK) & is_areal & (num_vertices > _MANY_VERTICES)):
        thinned = _thinned(shapes[i], max(tolerance_m, _SMALLEST_TOLERANCE_M))
        if thinned is None:
            reason[i] = reasons.TOO_MANY_EDGES
        else:
            shapes[i] = thinned
    shapes[reason != reasons.OK] = shapely.Polygon()
    for i in np.flatnonzero(~shapely.is_missing(shapes) & ~shapely.is_valid(shapes)):
        if _num_crossings(shapes[i]) > _MAX_CROSSINGS:
            shapes[i], reason[i] = shapely.Polygon(), reasons.TOO_MANY_CROSSINGS
        else:
            shapes[i] = shapely.make_valid(shapes[i], method="structure", keep_collapsed=False)
    return shapes, reason


def _polygons_of(collection: Any) -> Any:
    """The polygons of a collection and of collections in it; the collection itself if it has no polygons."""
    parts = [
        _polygons_of(part) if part.geom_type == "GeometryCollection" else part for part in collection.geoms
    ]
    areal = shapely.get_parts([part for part in parts if part.geom_type in ("Polygon", "MultiPolygon")])
    return shapely.MultiPolygon(list(areal)) if len(areal) else collection


def _thinned(shape: Any, tolerance_m: float) -> Any:
    """The polygons with simplified rings; rings of few vertices stay. None if a ring keeps too many vertices."""
    if isinstance(shape, shapely.MultiPolygon):
        parts = [_thinned(part, tolerance_m) for part in shape.geoms]
        return None if any(part is None for part in parts) else shapely.MultiPolygon(parts)
    rings = [_thinned_ring(shapely.get_coordinates(ring), tolerance_m) for ring in shapely.get_rings(shape)]
    if any(len(ring) > _MAX_VERTICES for ring in rings):
        return None
    return shapely.Polygon(rings[0], rings[1:]) if rings else shape


def _thinned_ring(xy: np.ndarray, tolerance_m: float) -> np.ndarray:
    if len(xy) <= _MANY_VERTICES:
        return xy
    # one vertex per half the tolerance along the ring, in linear time, then Douglas-Peucker
    along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    _, first = np.unique(np.floor(along_m / (tolerance_m / 2)), return_index=True)
    thinned = xy[np.union1d(first, len(xy) - 1)]
    if len(thinned) > _MAX_THINNED:
        return xy
    half = len(thinned) // 2
    # a ring shorter than the tolerance has only two vertices now
    rest = thinned[min(half, len(thinned) - 2) :]
    halves = np.array([shapely.LineString(thinned[: half + 1]), shapely.LineString(rest)])
    first_half, second_half = shapely.simplify(halves, tolerance_m / 2, preserve_topology=False)
    return np.concatenate([shapely.get_coordinates(first_half), shapely.get_coordinates(second_half)[1:]])


def _num_crossings(shape: shapely.Geometry) -> float:
    """About how often the edges of a geometry cross: exact for few edges, else from a sample of them."""
    rings = [shapely.get_coordinates(ring) for ring in shapely.get_rings(shapely.get_parts(shape))]
    if sum(map(len, rings)) <= _FEW_EDGES:
        return 0.0
    start, end = np.concatenate([r[:-1] for r in rings]), np.concatenate([r[1:] for r in rings])
    edges = np.asarray(shapely.linestrings(np.stack([start, end], axis=1)))
    sample = edges[:: stride(len(edges), _NUM_SAMPLED_EDGES)]
    edge, _ = shapely.STRtree(edges).query(sample, predicate="crosses")
    return len(edge) / len(sample) * len(edges) / 2
