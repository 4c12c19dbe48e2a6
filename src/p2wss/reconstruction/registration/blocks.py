"""Blocks of the registration: groups of touching footprints that move together, and the free edges of a block."""

from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.data import polygon_arrays
from p2wss.skeleton.groups import groups
from p2wss.skeleton.types import Polygons

# footprints closer than this touch, unless they overlap deeper than this: then one of them lies wrong
WALL_GAP_M = 0.01
# the outline of a block has at least this share of the area of its footprints
_KEPT_SHARE = 0.97
# corners of outlines that change less than this are dropped
_SIMPLIFY_M = 0.1
# an edge is cut into equal pieces, as many as possible with at least this length
_PIECE_M = 20.0


@dataclass(frozen=True)
class Blocks:
    """The n blocks of a run.

    of_footprint: int64 (footprints,), the block of each footprint, -1 for an empty one. outline: the polygons of all
    blocks, without party walls, counter-clockwise. of_outline: int64, the block of each outline. edge: (e, 4), the ends
    of all edges, long ones in pieces, the outside on their right. of_edge: int64 (e,), the block of each edge.
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
    """The blocks of polygons (object array), numbered in the order of their first footprints."""
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

    Two polygons are in one block if they touch, at least in a corner: they are nearer than ``WALL_GAP_M``, and overlap
    by less than 1 cm. As a block moves as a whole, its polygons move neither into nor away from each other.
    """
    wide = shapely.buffer(shapes, WALL_GAP_M / 2, join_style="mitre", mitre_limit=2.0)
    first, second = shapely.STRtree(wide).query(wide, predicate="intersects")
    first, second = first[first < second], second[first < second]
    contact = shapely.intersection(wide[first], wide[second])
    length = shapely.length(contact) / 2
    width = shapely.area(contact) / np.maximum(length, 1e-9)
    touches = width <= 2 * WALL_GAP_M
    return groups(len(shapes), np.column_stack([first[touches], second[touches]]))


def _outline(shapes: np.ndarray) -> np.ndarray:
    """The polygons around a block."""
    if len(shapes) > 1:
        closed = shapely.union_all(
            shapely.buffer(shapes, 1.2 * WALL_GAP_M, join_style="mitre", mitre_limit=2.0)
        )
        inner = shapely.buffer(closed, -1.2 * WALL_GAP_M, join_style="mitre", mitre_limit=2.0)
        # for one in a few hundred shapes with short edges, the buffer of GEOS is only a part of the shape, or empty
        shape = inner if inner.area > _KEPT_SHARE * shapely.area(shapes).sum() else closed
    else:
        shape = shapes[0]
    parts = shapely.get_parts(shapely.simplify(shape, _SIMPLIFY_M))
    return np.asarray(shapely.orient_polygons(parts[~shapely.is_empty(parts)]))


def _pieces(polygons: Polygons) -> tuple[np.ndarray, np.ndarray]:
    """(the ends of all edges, long ones in pieces, float64 (e, 4); the polygon of each edge, int64 (e,))."""
    of_edge = np.repeat(np.arange(len(polygons)), np.diff(polygons.vertex_offset))
    edge = np.column_stack([polygons.xy_m, polygons.xy_m[polygons.next_vertex]])
    length = np.hypot(edge[:, 2] - edge[:, 0], edge[:, 3] - edge[:, 1])
    count = np.maximum(length // _PIECE_M, 1).astype(np.int64)
    row = np.repeat(np.arange(len(edge)), count)
    part = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    start, along = edge[row, :2], edge[row, 2:] - edge[row, :2]
    first, last = (part / count[row])[:, None], ((part + 1) / count[row])[:, None]
    return np.column_stack([start + first * along, start + last * along]), of_edge[row]
