"""Meshes of buildings that touch, joined into one skin per block, and their wedges as a table."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from p2wss.formats.meshes import SURFACE_NAMES, Body
from p2wss.mesh import Mesh
from p2wss.reconstruction.running.failures import note, surviving
from p2wss.reconstruction.skin import Skin, skins, unjoined
from p2wss.reconstruction.skin.on_terrain import cut
from p2wss.reconstruction.skin.solids import MAX_LOWERING_M
from p2wss.reconstruction.skin.wedges import wedges
from p2wss.skeleton.types import FaceKind

log = logging.getLogger("p2wss")


def joined(buildings: Sequence[Body], max_lowering_m: float = MAX_LOWERING_M) -> list[Skin]:
    """The skins around ``buildings``, one each, with a warning for those that stay apart; the others as in
    :func:`p2wss.reconstruction.skin.skins`."""
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
    """The skins down to the terrain, and the terrain outside them, with a warning for those that stay solids in it and
    for those that are left out, as they are below it."""
    standing, mesh = cut(skin_list, terrain.mesh)
    whole = sum((skin.mesh.kind == FaceKind.GROUND).any() for skin in standing)
    if whole:
        log.warning("%d skins remain closed solids that overlap the terrain", whole)
    result = [skin for skin in standing if len(skin.mesh.triangle)]
    if len(result) < len(standing):
        log.warning("%d skins are below the terrain and left out of meshes", len(standing) - len(result))
    return result, replace(terrain, mesh=mesh, building=np.zeros(len(mesh.triangle), np.int32))


def skin_bodies(skin_list: Sequence[Skin], buildings: Sequence[Body]) -> list[Body]:
    """A body per skin, named after its building or, as a block, after the first of its buildings."""
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
    """Numbers of blocks, of the buildings in them, of buildings that could not be joined with those they touch, and of
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
        columns = {"skin": np.full(len(edges.face), number), "opening_angle_deg": edges.opening_angle_deg}
        for side in (0, 1):
            for axis, letter in enumerate("xyz"):
                columns[f"{letter}{side}_m"] = edges.end_m[:, side, axis]
            columns[f"face_{side}"] = edges.face[:, side]
            columns[f"kind_{side}"] = kinds[skin.mesh.kind[triangle[:, side]]]
            columns[f"building_id_{side}"] = names[skin.building[triangle[:, side]]]
        parts.append(columns)
    return {
        name: np.concatenate([part[name] for part in parts]) if parts else np.zeros(0)
        for name in WEDGES.names
    }
