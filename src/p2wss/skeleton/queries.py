"""Which face of the roof lies over a point, and at what height: the queries behind the fit.

With the face of every point held fixed, the height is linear in the eave height and in the tangents of the
angles: z = eave + tan(angle of the edge) * distance to the edge's line. That is what :func:`_assign` returns.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from p2wss.skeleton.angles import tangents
from p2wss.skeleton.batch import make_batch, work_size
from p2wss.skeleton.compiled import ZERO, embedded, entry, inner
from p2wss.skeleton.kinetic import skeleton_work
from p2wss.skeleton.mesh import solid_skeleton
from p2wss.skeleton.records import NUM_ARCS, NUM_CAPS, Batch, SkeletonWork
from p2wss.skeleton.status import OK
from p2wss.skeleton.types import FloatArray, IntArray, Polygons

# Values of `face` below 0
OUTSIDE = -1  # no roof over the point
FLAT = -2  # swept by 0 degree edges, at the height of the eave
CAP = -3  # a cap where the last slope ended: `distance` is its height above the eave
CUT = -4  # the cut at the maximum roof height: `distance` is that height

# A piece of a face boundary in plan, from left to right, with the faces above and below it (number of faces
# for the outside). Pieces parallel to the y axis are omitted: the line through a point along y cannot cross
# them.
SEGMENT = np.dtype(
    [
        ("left_x", "f8"),
        ("right_x", "f8"),
        ("left_y", "f8"),
        ("slope", "f8"),
        ("above", "i8"),
        ("below", "i8"),
    ],
    align=True,
)


# the number of points that are compared with all segments at a time
_BLOCK = 64


class QueryWork(NamedTuple):
    """Work arrays of :func:`_assign` for one thread.

    winding: int64 (faces + 1, block), how often the boundary of each face, and of the outside, winds round each point
    of a block. value: what :func:`_assign` writes to ``face`` for a point on each face. height: what it writes to
    ``distance`` if that value is below 0. beside: a place beside a point.
    """

    segment: np.ndarray
    winding: np.ndarray
    value: np.ndarray
    height: np.ndarray
    beside: np.ndarray


class QueryPoints(NamedTuple):
    """Points to look for the roof over, float64 (num_points,), relative to the first vertex of the polygon; and what
    :func:`_assign` writes for each: int64 face, float64 distance."""

    x: np.ndarray
    y: np.ndarray
    face: np.ndarray
    distance: np.ndarray


def query_work(max_edges: int) -> QueryWork:
    """Work arrays for polygons of up to ``max_edges`` edges over all their rings."""
    skeleton = skeleton_work(max_edges)
    num_faces = max_edges + skeleton.cap_height.size
    return QueryWork(
        np.zeros(skeleton.arc.size + max_edges, SEGMENT),
        np.zeros((num_faces + 1, _BLOCK), np.int64),
        np.zeros(num_faces, np.int64),
        np.zeros(num_faces),
        np.zeros(2),
    )


@embedded
def _put_segment(
    segment: np.ndarray,
    k: int,
    a: tuple[float, float],
    b: tuple[float, float],
    left_face: int,
    right_face: int,
) -> int:
    """Store the piece from a to b (x, y) with the faces on its left and right. Returns the number of segments."""
    (a_x, a_y), (b_x, b_y) = a, b
    if a_x == b_x:
        return k
    if a_x > b_x:
        a_x, a_y, b_x, b_y, left_face, right_face = b_x, b_y, a_x, a_y, right_face, left_face
    segment[k].left_x, segment[k].left_y, segment[k].right_x = a_x, a_y, b_x
    segment[k].above, segment[k].below = left_face, right_face
    segment[k].slope = (b_y - a_y) / (b_x - a_x)
    return k + 1


@embedded
def _fill_segments(
    edge: np.ndarray,
    num_edges: int,
    node: np.ndarray,
    arc: np.ndarray,
    counts: np.ndarray,
    segment: np.ndarray,
) -> int:
    outside = num_edges + counts[NUM_CAPS]
    k = ZERO
    for i in range(num_edges):
        after = edge[i].next
        a, b = (edge[i].x, edge[i].y), (edge[after].x, edge[after].y)
        k = _put_segment(segment, k, a, b, i, outside)
    for m in range(counts[NUM_ARCS]):
        start, end = arc[m].start, arc[m].end
        a, b = (node[start].x, node[start].y), (node[end].x, node[end].y)
        k = _put_segment(segment, k, a, b, arc[m].left, arc[m].right)
    return k


@embedded
def _fill_values(
    edge: np.ndarray, num_edges: int, max_roof_height_m: float, skeleton: SkeletonWork, query: QueryWork
) -> None:
    """Writes to ``query`` the value and the height of each face (:class:`QueryWork`)."""
    for f in range(num_edges):
        angle = edge[f].angle_deg
        query.value[f] = FLAT if angle == 0.0 else OUTSIDE if angle == 90.0 else f
        query.height[f] = 0.0
    for c in range(skeleton.counts[NUM_CAPS]):
        height = skeleton.cap_height[c]
        value = FLAT if height <= 1e-5 else CUT if height >= max_roof_height_m else CAP
        query.value[num_edges + c], query.height[num_edges + c] = value, height if height > 1e-5 else 0.0


@embedded
def _wind(
    segment: np.ndarray, num_segments: int, num_faces: int, winding: np.ndarray, x: np.ndarray, y: np.ndarray
) -> None:
    """Writes to ``winding`` how often the boundary of each face winds round each of the points, at most a block."""
    num = len(x)
    winding[: num_faces + 1, :num] = 0
    for s in range(num_segments):
        left_x, right_x = segment[s].left_x, segment[s].right_x
        left_y, slope = segment[s].left_y, segment[s].slope
        above, below = winding[segment[s].above], winding[segment[s].below]
        # without branches, so that several points are compared at once
        for k in range(num):
            crosses = (left_x <= x[k]) & (x[k] < right_x) & (left_y + (x[k] - left_x) * slope <= y[k])
            above[k] += crosses
            below[k] -= crosses


@embedded
def _fill_faces(
    edge: np.ndarray, num_edges: int, num_faces: int, query: QueryWork, points: QueryPoints
) -> None:
    """Writes the face and the distance of each point, at most a block. The face is the one that is not vertical and
    whose boundary winds round the point. There is at most one, even where boundaries coincide."""
    x, y, face, distance = points
    num = len(x)
    for k in range(num):
        face[k], distance[k] = OUTSIDE, 0.0
    for f in range(num_faces - 1, -1, -1):
        if f < num_edges and edge[f].angle_deg == 90.0:
            continue
        row, value, height = query.winding[f], query.value[f], query.height[f]
        if value < 0:
            for k in range(num):
                face[k] = value if row[k] > 0 else face[k]
                distance[k] = height if row[k] > 0 else distance[k]
        else:
            start_x, start_y, dir_x, dir_y = edge[f].x, edge[f].y, edge[f].dir_x, edge[f].dir_y
            for k in range(num):
                face[k] = f if row[k] > 0 else face[k]
                from_edge = (y[k] - start_y) * dir_x - (x[k] - start_x) * dir_y
                distance[k] = from_edge if row[k] > 0 else distance[k]


@embedded
def _vertical_face(edge: np.ndarray, num_edges: int, winding: np.ndarray, k: int) -> int:
    """The last vertical face whose boundary winds round point k of a block; -1 for none."""
    for f in range(num_edges - 1, -1, -1):
        if winding[f, k] > 0 and edge[f].angle_deg == 90.0:
            return f
    return -1


@inner
def _assign(
    num_edges: int, max_roof_height_m: float, skeleton: SkeletonWork, query: QueryWork, points: QueryPoints
) -> None:
    """Find the face over every point, from the skeleton of the angles set last.

    ``points.face`` becomes the edge that owns the roof over the point, or OUTSIDE, FLAT, CAP or CUT.
    ``points.distance`` becomes the distance from the line of that edge, metres, so that z = eave + tan(angle) *
    distance; for CAP and CUT it is the height above the eave, otherwise 0. A point exactly on the boundary of the
    polygon may count as outside.
    """
    edge, counts = skeleton.edge, skeleton.counts
    x, y, face, distance = points
    num_segments = _fill_segments(edge, num_edges, skeleton.node, skeleton.arc, counts, query.segment)
    num_faces = num_edges + counts[NUM_CAPS]
    _fill_values(edge, num_edges, max_roof_height_m, skeleton, query)
    winding = query.winding
    for first in range(0, len(x), _BLOCK):
        last = min(first + _BLOCK, len(x))
        block = QueryPoints(x[first:last], y[first:last], face[first:last], distance[first:last])
        _wind(query.segment, num_segments, num_faces, winding, block.x, block.y)
        _fill_faces(edge, num_edges, num_faces, query, block)
        for k in range(first, last):
            vertical = _vertical_face(edge, num_edges, winding, k - first) if face[k] == OUTSIDE else -1
            if vertical >= 0:
                # the point is on a vertical face, up to rounding: take the face beside it
                query.beside[0] = x[k] - 1e-7 * edge[vertical].dir_y
                query.beside[1] = y[k] + 1e-7 * edge[vertical].dir_x
                beside = QueryPoints(query.beside[:1], query.beside[1:], face[k : k + 1], distance[k : k + 1])
                # this overwrites the windings of the first point of the block
                _wind(query.segment, num_segments, num_faces, winding, beside.x, beside.y)
                _fill_faces(edge, num_edges, num_faces, query, beside)
                f = face[k]
                if f >= 0:
                    distance[k] = (y[k] - edge[f].y) * edge[f].dir_x - (x[k] - edge[f].x) * edge[f].dir_y


@entry
def _assign_all(
    batch: Batch,
    skeleton: SkeletonWork,
    query: QueryWork,
    points: QueryPoints,
    point_offset: np.ndarray,
    status: np.ndarray,
) -> None:
    """Assign the points of all polygons. Polygon p has the points ``point_offset[p]:point_offset[p + 1]``; if it has no
    skeleton, its points stay as they are."""
    x, y, face, distance = points
    for p in range(len(batch.polygon_offset) - 1):
        first, last = point_offset[p], point_offset[p + 1]
        code, num_edges = solid_skeleton(batch, p, skeleton)
        if code == OK and last > first:
            origin = batch.ring_offset[batch.polygon_offset[p]]
            for k in range(first, last):
                x[k] -= batch.xy_m[origin, 0]
                y[k] -= batch.xy_m[origin, 1]
            _assign(
                num_edges, batch.max_roof_height_m[p], skeleton, query,
                QueryPoints(x[first:last], y[first:last], face[first:last], distance[first:last]),
            )  # fmt: skip
        status[p] = code


@dataclass(frozen=True)
class RoofPoints:
    """The roof over points, one row per point.

    * z_m: float64, height, NaN where there is no roof.
    * edge: int32, the edge of the polygon (counted over all its rings) that owns the sloped face, or -1.
    * status: int32 (num_polygons,), a ``Status``.
    """

    z_m: FloatArray
    edge: IntArray
    status: IntArray


def roof_points(
    polygons: Polygons,
    angle_deg: FloatArray,
    eave_height_m: float | FloatArray,
    xy: FloatArray,
    polygon_index: IntArray,
    *,
    max_roof_height_m: float | FloatArray = np.inf,
) -> RoofPoints:
    """Heights and faces at points. polygons, angle_deg, eave_height_m: as for ``build``.

    xy: (num_points, 2), the frame of the polygons. polygon_index: int (num_points,), the polygon of
    the point. The result is exact: it comes from the skeleton, not from triangles.

    Raises ValueError if lengths do not match or an index is out of range.
    """
    num_polygons = len(polygons)
    index = np.ascontiguousarray(polygon_index, np.int64)
    points = np.ascontiguousarray(xy, np.float64).reshape(-1, 2)
    if index.shape != (len(points),):
        raise ValueError(f"polygon_index has shape {index.shape}, but there are {len(points)} points")
    if len(index) and not (index.min() >= 0 and index.max() < num_polygons):
        raise ValueError(
            f"polygon_index runs from {index.min()} to {index.max()} for {num_polygons} polygons"
        )
    eave = np.broadcast_to(np.asarray(eave_height_m, np.float64), num_polygons)
    # the height of the wall has no influence here, so any base below the eave will do
    batch = make_batch(polygons, angle_deg, eave, eave - 1.0, max_roof_height_m)
    size = work_size(polygons)
    order = np.argsort(index, kind="stable")
    face, distance = np.full(len(points), OUTSIDE, np.int64), np.zeros(len(points))
    status = np.zeros(num_polygons, np.int32)
    _assign_all(
        batch,
        skeleton_work(size),
        query_work(size),
        QueryPoints(points[order, 0], points[order, 1], face, distance),
        np.searchsorted(index[order], np.arange(num_polygons + 1)).astype(np.int64),
        status,
    )
    face[order], distance[order] = face.copy(), distance.copy()
    owned = face >= 0
    slope = np.ones(len(points))
    slope[owned] = tangents(batch.angle_deg[polygons.vertex_offset[index[owned]] + face[owned]])
    z = eave[index] + slope * distance
    z[face == OUTSIDE] = np.nan
    return RoofPoints(z, np.where(owned, face, -1).astype(np.int32), status)
