"""Skins that end on the terrain, and terrain without a surface below them: together one closed surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.booleans import manifold3d
from p2wss.reconstruction.skin import Skin

# vertices nearer to each other become one
_MERGED_M = 1e-4


def cut(skin_list: Sequence[Skin], terrain: Mesh) -> tuple[list[Skin], Mesh]:
    """The skins without what is below the terrain, and the terrain with a hole below each: the surface of the union of
    all, which the library manifold3d computes. Roofs that are partly below the terrain end there, too.

    The lower edges of the walls are edges of the terrain, with bit-identical vertices. A skin that could not be
    joined stays a solid, and so does the terrain around it; one that is below the terrain has no triangle left.
    skin_list: skins whose floors are below the terrain. terrain: a closed block.
    """
    origin = np.floor(terrain.vertex_m.min(axis=0))
    number = [k for k, skin in enumerate(skin_list) if skin.failure is None]
    meshes = [terrain, *(skin_list[k].mesh for k in number)]
    first_id = manifold3d.Manifold.reserve_ids(len(meshes))
    faces = [np.arange(len(terrain.triangle)), *(mesh.face for mesh in meshes[1:])]
    solids = [
        _solid(mesh.translated(-origin), face, first_id + k)
        for k, (mesh, face) in enumerate(zip(meshes, faces, strict=True))
    ]
    whole = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    union = whole.simplify(_MERGED_M).to_mesh64()
    vertex_m = np.asarray(union.vert_properties)[:, :3] + origin
    triangle = np.asarray(union.tri_verts).astype(np.int32)
    # each run of triangles is of one of the meshes, each triangle of one of its faces
    runs = np.diff(np.asarray(union.run_index)) // 3
    of_mesh = np.repeat(np.asarray(union.run_original_id) - first_id, runs)
    of_face = np.asarray(union.face_id).astype(np.int64)
    result = list(skin_list)
    pieces = []
    for k, mesh in enumerate(meshes):
        rows = of_mesh == k
        of_triangle = np.unique(faces[k], return_index=True)[1][of_face[rows]]
        part = Mesh(vertex_m, triangle[rows], mesh.kind[of_triangle], mesh.label[of_triangle])
        pieces.append(part.part(np.arange(len(of_triangle))))
        if k:
            skin = skin_list[number[k - 1]]
            result[number[k - 1]] = replace(skin, mesh=pieces[k], building=skin.building[of_triangle])
    return result, pieces[0]


def _solid(mesh: Mesh, face: np.ndarray, number: int) -> manifold3d.Manifold:
    """A closed mesh for the library, which tells later by this number which triangles are of which face."""
    return manifold3d.Manifold(
        manifold3d.Mesh64(
            np.ascontiguousarray(mesh.vertex_m),
            mesh.triangle.astype(np.uint64),
            run_index=np.array([0, 3 * len(mesh.triangle)], np.uint64),
            run_original_id=np.array([number], np.uint32),
            face_id=face.astype(np.uint64),
        )
    )
