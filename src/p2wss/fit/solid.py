"""One closed solid from the parts of a building: their union, with coplanar faces as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import dist
from operator import mul, sub

import manifold3d
import numpy as np

from p2wss import skeleton
from p2wss.fit.one_height import OneHeight
from p2wss.fit.planes import face_planes, neighbours, planes_at, snapped
from p2wss.skeleton import Polygons, Status

_WELD_M = 1e-4
_SHORT_EDGE_M = 1e-2
# how much higher each further part is, and what a surface may move by when slivers are taken out
_ATTEMPTS_M = ((0.0, 2e-3), (0.0, 1e-2), (0.02, 2e-3), (-0.03, 2e-3), (0.0, 3e-2))


@dataclass(frozen=True)
class Mesh:
    """A closed mesh. vertex_m (v, 3), triangle int32 (t, 3), kind uint8 (t,) (``FaceKind``), plane int32 (t,):
    triangles of one kind and plane that touch are one face."""

    vertex_m: np.ndarray
    triangle: np.ndarray
    kind: np.ndarray
    plane: np.ndarray


def union(
    parts: Sequence[OneHeight], ground_z_m: float, min_eave_height_m: float, max_roof_height_m: float
) -> Mesh | None:
    """The union of the parts' solids over one ground, z above it. None: a part has no solid, or the union is
    not one closed manifold.

    parts: in a frame in which the cuts between them run along x or y, so that the walls there are exactly
    coplanar. Parts that meet in a single edge only are no manifold: then some are raised by a few centimetres.
    An edge of millimetres is where readers that merge near vertices tear a solid open: the first attempt without
    one is taken, or with its ends as one vertex; if there is none, the first.
    """
    found = None
    for step_m, simplify_m in _ATTEMPTS_M:
        raised = [replace(part, eave_z_m=part.eave_z_m + i * step_m) for i, part in enumerate(parts)]
        mesh = _union(raised, ground_z_m, min_eave_height_m, max_roof_height_m, simplify_m)
        if mesh is None or not is_closed(mesh.vertex_m, mesh.triangle):
            continue
        if _shortest_edge_m(mesh) >= _SHORT_EDGE_M:
            return mesh
        merged = _collapsed(mesh, _SHORT_EDGE_M)
        if _shortest_edge_m(merged) >= _SHORT_EDGE_M and is_closed(merged.vertex_m, merged.triangle):
            return merged
        found = found or mesh
    return found


def _shortest_edge_m(mesh: Mesh) -> float:
    corner_m = mesh.vertex_m[mesh.triangle]
    return float(np.linalg.norm(corner_m - np.roll(corner_m, 1, axis=1), axis=2).min())


def is_sound(mesh: Mesh) -> bool:
    """Whether readers that round and triangulate faces anew will find it closed: no edge of millimetres, no
    vertex within a straight edge."""
    num_planes = planes_at(mesh.triangle, mesh.plane, len(mesh.vertex_m))
    return _shortest_edge_m(mesh) >= _SHORT_EDGE_M and bool((num_planes >= 3).all())


def is_closed(vertex_m: np.ndarray, triangle: np.ndarray) -> bool:
    """Whether every edge has exactly two triangles, in opposite directions, once vertices that files cannot
    tell apart are one."""
    corner = _welded(vertex_m)[triangle]
    corner = corner[(corner != np.roll(corner, 1, axis=1)).all(axis=1)]
    size = len(vertex_m)
    start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    forward, back = np.sort(start * size + end), np.sort(end * size + start)
    return bool(len(forward) and (np.diff(forward) > 0).all() and np.array_equal(forward, back))


def _welded(vertex_m: np.ndarray) -> np.ndarray:
    """Per vertex the number of the place, to a tenth of a millimetre, that it shares with others."""
    place = np.round(vertex_m / _WELD_M).astype(np.int64)
    order = np.lexsort(place.T)
    ordered = place[order]
    number = np.zeros(len(order), np.int64)
    number[order[1:]] = np.cumsum((ordered[1:] != ordered[:-1]).any(axis=1))
    return number


def _union(
    parts: Sequence[OneHeight],
    ground_z_m: float,
    min_eave_height_m: float,
    max_roof_height_m: float,
    simplify_m: float,
) -> Mesh | None:
    made = skeleton.build(
        Polygons.from_rings([list(part.rings) for part in parts]),
        np.concatenate([part.angle_deg for part in parts]),
        np.array([max(part.eave_z_m - ground_z_m, min_eave_height_m) for part in parts]),
        max_roof_height_m=np.array([min(part.top_m, max_roof_height_m) for part in parts]),
    )
    if (made.status != Status.OK).any():
        return None
    solids = []
    for i, part in enumerate(parts):
        vertex_m, triangle, _, _ = made.mesh(i)
        vertex_m = snapped(vertex_m, np.concatenate(list(part.rings)))
        mesh = manifold3d.Mesh64(vertex_m, triangle.astype(np.uint64))
        solids.append(manifold3d.Manifold(mesh))
    whole = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    whole = whole.as_original().simplify(simplify_m)
    if whole.status() != manifold3d.Error.NoError or whole.is_empty() or len(whole.decompose()) != 1:
        return None
    out = whole.to_mesh64()
    vertex_m = np.ascontiguousarray(np.array(out.vert_properties, float)[:, :3])
    triangle = np.array(out.tri_verts, np.int32)
    mesh = Mesh(vertex_m, triangle, *face_planes(vertex_m, triangle, neighbours(triangle)))
    return mesh if (planes_at(triangle, mesh.plane, len(vertex_m)) >= 3).all() else _collapsed(mesh)


def _collapsed(mesh: Mesh, short_m: float = 0.0) -> Mesh:
    """The mesh once vertices that only two planes share, and so lie within a straight edge, have moved to an end
    of that edge; and others along edges below ``short_m``."""
    vertex_m, triangle, plane = mesh.vertex_m, mesh.triangle, mesh.plane
    rows, place = dict(enumerate(triangle.tolist())), vertex_m.tolist()
    normal_of = _plane_normals(vertex_m, triangle, plane)
    around: dict[int, set[int]] = {}
    for t, corners in rows.items():
        for v in corners:
            around.setdefault(v, set()).add(t)
    for v in sorted(around):
        planes_of: dict[int, set[int]] = {}
        for t in around[v]:
            for w in rows[t]:
                if w != v:
                    planes_of.setdefault(w, set()).add(int(plane[t]))
        is_straight = len({int(plane[t]) for t in around[v]}) == 2
        for end in sorted(planes_of):
            along = is_straight and len(planes_of[end]) == 2
            if not along and dist(place[v], place[end]) >= short_m:
                continue
            if _can_move(place, rows, around, normal_of, v, end):
                for t in around.pop(v):
                    if end in rows[t]:
                        for w in rows.pop(t):
                            if w != v:
                                around[w].discard(t)
                    else:
                        rows[t] = [end if w == v else w for w in rows[t]]
                        around[end].add(t)
                break
    kept = np.array(list(rows), int)
    used, index = np.unique(np.array(list(rows.values()), int), return_inverse=True)
    return Mesh(vertex_m[used], index.reshape(-1, 3).astype(np.int32), mesh.kind[kept], plane[kept])


def _plane_normals(vertex_m: np.ndarray, triangle: np.ndarray, plane: np.ndarray) -> list[list[float]]:
    """Of the plane of each triangle, by area: that of a sliver tells nothing."""
    corner = vertex_m[triangle]
    own = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.zeros((plane.max() + 1, 3))
    np.add.at(total, plane, own)
    return total[plane].tolist()


def _can_move(
    place: list[list[float]],
    rows: dict[int, list[int]],
    around: dict[int, set[int]],
    normal_of: list[list[float]],
    v: int,
    end: int,
) -> bool:
    """Whether the mesh stays a manifold, and no triangle turns over, if ``v`` moves to ``end``."""
    near_v, near_end = ({w for t in around[u] for w in rows[t]} - {v, end} for u in (v, end))
    if len(near_v & near_end) != 2:
        return False
    for t in around[v]:
        if end not in rows[t]:
            after = _normal(*(place[end if w == v else w] for w in rows[t]))
            if sum(x * x for x in after) < 1e-12 or sum(map(mul, after, normal_of[t])) < 0:
                return False
    return True


def _normal(a: list[float], b: list[float], c: list[float]) -> tuple[float, float, float]:
    """Of a triangle; of three vertices numpy would take ten times as long."""
    (ux, uy, uz), (vx, vy, vz) = map(sub, b, a), map(sub, c, a)
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
