"""Closed meshes without slivers, short edges, and vertices within faces and straight edges."""

from __future__ import annotations

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.booleans import manifold3d
from p2wss.mesh.rules import crosses_itself

_SHORT_EDGE_M = 1e-2
# triangles smaller than this count as turned over
_NO_AREA_M2 = 1e-6
# how far a surface may move when slivers are removed
_SIMPLIFY_M = 2e-3


def is_sound(mesh: Mesh) -> bool:
    """Whether a mesh stays closed in programs that round coordinates and triangulate faces again: it has no edge of a
    few millimetres, no vertex within a straight edge, and no faces that cross."""
    if mesh.edge_m.min() < _SHORT_EDGE_M or (mesh.num_planes_at < 3).any():
        return False
    return not crosses_itself(mesh.vertex_m, mesh.triangle)


def simplified(vertex_m: np.ndarray, triangle: np.ndarray) -> Mesh | None:
    """A closed mesh (v, 3), (t, 3), some vertices of which may be unused, without the slivers and the vertices within
    faces and straight edges; None if it is not one solid."""
    used, index = np.unique(triangle, return_inverse=True)
    corners = index.reshape(-1, 3).astype(np.uint64)
    whole = manifold3d.Manifold(manifold3d.Mesh64(np.ascontiguousarray(vertex_m[used]), corners))
    whole = whole.as_original().simplify(_SIMPLIFY_M)
    if whole.status() != manifold3d.Error.NoError or whole.is_empty() or len(whole.decompose()) != 1:
        return None
    out = whole.to_mesh64()
    vertex_m = np.ascontiguousarray(np.array(out.vert_properties, float)[:, :3])
    mesh = Mesh.of_triangles(vertex_m, np.array(out.tri_verts, np.int32))
    return mesh if (mesh.num_planes_at >= 3).all() else collapse_vertices(mesh)


def collapse_vertices(mesh: Mesh) -> Mesh:
    """The mesh without the vertices in only two planes, which lie within a straight edge."""
    vertex_m = mesh.vertex_m
    rows, plane_of = dict(enumerate(mesh.triangle.tolist())), mesh.label.tolist()
    kind_of = mesh.kind.tolist()
    normal_of = _plane_normals(mesh)
    around: dict[int, set[int]] = {}
    for t, corners in rows.items():
        for v in corners:
            around.setdefault(v, set()).add(t)
    for v in sorted(around):
        if len({plane_of[t] for t in around[v]}) != 2:
            continue
        filled = _without_straight_vertex(vertex_m, rows, around, plane_of, normal_of, v)
        if filled is not None:
            for t in sorted(around.pop(v)):
                for w in rows.pop(t):
                    if w != v:
                        around[w].discard(t)
            for like, corners in filled:
                t = len(plane_of)
                rows[t] = corners
                plane_of.append(plane_of[like])
                kind_of.append(kind_of[like])
                normal_of.append(normal_of[like])
                for w in corners:
                    around[w].add(t)
    remaining = list(rows)
    used, index = np.unique(np.array(list(rows.values()), int), return_inverse=True)
    kind, label = np.array(kind_of, np.uint8)[remaining], np.array(plane_of, np.int32)[remaining]
    return Mesh(vertex_m[used], index.reshape(-1, 3).astype(np.int32), kind, label)


def _without_straight_vertex(
    vertex_m: np.ndarray,
    rows: dict[int, list[int]],
    around: dict[int, set[int]],
    plane_of: list[int],
    normal_of: list[list[float]],
    v: int,
) -> list[tuple[int, list[int]]] | None:
    """Triangles that fill the two faces around a vertex within a straight edge once it is gone, each with one of the
    triangles there, whose plane it shares; None if they cannot be filled without it.

    Moving the vertex to an end of its edge would turn triangles over in a face that cannot be seen whole from there.
    """
    following: dict[int, dict[int, int]] = {}
    for t in around[v]:
        k = rows[t].index(v)
        following.setdefault(plane_of[t], {})[rows[t][k - 2]] = rows[t][k - 1]
    borders = {w for t in around[v] for w in rows[t]} - {v}
    sides = {
        (w, rows[t][k - 2]) for u in borders for t in around[u] - around[v] for k, w in enumerate(rows[t])
    }
    like = {plane_of[t]: t for t in sorted(around[v])}
    result = []
    for number, after in sorted(following.items()):
        starts = after.keys() - after.values()
        if len(starts) != 1:
            return None
        chain = [starts.pop()]
        while chain[-1] in after:
            chain.append(after[chain[-1]])
        if len(chain) != len(after) + 1:
            return None
        normal = np.array(normal_of[like[number]])
        dropped = int(np.abs(normal).argmax())
        flat_m = vertex_m[chain][:, [(dropped + 1) % 3, (dropped + 2) % 3]] * (1.0, np.sign(normal[dropped]))
        for corners in manifold3d.triangulate([flat_m]).tolist() if len(chain) > 2 else []:
            (ax, ay), (bx, by), (cx, cy) = flat_m[corners].tolist()
            if (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < _NO_AREA_M2:
                return None
            result.append((like[number], [chain[k] for k in corners]))
    new_sides = [(w, row[k - 2]) for _, row in result for k, w in enumerate(row)]
    return None if len(set(new_sides)) < len(new_sides) or sides.intersection(new_sides) else result


def _plane_normals(mesh: Mesh) -> list[list[float]]:
    """The normal of each triangle's plane, weighted by area, as the normal of a sliver alone is unreliable."""
    total = np.zeros((mesh.label.max() + 1, 3))
    np.add.at(total, mesh.label, mesh.doubled_m2)
    return total[mesh.label].tolist()
