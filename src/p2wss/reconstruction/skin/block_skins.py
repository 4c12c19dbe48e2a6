"""Meshes of buildings that touch, joined into one skin per block, and their wedges as a table: the convex edges at
which a simulator lets rays diffract.

Skins that end on the terrain, and terrain without a surface below them, are together one closed surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from p2wss.formats.meshes import SURFACE_NAMES, Body
from p2wss.mesh import Mesh
from p2wss.mesh.booleans import manifold3d
from p2wss.mesh.topology import NEXT, unit_normals
from p2wss.reconstruction.running.failures import note, surviving
from p2wss.reconstruction.skin import Skin, skins, unjoined
from p2wss.reconstruction.skin.solids import MAX_LOWERING_M
from p2wss.skeleton.angles import bearings
from p2wss.skeleton.types import FaceKind
from p2wss.storage.messages import log

# an edge at which the surface turns by less is no wedge
_MIN_TURN_DEG = 1.0
# vertices nearer to each other become one
_MERGED_M = 1e-4


@dataclass(frozen=True)
class Wedges:
    """Convex edges of one skin.

    end_m: float64 (w, 2, 3), the two ends. opening_angle_deg: (w,), the angle between the two faces inside the
    buildings, below 180. face: int32 (w, 2), the labels of these faces: first the left one, seen from outside when
    looking from the first end to the second.
    """

    end_m: np.ndarray
    opening_angle_deg: np.ndarray
    face: np.ndarray


def cut(skin_list: Sequence[Skin], terrain: Mesh) -> tuple[list[Skin], Mesh]:
    """(the skins without their parts below the terrain, the terrain with a hole below each skin): together the surface
    of the union of all, which the library manifold3d computes. Roofs that reach below the terrain end there, too.

    The lower edges of the walls are edges of the terrain, with bit-identical vertices. A skin that could not be joined
    stays a whole solid, and the terrain has no hole below it. A skin that is all below the terrain has no triangle
    left. skin_list: skins whose floors are below the terrain. terrain: a closed block.
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
    # a run of triangles comes from one of the meshes, and each of its triangles from a face of this mesh
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
    """A closed mesh for the library. In the result of the library, ``number`` and ``face`` identify the face of each
    triangle."""
    return manifold3d.Manifold(
        manifold3d.Mesh64(
            np.ascontiguousarray(mesh.vertex_m),
            mesh.triangle.astype(np.uint64),
            run_index=np.array([0, 3 * len(mesh.triangle)], np.uint64),
            run_original_id=np.array([number], np.uint32),
            face_id=face.astype(np.uint64),
        )
    )


def joined(buildings: Sequence[Body], max_lowering_m: float = MAX_LOWERING_M) -> list[Skin]:
    """The skins of :func:`p2wss.reconstruction.skin.skins` around ``buildings``, with a warning for buildings that stay
    apart."""
    solids = {body.name: body.mesh for body in buildings}

    def none(solids: dict[str, Mesh], trace: str) -> list[Skin]:
        note("skins", trace, "all buildings stay apart")
        return unjoined(solids)

    result = surviving(lambda some: skins(some[0], max_lowering_m), [solids], none)
    apart = [skin for skin in result if skin.failure is not None]
    if apart:
        example = f"{apart[0].building_ids[0]}: {apart[0].failure}"
        log.warning(
            "%d buildings remain separate solids because they do not match their neighbours (%s)",
            len(apart),
            example,
        )
    return result


def on_terrain(skin_list: Sequence[Skin], terrain: Body) -> tuple[list[Skin], Body]:
    """(the skins down to the terrain, the terrain outside them). A warning says how many skins stay whole solids that
    reach into the terrain, and how many are left out because they are below it."""
    standing, mesh = cut(skin_list, terrain.mesh)
    whole = sum((skin.mesh.kind == FaceKind.GROUND).any() for skin in standing)
    if whole:
        log.warning("%d skins remain closed solids that overlap the terrain", whole)
    result = [skin for skin in standing if len(skin.mesh.triangle)]
    if len(result) < len(standing):
        log.warning("%d skins are below the terrain and left out of meshes", len(standing) - len(result))
    return result, replace(terrain, mesh=mesh, building=np.zeros(len(mesh.triangle), np.int32))


def skin_bodies(skin_list: Sequence[Skin], buildings: Sequence[Body]) -> list[Body]:
    """A body per skin, named after its building; a skin of several is named ``block_`` and their first id."""
    references = {body.name: body.buildings[0] for body in buildings}
    return [
        Body(
            skin.building_ids[0] if len(skin.building_ids) == 1 else f"block_{skin.building_ids[0]}",
            skin.mesh,
            skin.building,
            tuple(references[name] for name in skin.building_ids),
        )
        for skin in skin_list
    ]


def counts(skin_list: Sequence[Skin]) -> dict[str, int]:
    """How many blocks there are, buildings in them, buildings that could not be joined with touching buildings, and
    skins that end on the terrain."""
    blocks = [skin for skin in skin_list if len(skin.building_ids) > 1]
    return {
        "blocks": len(blocks),
        "buildings_in_blocks": sum(len(skin.building_ids) for skin in blocks),
        "not_joined": sum(skin.failure is not None for skin in skin_list),
        "cut_from_terrain": sum(not (skin.mesh.kind == FaceKind.GROUND).any() for skin in skin_list),
    }


def wedge_columns(skin_list: Sequence[Skin]) -> dict[str, np.ndarray]:
    """The columns of :data:`p2wss.storage.schemas.wedges.WEDGES`, a row per wedge of the skins."""
    from p2wss.storage.schemas.wedges import WEDGES

    kinds = np.array([SURFACE_NAMES.get(k, "") for k in range(max(SURFACE_NAMES) + 1)], dtype=object)
    parts: list[dict[str, np.ndarray]] = []

    def none(skin: Skin, trace: str) -> list[None]:
        note(f"wedges of the skin of {skin.building_ids[0]}", trace, "it gets none")
        return [None]

    found = surviving(lambda some: map(wedges, some), skin_list, none)
    for number, (skin, edges) in enumerate(zip(skin_list, found, strict=True)):
        if edges is None:
            continue
        # a triangle of each face states its kind and building
        faces, example = np.unique(skin.mesh.label, return_index=True)
        triangle = example[np.searchsorted(faces, edges.face)]
        names = np.array(skin.building_ids, dtype=object)
        of_sides = {
            **{f"{letter}{{}}_m": edges.end_m[..., axis] for axis, letter in enumerate("xyz")},
            "face_{}": edges.face,
            "kind_{}": kinds[skin.mesh.kind[triangle]],
            "building_id_{}": names[skin.building[triangle]],
        }
        columns = {"skin": np.full(len(edges.face), number), "opening_angle_deg": edges.opening_angle_deg}
        parts.append(
            columns | {name.format(k): each[:, k] for name, each in of_sides.items() for k in (0, 1)}
        )
    return {
        name: np.concatenate([part[name] for part in parts]) if parts else np.zeros(0)
        for name in WEDGES.names
    }


def wedges(skin: Skin) -> Wedges:
    """The convex edges of the mesh of a skin, with the angles between its triangles."""
    origin = skin.mesh.vertex_m.min(axis=0)
    mesh = skin.mesh.translated(-origin)
    vertex, twin = mesh.vertex_m, mesh.twin.ravel()
    start, end = mesh.triangle.ravel(), mesh.triangle[:, NEXT].ravel()
    # a skin that ends on the terrain has edges without a second triangle there
    once = np.flatnonzero((start < end) & (twin >= 0))
    start, end, left, right = start[once], end[once], once // 3, twin[once] // 3
    normal = unit_normals(mesh.corner_m)
    along = vertex[end] - vertex[start]
    along /= np.linalg.norm(along, axis=1)[:, None]
    sine = (np.cross(normal[left], normal[right]) * along).sum(axis=1)
    cosine = (normal[left] * normal[right]).sum(axis=1)
    # positive where the surface turns away from the outside, as at the corner of a box
    turn_deg = np.degrees(bearings(np.column_stack([cosine, sine])))
    is_wedge = turn_deg > _MIN_TURN_DEG
    return Wedges(
        vertex[np.column_stack([start, end])[is_wedge]] + origin,
        180 - turn_deg[is_wedge],
        mesh.label[np.column_stack([left, right])[is_wedge]].astype(np.int32),
    )
