"""Blocks of the registration: footprints that touch and move together, and the edges of a block that are free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.data import polygon_arrays
from p2wss.skeleton.groups import groups
from p2wss.skeleton.types import Polygons

# footprints closer than this touch
WALL_GAP_M = 0.01
# footprints that overlap deeper than this are no neighbours but two that lie wrong
_MAX_OVERLAP_M = 0.01
# of the area of its footprints, a block has at least so much
_KEPT_SHARE = 0.97
# corners of outlines that change nothing
_SIMPLIFY_M = 0.1
# an edge becomes as many pieces of equal length as are at least so long
_PIECE_M = 20.0


@dataclass(frozen=True)
class Blocks:
    """The n blocks of a run.

    of_footprint: int64 (footprints,), the block of each footprint, -1 for an empty one. outline: the polygons of all
    blocks, without party walls, counter-clockwise. of_outline: the block of each, int64. edge: (e, 4), the ends of all
    edges, long ones in pieces, the outside on their right. of_edge: the block of each edge, int64 (e,).
    """

    count: int
    of_footprint: np.ndarray
    outline: Polygons
    of_outline: np.ndarray
    edge: np.ndarray
    of_edge: np.ndarray

    def __len__(self) -> int:
        return self.count


def find_blocks(footprints: np.ndarray) -> Blocks:
    """The blocks of polygons (object array); a block has the number of its first footprint among those of blocks."""
    present = np.flatnonzero(~shapely.is_empty(footprints))
    shapes = footprints[present]
    of_present = connected(shapes)
    count = int(of_present.max()) + 1 if len(present) else 0
    of_footprint = np.full(len(footprints), -1, np.int64)
    of_footprint[present] = of_present
    order = np.argsort(of_present, kind="stable")
    members = (
        np.split(shapes[order], np.cumsum(np.bincount(of_present, minlength=count))[:-1]) if count else []
    )
    outlines = [_outline(group) for group in members]
    of_outline = np.repeat(np.arange(count), [len(parts) for parts in outlines])
    polygons = polygon_arrays.to_polygons(np.concatenate([*outlines, np.zeros(0, object)]))
    edge, of_polygon = _pieces(polygons)
    of_edge = of_outline[of_polygon] if count else of_polygon
    return Blocks(count, of_footprint, polygons, of_outline, edge, of_edge)


def connected(shapes: np.ndarray) -> np.ndarray:
    """The block of each polygon, int64, numbered in the order of their first polygons.

    Two polygons are of one block if they touch, in a corner at least: are nearer than ``WALL_GAP_M`` and overlap by
    less than 1 cm. So no shift moves one into the other, or away from it.
    """
    wide = shapely.buffer(shapes, WALL_GAP_M / 2, join_style="mitre", mitre_limit=2.0)
    first, second = shapely.STRtree(wide).query(wide, predicate="intersects")
    first, second = first[first < second], second[first < second]
    contact = shapely.intersection(wide[first], wide[second])
    length = shapely.length(contact) / 2
    width = shapely.area(contact) / np.maximum(length, 1e-9)
    touches = width <= WALL_GAP_M + _MAX_OVERLAP_M
    return groups(len(shapes), np.column_stack([first[touches], second[touches]]))


def _outline(shapes: np.ndarray) -> np.ndarray:
    """The polygons around a block."""
    if len(shapes) > 1:
        closed = shapely.union_all(
            shapely.buffer(shapes, 1.2 * WALL_GAP_M, join_style="mitre", mitre_limit=2.0)
        )
        inner = shapely.buffer(closed, -1.2 * WALL_GAP_M, join_style="mitre", mitre_limit=2.0)
        # of one in a few hundred shapes with short edges, GEOS leaves a part or nothing
        shape = inner if inner.area > _KEPT_SHARE * shapely.area(shapes).sum() else closed
    else:
        shape = shapes[0]
    parts = shapely.get_parts(shapely.simplify(shape, _SIMPLIFY_M))
    return np.asarray(shapely.orient_polygons(parts[~shapely.is_empty(parts)]))


def _pieces(polygons: Polygons) -> tuple[np.ndarray, np.ndarray]:
    """The ends of all edges, long ones in pieces, (e, 4), and the polygon of each, int64 (e,)."""
    of_edge = np.repeat(np.arange(len(polygons)), np.diff(polygons.vertex_offset))
    edge = np.column_stack([polygons.xy_m, polygons.xy_m[polygons.next_vertex]])
    length = np.hypot(edge[:, 2] - edge[:, 0], edge[:, 3] - edge[:, 1])
    count = np.maximum(length // _PIECE_M, 1).astype(np.int64)
    row = np.repeat(np.arange(len(edge)), count)
    part = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    start, along = edge[row, :2], edge[row, 2:] - edge[row, :2]
    first, last = (part / count[row])[:, None], ((part + 1) / count[row])[:, None]
    return np.column_stack([start + first * along, start + last * along]), of_edge[row]
