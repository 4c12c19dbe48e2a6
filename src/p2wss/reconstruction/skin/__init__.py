"""One closed skin for each block of buildings that touch: party walls vanish where there are buildings on both sides.

Where walls face each other, they cancel out; everything else keeps its points, in float64. So the skin has no gap and
no sliver that the buildings do not have, and every face keeps its building and kind.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.planar import with_exact_faces
from p2wss.reconstruction.running.failures import note, surviving
from p2wss.reconstruction.skin.common_roofs import with_common_roofs
from p2wss.reconstruction.skin.party_walls import NotJoined, without_party_walls
from p2wss.reconstruction.skin.solids import (
    MAX_LOWERING_M,
    Face,
    faces_of,
    on_common_floors,
    opposite_walls,
)
from p2wss.reconstruction.skin.triangles import sheets, triangulated
from p2wss.skeleton.groups import groups

__all__ = ["Skin", "skins"]


@dataclass(frozen=True)
class Skin:
    """A closed surface around one building, or around several that touch.

    building_ids: sorted. mesh: in the coordinates of the buildings' meshes. Every edge has exactly two triangles, every
    vertex one fan of triangles, and every face its own label. building: int32 (t,), the building of each triangle, an
    index into ``building_ids``. failure: if this is a single building that touches others, why they could not be
    joined, else None.
    """

    building_ids: tuple[str, ...]
    mesh: Mesh
    building: np.ndarray
    failure: str | None = None


def skins(solids: Mapping[str, Mesh], max_lowering_m: float = MAX_LOWERING_M) -> list[Skin]:
    """One skin per block, in the order of the first building of each. Every building is part of one.

    solids: closed meshes by the ids of the buildings, with vertical walls and one roof height at every place.
    max_lowering_m: floors of touching buildings are lowered by at most this to be level.

    A skin is always closed: if the walls of a block do not fit each other, each of its buildings gets a skin of its own
    with a ``failure``. The same holds, where errors are met, for a block at which the code fails.
    """
    if not solids:
        return []
    origin = np.floor(np.min([mesh.vertex_m.min(axis=0) for mesh in solids.values()], axis=0))
    local = {name: mesh.translated(-origin) for name, mesh in solids.items()}
    point, faces = faces_of(list(local.values()))
    building_of = np.array([face.building for face in faces])
    touching = building_of[opposite_walls(point, faces)].reshape(-1, 2)
    local = on_common_floors(local, touching, max_lowering_m)
    names, block_of = np.array(list(local), object), groups(len(local), touching)
    blocks = [
        {name: local[name] for name in sorted(names[block_of == block])}
        for block in dict.fromkeys(block_of.tolist())
    ]

    def apart(block: Mapping[str, Mesh], trace: str) -> list[Skin]:
        note(f"skin of the block of {min(block)}", trace, "its buildings stay apart")
        return unjoined({name: mesh.translated(origin) for name, mesh in block.items()})

    return surviving(lambda some: [skin for block in some for skin in _joined(block, origin)], blocks, apart)


def unjoined(solids: Mapping[str, Mesh]) -> list[Skin]:
    """After an internal error: each building's mesh as a skin of its own."""
    return [
        Skin((name,), mesh, np.zeros(len(mesh.triangle), np.int32), "internal error")
        for name, mesh in solids.items()
    ]


def _joined(solids: Mapping[str, Mesh], origin: np.ndarray) -> list[Skin]:
    """One skin around solids that touch; if they cannot be joined, one skin around each, with the failure."""
    failure = None
    if len(solids) > 1:
        try:
            parts = without_party_walls(*faces_of(with_common_roofs(list(solids.values()))))
            return [_skin(list(solids), *parts, origin)]
        except NotJoined as error:
            failure = str(error)
    return [_skin([name], *faces_of([mesh]), origin, failure) for name, mesh in solids.items()]


def _skin(
    building_ids: Sequence[str],
    point: np.ndarray,
    faces: Sequence[Face],
    origin: np.ndarray,
    failure: str | None = None,
) -> Skin:
    exact = with_exact_faces(sheets(triangulated(point, faces)), walls_stay=len(building_ids) == 1)
    building = np.array([face.building for face in faces], np.int32)[exact.label]
    return Skin(tuple(building_ids), exact.translated(origin), building, failure)
