"""Convert footprints between shapely geometries, the kernel's ragged arrays and columns of tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import shapely

from p2wss.skeleton.types import Polygons
from p2wss.storage import files

if TYPE_CHECKING:
    import pyarrow as pa


def to_polygons(geometries: Sequence[shapely.Polygon] | np.ndarray) -> Polygons:
    """The kernel's arrays from shapely polygons, in the same order, without the closing vertices of rings.

    An empty or missing geometry becomes a polygon without rings. Raises ``ValueError`` for other geometries,
    multipolygons included.
    """
    shapes = np.array(geometries, dtype=object)
    shapes[shapely.is_missing(shapes) | shapely.is_empty(shapes)] = shapely.Polygon()
    if not len(shapes):
        return Polygons.from_rings([])
    if np.any(shapely.get_type_id(shapes) != shapely.GeometryType.POLYGON):
        raise ValueError("all geometries must be polygons; split multipolygons first")
    _, xy, (ring_offset, polygon_offset) = shapely.to_ragged_array(shapes, include_z=False)
    num_rings = len(ring_offset) - 1
    return Polygons(
        xy_m=np.delete(xy, ring_offset[1:] - 1, axis=0),
        ring_offset=ring_offset.astype(np.int64) - np.arange(num_rings + 1),
        polygon_offset=polygon_offset.astype(np.int64),
    )


def to_geometries(polygons: Polygons) -> np.ndarray:
    """Shapely polygons, object array (num_polygons,); a polygon without rings becomes an empty geometry."""
    start, end = polygons.ring_offset[:-1], polygons.ring_offset[1:]
    # each ring ends with its first vertex again
    closed = np.insert(np.arange(len(polygons.xy_m)), end, start)
    ring_offset = polygons.ring_offset + np.arange(len(polygons.ring_offset))
    return np.asarray(
        shapely.from_ragged_array(
            shapely.GeometryType.POLYGON, polygons.xy_m[closed], (ring_offset, polygons.polygon_offset)
        )
    )


def take(polygons: Polygons, indices: np.ndarray) -> Polygons:
    """The polygons at ``indices`` (int array or boolean mask), in that order."""
    return Polygons.from_rings([polygons.rings(p) for p in np.arange(len(polygons))[indices].tolist()])


def moved(polygons: Polygons, by_xy_m: np.ndarray) -> Polygons:
    """Each polygon moved by a vector of its own: by_xy_m float64 (num_polygons, 2)."""
    of_vertex = np.repeat(by_xy_m, np.diff(polygons.vertex_offset), axis=0)
    return replace(polygons, xy_m=polygons.xy_m + of_vertex)


def origins(polygons: Polygons) -> np.ndarray:
    """A local origin per polygon: the centre of its bounding box, rounded to 1 m. float64 (num_polygons, 2).

    (0, 0) for a polygon without rings.
    """
    bounds = shapely.bounds(to_geometries(polygons))
    return np.nan_to_num(np.round((bounds[:, :2] + bounds[:, 2:]) / 2))


def to_columns(polygons: Polygons, origin_xy_m: np.ndarray) -> dict[str, pa.Array]:
    """The columns ``footprint_xy_m`` and ``ring_offset`` of a table (:mod:`p2wss.storage.schemas.columns`).

    origin_xy_m: float64 (num_polygons, 2), the origin of the local coordinates of each row.
    """
    vertex_offset = polygons.vertex_offset
    local = moved(polygons, -origin_xy_m).xy_m
    num_rings = np.diff(polygons.polygon_offset)
    # the offsets of each row start from 0, and are one more than its rings
    first = np.repeat(polygons.ring_offset[polygons.polygon_offset[:-1]], num_rings + 1)
    row_offset = np.concatenate([[0], np.cumsum(num_rings + 1)])
    position = np.arange(row_offset[-1]) - np.repeat(np.arange(len(polygons)), num_rings + 1)
    return {
        "footprint_xy_m": files.ragged(local.ravel(), 2 * vertex_offset),
        "ring_offset": files.ragged((polygons.ring_offset[position] - first).astype(np.int32), row_offset),
    }


def from_columns(table: pa.Table) -> Polygons:
    """The polygons of a table, in the local coordinates of each row: the inverse of :func:`to_columns`."""
    xy, vertex_offset = files.list_column(table, "footprint_xy_m")
    ring, row_offset = files.list_column(table, "ring_offset")
    num_rings = np.maximum(np.diff(row_offset) - 1, 0)
    lengths = [np.diff(ring[a:b]) for a, b in pairwise(row_offset)]
    sizes = np.concatenate(lengths) if lengths else np.zeros(0, np.int64)
    polygons = Polygons(
        xy_m=xy.reshape(-1, 2),
        ring_offset=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        polygon_offset=np.concatenate([[0], np.cumsum(num_rings)]).astype(np.int64),
    )
    assert np.array_equal(2 * polygons.vertex_offset, vertex_offset)
    return polygons


def in_crs(table: pa.Table, zero_xy_m: Sequence[float] | np.ndarray = (0.0, 0.0)) -> Polygons:
    """The polygons of a table in its CRS, relative to ``zero_xy_m``; the inverse of :func:`to_columns`, too."""
    origin_xy_m = np.column_stack([table["origin_x_m"].to_numpy(), table["origin_y_m"].to_numpy()])
    return moved(from_columns(table), origin_xy_m - zero_xy_m)
