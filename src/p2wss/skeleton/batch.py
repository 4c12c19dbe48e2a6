"""Whole batches: ragged polygons in, ragged meshes out."""

from typing import NamedTuple

import numpy as np

from p2wss.skeleton.compiled import entry
from p2wss.skeleton.kinetic import skeleton_work
from p2wss.skeleton.mesh import label_kind_and_edge, mesh_work, solid_mesh
from p2wss.skeleton.records import MAX_EDGES, NUM_AMBIGUOUS, NUM_CAPS, Batch, MeshWork, SkeletonWork
from p2wss.skeleton.status import OK
from p2wss.skeleton.types import FloatArray, Meshes, Polygons, writable


class _Output(NamedTuple):
    """Ragged results of a batch; offsets have one entry more than there are polygons, faces or rings."""

    status: np.ndarray
    vertex: np.ndarray
    vertex_offset: np.ndarray
    triangle: np.ndarray
    triangle_kind: np.ndarray
    triangle_edge: np.ndarray
    triangle_offset: np.ndarray
    num_caps: np.ndarray
    num_ambiguous: np.ndarray


@entry
def _solids(batch: Batch, skeleton: SkeletonWork, mesh: MeshWork, start: int, output: _Output) -> int:
    """Build the solids of the polygons from ``start`` on. Returns the first polygon for which there is no room,
    or the number of polygons."""
    counts, xy_m = skeleton.counts, batch.xy_m
    for p in range(start, len(output.status)):
        code, num_edges, more_vertices, more_triangles = solid_mesh(batch, p, skeleton, mesh)
        num_vertices, num_triangles = output.vertex_offset[p], output.triangle_offset[p]
        if code != OK:
            more_vertices, more_triangles = 0, 0
        if num_vertices + more_vertices > len(output.vertex) or num_triangles + more_triangles > len(
            output.triangle
        ):
            return p
        output.status[p] = code
        output.num_caps[p] = counts[NUM_CAPS] if code == OK else 0
        output.num_ambiguous[p] = counts[NUM_AMBIGUOUS] if code == OK else 0
        output.vertex_offset[p + 1] = num_vertices + more_vertices
        output.triangle_offset[p + 1] = num_triangles + more_triangles
        origin = batch.ring_offset[batch.polygon_offset[p]]
        for k in range(more_vertices):
            output.vertex[num_vertices + k, 0] = mesh.vertex[k, 0] + xy_m[origin, 0]
            output.vertex[num_vertices + k, 1] = mesh.vertex[k, 1] + xy_m[origin, 1]
            output.vertex[num_vertices + k, 2] = mesh.vertex[k, 2]
        for t in range(more_triangles):
            row, label = num_triangles + t, mesh.triangle_label[t]
            for m in range(3):
                output.triangle[row, m] = mesh.triangle[t, m]
            output.triangle_kind[row], output.triangle_edge[row] = label_kind_and_edge(
                num_edges, counts, label
            )
    return len(output.status)


_PER_POLYGON = {"status", "vertex_offset", "triangle_offset", "num_caps", "num_ambiguous"}


def _output(num_polygons: int, num_rows: int) -> _Output:
    return _Output(
        status=np.zeros(num_polygons, np.int32),
        vertex=np.empty((num_rows, 3)),
        vertex_offset=np.zeros(num_polygons + 1, np.int64),
        triangle=np.empty((2 * num_rows, 3), np.int32),
        triangle_kind=np.empty(2 * num_rows, np.uint8),
        triangle_edge=np.empty(2 * num_rows, np.int32),
        triangle_offset=np.zeros(num_polygons + 1, np.int64),
        num_caps=np.zeros(num_polygons, np.int32),
        num_ambiguous=np.zeros(num_polygons, np.int32),
    )


def _grow(output: _Output) -> _Output:
    """A copy with twice the room; arrays with one entry per polygon stay as they are."""
    return output._replace(
        **{
            name: np.concatenate((array, np.zeros_like(array)))
            for name, array in output._asdict().items()
            if name not in _PER_POLYGON
        }
    )


def _per_polygon(value: float | FloatArray, num_polygons: int) -> FloatArray:
    return writable(np.broadcast_to(np.asarray(value, np.float64), num_polygons), np.float64)


def make_batch(
    polygons: Polygons,
    angle_deg: FloatArray,
    eave_height_m: float | FloatArray,
    base_height_m: float | FloatArray,
    max_roof_height_m: float | FloatArray,
) -> Batch:
    """All arguments of :func:`build` as contiguous arrays of the dtypes for which the code is compiled.

    Raises ValueError if the number of angles differs from the number of edges.
    """
    num_polygons = len(polygons)
    xy_m = writable(polygons.xy_m, np.float64).reshape(-1, 2)
    angle = writable(angle_deg, np.float64)
    if angle.shape != (len(xy_m),):
        raise ValueError(f"angle_deg has shape {angle.shape}, but there are {len(xy_m)} edges")
    return Batch(
        xy_m,
        writable(polygons.ring_offset, np.int64),
        writable(polygons.polygon_offset, np.int64),
        angle,
        _per_polygon(eave_height_m, num_polygons),
        _per_polygon(base_height_m, num_polygons),
        _per_polygon(max_roof_height_m, num_polygons),
    )


def work_size(polygons: Polygons) -> int:
    """Number of edges for which the work arrays need room: the edges of the largest polygon, at most the limit above
    which polygons are rejected."""
    num_edges = np.diff(polygons.vertex_offset)
    return int(min(max(num_edges.max(initial=3), 16), MAX_EDGES))


def build(
    polygons: Polygons,
    angle_deg: FloatArray,
    eave_height_m: FloatArray,
    *,
    base_height_m: float | FloatArray = 0.0,
    max_roof_height_m: float | FloatArray = np.inf,
) -> Meshes:
    """Closed LoD2 meshes from clean polygons.

    polygons: as cleaned by :mod:`p2wss.footprints`, any planar frame in metres (coordinates of 7e6 m
    are possible, because the computation is relative to the first vertex). angle_deg: (num_vertices,), per
    edge 0, 90 or 5..85. eave_height_m: (num_polygons,), measured from z = 0. base_height_m: height of the
    ground face, below the eave; negative to reach down a slope. max_roof_height_m: a roof that would rise
    higher above its eave is cut flat there. Both are one value per polygon or one for all.

    Every mesh has T = 2 V - 4 + 4 c triangles for V vertices and c courtyards: coplanar neighbours share a
    face. No geometry raises: a polygon that cannot be built has a ``Status`` other than OK and no
    triangles.

    Raises ValueError if the lengths of the arrays do not match.

    Model: the parametric building of the Point2WSS paper, section 3; weighted straight skeletons: Held and
    Palfrader 2017.
    """
    batch = make_batch(polygons, angle_deg, eave_height_m, base_height_m, max_roof_height_m)
    size = work_size(polygons)
    work = skeleton_work(size), mesh_work(size)
    output = _output(len(polygons), 4 * len(polygons.xy_m) + 64)
    done = _solids(batch, *work, 0, output)
    while done < len(polygons):
        output = _grow(output)
        done = _solids(batch, *work, done, output)
    num_triangles = output.triangle_offset[-1]
    return Meshes(
        output.vertex[: output.vertex_offset[-1]].copy(),
        output.triangle[:num_triangles].copy(),
        output.triangle_kind[:num_triangles].copy(),
        output.triangle_edge[:num_triangles].copy(),
        output.vertex_offset,
        output.triangle_offset,
        output.status,
        output.num_caps,
        output.num_ambiguous,
    )
