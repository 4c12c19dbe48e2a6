"""The files of ``p2wss reconstruct``: every format from the same results, each written whole or not at all."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from p2wss.config import OUTPUT_SUFFIXES, Output, Reconstruct
from p2wss.data import files
from p2wss.data.clouds import same_crs
from p2wss.data.terrain import Terrain
from p2wss.errors import InputError
from p2wss.formats import gpkg
from p2wss.formats.glb import glb
from p2wss.formats.meshes import AXES, Frame, Mesh, frame_around, obj, ply, stl
from p2wss.reconstruct import terrain_mesh
from p2wss.reconstruct.pipeline import Result, city_json, table, vertices_m

MESH_OUTPUTS: tuple[Output, ...] = ("glb", "obj", "ply", "stl")
# a footprint's own ground and the terrain differ by this much only where their heights are two systems
_OTHER_SYSTEM_M = 1.0


def write(
    folder: Path,
    stem: str,
    results: Sequence[Result],
    crs: pyproj.CRS,
    facts: dict[str, Any],
    config: Reconstruct,
    terrain: Terrain | None = None,
) -> list[str]:
    """Write every file of ``config.outputs`` to ``folder``, and ``STEM.json`` last; their names.

    With a terrain the meshes stand in a block of it (:mod:`p2wss.terrain_mesh`); CityJSON stays as it is.
    Raises :class:`InputError` if a file cannot be written or the terrain is somewhere else.
    """
    buildings = [mesh(result) for result in results if result.reconstruction.has_mesh]
    ground = None if terrain is None else block(buildings, terrain, config)
    if terrain is not None:
        buildings = terrain_mesh.standing(buildings, terrain)
    whole = buildings if ground is None else [*buildings, ground]
    frame = frame_around(whole, crs.to_string())
    written = []
    for output in dict.fromkeys(config.outputs):
        name = f"{stem}{OUTPUT_SUFFIXES[output]}"
        if output == "gpkg":
            gpkg.write(folder / name, table(results, crs), facts)
        elif output == "geoparquet":
            files.write_geoparquet(folder / name, table(results, crs), facts)
        elif output in ("cityjson", "cityjsonseq"):
            files.write_text(folder / name, city_json(results, crs, output))
        else:
            files.write_bytes(folder / name, document(output, whole, frame, facts))
        written.append(name)
        if config.per_building and output in MESH_OUTPUTS:
            for one, file in zip(whole, file_names([one.name for one in whole]), strict=True):
                path = folder / stem / f"{file}{OUTPUT_SUFFIXES[output]}"
                files.write_bytes(path, document(output, [one], frame, facts))
            written.append(f"{stem}/*{OUTPUT_SUFFIXES[output]}")
    files.write_json(
        folder / f"{stem}.json",
        {
            "p2wss": facts,
            "crs": frame.crs,
            "origin_m": frame.origin_m.tolist(),
            "axes": {"obj, ply, stl": AXES, "glb": "as its asset's extras tell: y up"},
            "files": written,
            "buildings": counts(results),
            "terrain": None if ground is None else {"mesh": ground.name, "triangles": len(ground.triangle)},
        },
    )
    return [*written, f"{stem}.json"]


def document(output: str, meshes: Sequence[Mesh], frame: Frame, facts: dict[str, Any]) -> bytes:
    """Meshes in one of :data:`MESH_OUTPUTS`."""
    if output == "glb":
        return glb(meshes, frame, facts)
    return {"obj": obj, "ply": ply, "stl": stl}[output](meshes, frame)


def file_names(names: Sequence[str]) -> list[str]:
    """Names for files, all different on any file system.

    >>> file_names(["A/1", "a_1", "..", "Ö 2"])
    ['A_1', 'a_1-2', '_', 'Ö_2']
    """
    result: list[str] = []
    seen: set[str] = set()
    for number, name in enumerate(names, 1):
        plain = re.sub(r"[^\w.-]", "_", name).strip(".")[:100] or "_"
        while plain.lower() in seen:
            plain = f"{plain}-{number}"
        seen.add(plain.lower())
        result.append(plain)
    return result


def block(buildings: Sequence[Mesh], terrain: Terrain, config: Reconstruct) -> Mesh | None:
    """The terrain around the buildings; None without any. Raises :class:`InputError` if it is elsewhere."""
    if not buildings:
        return None
    corners = np.concatenate([one.vertex_m for one in buildings])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = config.terrain_margin_m
    bounds = (low[0] - margin, low[1] - margin, high[0] + margin, high[1] + margin)
    try:
        return terrain_mesh.block(terrain, bounds, config.terrain_tolerance_m, low[2])
    except ValueError as error:
        raise InputError(f"the terrain of --terrain has no height around the buildings: {error}") from error


def check_terrain(terrain_crs: pyproj.CRS, crs: pyproj.CRS, name: Path) -> None:
    """Raise :class:`InputError` if the terrain is in another CRS than the clouds."""
    if not same_crs(terrain_crs, crs):
        raise InputError(f"{name} is in {terrain_crs.name}, but the clouds in {crs.name}; reproject it")


def terrain_note(results: Sequence[Result], terrain: Terrain) -> str | None:
    """A warning where the terrain's heights are not those of the clouds."""
    made = [result.reconstruction for result in results if result.reconstruction.has_mesh]
    if not made:
        return None
    middle = np.array([one.vertex_m[:, :2].mean(axis=0) + one.origin_xy_m for one in made])
    gap = terrain.interpolated(middle[:, 0], middle[:, 1]) - [one.ground_z_m for one in made]
    known = gap[np.isfinite(gap)]
    if len(known) and abs(np.median(known)) <= _OTHER_SYSTEM_M:
        return None
    told = f"{np.median(known):+.1f} m from the clouds' ground" if len(known) else "unknown at the buildings"
    return f"the heights of the terrain are {told}: are both in the same height system?"


def counts(results: Sequence[Result]) -> dict[str, Any]:
    """How many of each status, with reasons, methods and flags."""
    return {
        "total": len(results),
        "status": dict(Counter(result.status for result in results)),
        "reasons": dict(Counter(result.reason for result in results if result.reason)),
        "methods": dict(Counter(r.reconstruction.method for r in results if r.reconstruction.has_mesh)),
        "not_representable": sum(result.not_representable for result in results),
    }


def mesh(result: Result) -> Mesh:
    """The building's mesh in the CRS of the cloud."""
    made = result.reconstruction
    return Mesh(made.building_id, vertices_m(made), made.triangle, made.kind)
