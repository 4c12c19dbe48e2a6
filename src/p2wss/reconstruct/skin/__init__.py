"""One closed skin for each block of buildings that touch: party walls vanish where there are buildings on both sides.

The walls that lie on each other are cut at common points and cancel out; everything else keeps its points, in float64.
So the skin has no gap and no sliver that the buildings do not have, and every face keeps its building and kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from p2wss.reconstruct.skin.noding import node
from p2wss.reconstruct.skin.party_walls import NotJoined, without_common
from p2wss.reconstruct.skin.solids import (
    MAX_LOWERING_M,
    Face,
    Solid,
    faces_of,
    groups,
    on_common_floors,
    opposite_walls,
    weld,
)
from p2wss.reconstruct.skin.triangles import sheets, triangulate

__all__ = ["Skin", "Solid", "skins"]


@dataclass(frozen=True)
class Skin:
    """A closed surface around one building, or around several that touch.

    building_ids: of the buildings, sorted. vertex_m: float64 (v, 3), in the coordinates of the solids. triangle: int
    (t, 3); every edge has exactly two triangles and every vertex one fan of them. kind: uint8 (t,), a ``FaceKind``.
    building: int32 (t,), index into ``building_ids``. face: int32 (t,), the planar face that a triangle is part of.
    failure: why the buildings could not be joined, if this is a single building that touches others.
    """

    building_ids: tuple[str, ...]
    vertex_m: np.ndarray
    triangle: np.ndarray
    kind: np.ndarray
    building: np.ndarray
    face: np.ndarray
    failure: str | None = None


def skins(solids: Sequence[Solid], step_m: float = 0.1, max_lowering_m: float = MAX_LOWERING_M) -> list[Skin]:
    """One skin per block, in the order of the first building of each. Every solid with triangles is part of one.

    step_m: where roofs of two buildings meet in points up to this far apart, they are joined; so is a roof's point and
    another's edge that passes above or below it. Roofs then leave their planes by up to ``step_m`` at the party wall.
    With 0 every step stays. max_lowering_m: floors of touching buildings are lowered by at most this to be level.

    A block whose walls do not fit each other is joined without that, or else stays in separate skins with their
    ``failure``: a skin is always closed.
    """
    solids = [solid for solid in solids if len(solid.triangle)]
    if not solids:
        return []
    origin = np.floor(np.min([solid.vertex_m.min(axis=0) for solid in solids], axis=0))
    local = [replace(solid, vertex_m=np.asarray(solid.vertex_m, float) - origin) for solid in solids]
    point, faces = faces_of(local)
    building_of = np.array([face.building for face in faces])
    touching = building_of[opposite_walls(point, faces)].reshape(-1, 2)
    local = on_common_floors(local, touching, max_lowering_m)
    block_of = groups(len(local), touching)
    result = []
    for block in dict.fromkeys(block_of.tolist()):
        members = [local[m] for m in np.flatnonzero(block_of == block).tolist()]
        result += _joined(sorted(members, key=lambda solid: solid.building_id), origin, step_m)
    return result


def _joined(solids: Sequence[Solid], origin: np.ndarray, step_m: float) -> list[Skin]:
    """The skin around solids that touch, or one around each."""
    failure = None
    if len(solids) > 1:
        for step in dict.fromkeys((step_m, step_m / 2, step_m / 4, 0.0)):
            try:
                return [_skin(solids, *_block(solids, step), origin)]
            except NotJoined as error:
                failure = str(error)
    return [_skin([solid], *faces_of([solid]), origin, failure) for solid in solids]


def _block(solids: Sequence[Solid], step_m: float) -> tuple[np.ndarray, list[Face]]:
    """Points and faces of the skin around solids that touch."""
    point, faces = faces_of(solids)
    pairs = opposite_walls(point, faces)
    walls = np.unique(pairs).tolist()
    point = weld(point, faces, walls, step_m)
    point = node(point, faces, walls, step_m)
    plane_of = groups(len(faces), pairs)
    remaining: list[Face] = []
    for plane in dict.fromkeys(plane_of[walls].tolist()):
        here = [wall for wall in walls if plane_of[wall] == plane and faces[wall].rings]
        remaining += without_common(point, faces, here) if here else []
    apart = set(walls)
    remaining += [face for number, face in enumerate(faces) if number not in apart and face.rings]
    return point, remaining


def _skin(
    solids: Sequence[Solid],
    point: np.ndarray,
    faces: Sequence[Face],
    origin: np.ndarray,
    failure: str | None = None,
) -> Skin:
    triangulate(point, faces)
    parts = [face.triangles for face in faces if face.triangles is not None]
    sizes = [len(part) for part in parts]
    vertex, triangle = sheets(point, np.concatenate(parts))
    return Skin(
        tuple(solid.building_id for solid in solids),
        vertex + origin,
        triangle.astype(np.int32),
        np.repeat(np.array([face.kind for face in faces], np.uint8), sizes),
        np.repeat(np.array([face.building for face in faces], np.int32), sizes),
        np.repeat(np.arange(len(faces), dtype=np.int32), sizes),
        failure,
    )
