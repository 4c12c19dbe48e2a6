"""The output files of ``p2wss reconstruct``, all from the same results, each written completely or not at all."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from p2wss.config import ERRORS_SUFFIX, OUTPUT_SUFFIXES, WEDGES_SUFFIX, Reconstruct
from p2wss.config.reconstruct import Output
from p2wss.data.reasons import DUPLICATE, HAS_PARTS, UNSEEN
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import grown
from p2wss.formats import gpkg, sionna
from p2wss.formats.materials import materials_of
from p2wss.formats.meshes import AXES, Body, BuildingRef, Frame, file_names, frame_around
from p2wss.formats.outputs import MESH_WRITERS, SINGLE_FILES, FileOptions
from p2wss.reconstruction.outputs.attributes import input_footprints, table, with_columns
from p2wss.reconstruction.outputs.city import city_json
from p2wss.reconstruction.outputs.page import page_of_run
from p2wss.reconstruction.outputs.vegetation import Plant
from p2wss.reconstruction.pipeline import input_columns
from p2wss.reconstruction.result import Result
from p2wss.reconstruction.running.failures import met, note, surviving
from p2wss.reconstruction.running.spool import Lazy
from p2wss.reconstruction.skin import Skin, block_skins, terrain_mesh
from p2wss.reconstruction.skin.solids import MAX_LOWERING_M
from p2wss.storage import files
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError


def write(
    folder: Path,
    stem: str,
    results: Sequence[Result],
    crs: pyproj.CRS,
    facts: dict[str, Any],
    config: Reconstruct,
    terrain: Terrain | None = None,
    plants: Sequence[Plant] = (),
) -> list[Path]:
    """Write every file of ``config.outputs`` to ``folder``, ``STEM.json`` last, and return the paths.

    ``STEM.json`` lists the SHA-256 of all other files, for ``p2wss inspect --verify STEM.json``.

    With a terrain, the meshes stand in a block of terrain (:mod:`p2wss.reconstruction.skin.terrain_mesh`). With
    ``config.skin``, the meshes of touching buildings become one mesh (:mod:`p2wss.reconstruction.skin`). CityJSON does
    not change. results: may be read from a file at each access. In memory are, with skins or a terrain, all meshes; for
    a table or a mesh file, its content; for CityJSON, nothing of that kind.

    Where errors are met, a file that cannot be made is left out, and ``STEM.errors.log`` has the tracebacks of all
    errors of the run. Raises :class:`InputError` if a file cannot be written or the terrain does not cover the
    buildings.
    """

    def alone(
        terrain: Terrain | None, trace: str
    ) -> list[tuple[Sequence[Body], Body | None, Sequence[Skin]]]:
        note("skins and terrain", trace, "meshes are written as they are")
        return [_meshes(results, None, config.model_copy(update={"skin": False, "wedges": False}))]

    ((meshes, ground, skins),) = surviving(
        lambda some: [_meshes(results, each, config) for each in some], [terrain], alone
    )
    vegetation = [
        replace(
            Body.of_building(plant.name, plant.mesh, {"vegetation": config.materials.vegetation}),
            attributes=plant.attributes,
        )
        for plant in plants
    ]
    bodies = [*meshes, *vegetation] if vegetation else meshes
    frame = frame_around(meshes, crs.to_string())
    single = file_names([body.name for body in meshes]) if config.per_building else []

    def of_output(output: Output) -> tuple[list[str], list[Path]]:
        path = folder / f"{stem}{OUTPUT_SUFFIXES[output]}"
        names, paths = [f"{stem}{OUTPUT_SUFFIXES[output]}"], [path]
        if output == "report":
            crowns = [plant.mesh for plant in plants]
            page = page_of_run(results, stem, crs, facts, config.keep_columns, crowns, terrain)
            files.write_text(path, page)
        elif output in MESH_WRITERS:
            paths = write_meshes(folder, stem, output, bodies, frame, config, facts)
            if single and output in SINGLE_FILES:
                names.append(f"{stem}/*{OUTPUT_SUFFIXES[output]}")
                for body, file in zip(meshes, single, strict=True):
                    paths += write_meshes(folder / stem, file, output, [body], frame, config, facts)
        else:
            _write_results(path, output, kept(results, config), plants, crs, facts, config)
        return names, paths

    def unwritten(output: Output, trace: str) -> list[tuple[list[str], list[Path]]]:
        note(f"{stem}{OUTPUT_SUFFIXES[output]}", trace, "it is not written")
        return []

    outputs = list(dict.fromkeys(config.outputs))
    done = surviving(lambda some: map(of_output, some), outputs, unwritten)
    written, delivered = (list(chain(*each)) for each in (zip(*done, strict=True) if done else ([], [])))
    columns = block_skins.wedge_columns(skins) if config.wedges else None
    if columns is not None:
        from p2wss.storage.schemas.wedges import WEDGES  # and with it pyarrow

        files.write_table(folder / f"{stem}{WEDGES_SUFFIX}", columns, WEDGES, facts)
        written.append(f"{stem}{WEDGES_SUFFIX}")
        delivered.append(folder / f"{stem}{WEDGES_SUFFIX}")
    errors = met()
    if errors is not None and errors.traces:
        files.write_text(folder / f"{stem}{ERRORS_SUFFIX}", errors.text)
        written.append(f"{stem}{ERRORS_SUFFIX}")
        delivered.append(folder / f"{stem}{ERRORS_SUFFIX}")
    files.write_json(
        folder / f"{stem}.json",
        {
            "p2wss": facts,
            "crs": frame.crs,
            "origin_m": frame.origin_m.tolist(),
            "axes": {"obj, ply, stl, sionna, helios": AXES, "glb": "y up, see the extras of its asset"},
            "files": written,
            "sha256": {path.relative_to(folder).as_posix(): files.sha256(path) for path in delivered},
            "buildings": counts(results),
            "skin": block_skins.counts(skins) if config.skin else None,
            "closed": "all meshes together" if _is_cut(config, ground is not None) else "each mesh",
            "wedges": columns and len(columns["skin"]),
            "vegetation": dict(Counter(plant.city_type for plant in plants)) if config.vegetation else None,
            "errors": [] if errors is None else sorted(errors.traces),
            "is_complete": len(done) == len(outputs),
            "terrain": None
            if ground is None
            else {"mesh": ground.name, "triangles": len(ground.mesh.triangle), **ground.attributes},
        },
    )
    return [*delivered, folder / f"{stem}.json"]


def _meshes(
    results: Sequence[Result], terrain: Terrain | None, config: Reconstruct
) -> tuple[Sequence[Body], Body | None, Sequence[Skin]]:
    """(all meshes to write, the terrain included; the mesh of the terrain or None; the skins of the blocks if skins or
    wedges are requested).

    Without skin, wedges and terrain, each mesh is made when it is accessed.
    """
    with_mesh = [number for number, result in enumerate(results) if result.reconstruction.has_mesh]
    buildings: Sequence[Body] = Lazy(lambda number: mesh(results[number], config), with_mesh)
    if terrain is not None or config.skin or config.wedges:
        buildings = list(buildings)
    ground = None
    if terrain is not None and buildings:
        buildings, ground = with_terrain(buildings, terrain, config)
    skins: Sequence[Skin] = []
    if config.skin or config.wedges:
        is_cut = ground is not None and config.skin_terrain == "cut"
        max_lowering_m = np.inf if is_cut else MAX_LOWERING_M
        skins = block_skins.joined(buildings, max_lowering_m)
        if ground is not None and is_cut:
            skins, with_holes = block_skins.on_terrain(skins, ground)
            ground = with_holes if config.skin else ground
    if config.skin:
        buildings = block_skins.skin_bodies(skins, buildings)
    return (buildings if ground is None else [*buildings, ground]), ground, skins


def _write_results(
    path: Path,
    output: str,
    results: Sequence[Result],
    plants: Sequence[Plant],
    crs: pyproj.CRS,
    facts: dict[str, Any],
    config: Reconstruct,
) -> None:
    """Write a file of the format ``output``: a table or CityJSON."""
    if output in ("cityjson", "cityjsonseq"):
        files.write_text(
            path, city_json(results, crs, output, facts, config.lods, config.attribute_names, plants)
        )
        return
    rows, before = table(results, crs, facts, config.attribute_names), input_footprints(results, crs)
    if output == "gpkg":
        gpkg.write(
            path, rows, facts, more={} if before is None else {"input_footprints": before}, style=gpkg.STYLE
        )
        return
    frame = rows.to_frame()
    if before is not None:
        frame["input_geometry"] = before.to_frame().geometry
    files.write_geoparquet(path, frame, facts)


def write_meshes(
    folder: Path,
    stem: str,
    output: Output,
    meshes: Sequence[Body],
    frame: Frame,
    config: Reconstruct,
    facts: Mapping[str, Any],
) -> list[Path]:
    """Write the files of an output that consists of meshes. Returns their paths."""
    options = FileOptions(stem, facts, config.frequency_ghz, config.split_materials, config.map_cell_m)
    contents = MESH_WRITERS[output](meshes, frame, options)
    for name, content in contents.items():
        files.write_bytes(folder / name, content)
    return [folder / name for name in contents]


def with_terrain(
    buildings: Sequence[Body], terrain: Terrain, config: Reconstruct
) -> tuple[Sequence[Body], Body]:
    """(the buildings, lowered into the terrain; the mesh of the terrain around them). Raises :class:`InputError` if the
    terrain has no height there."""
    corners = np.concatenate([building.mesh.vertex_m for building in buildings])
    low, high = corners.min(axis=0), corners.max(axis=0)
    bounds = grown((low[0], low[1], high[0], high[1]), config.terrain_margin_m)
    around = terrain_mesh.window(terrain, bounds)
    ground = terrain_mesh.block(around, config.terrain_tolerance_m, low[2])
    ground = replace(ground, buildings=(BuildingRef(ground.name, {"terrain": config.materials.ground}),))
    return terrain_mesh.lowered_into(buildings, around, config.terrain_tolerance_m), ground


def _is_cut(config: Reconstruct, has_terrain: bool) -> bool:
    """Whether skins end on the terrain. Then no single mesh is closed, but all of them together are."""
    return config.skin and has_terrain and config.skin_terrain == "cut"


def check_coverage(terrain: Terrain, name: Path, features: Features) -> None:
    """Raise :class:`InputError` if the terrain has no height at any of the footprints."""
    heights_m = terrain.interpolated(features["centre_x_m"], features["centre_y_m"])
    if len(features) and not np.isfinite(heights_m).any():
        raise InputError(f"{name}: has no height at any of the {len(features)} footprints")


def notes(config: Reconstruct, features: Features, has_terrain: bool) -> list[str]:
    """Notes for the user on the outputs, before the run. features: cleaned footprints with the input's columns."""
    result = []
    if _is_cut(config, has_terrain) and any(name in MESH_WRITERS for name in config.outputs):
        text = "skins and terrain are closed together, and no single mesh is (reconstruct.skin_terrain: overlap is)"
        result.append(text)
    if "sionna" not in config.outputs:
        return result
    rows = [surface_materials(columns, config) for columns in input_columns(features)]
    materials = [row["wall"] for row in rows]
    if config.split_materials:
        materials += [row["roof"] for row in rows]
    if has_terrain:
        materials.append(config.materials.ground)
    if config.vegetation:
        materials.append(config.materials.vegetation)
    is_mixed = any(row["wall"] != row["roof"] for row in rows)
    return result + sionna.notes(
        materials, config.frequency_ghz, has_terrain, is_mixed, config.split_materials
    )


def counts(results: Sequence[Result]) -> dict[str, Any]:
    """Numbers of buildings by status, reason and method, and the ids of buildings to check (``to_check``), the worst
    first: buildings without a mesh, with a flat roof instead, far from their points, of which less than half is seen,
    or with a footprint that the points contradict or do not cover."""
    status, reasons, methods, doubts = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
    not_representable = without_points = triangles = 0
    to_check: list[tuple[bool, float, str]] = []
    for result in results:
        why = [*result.flags]
        if result.status != "ok" and result.reason not in (HAS_PARTS, DUPLICATE):
            why.append(str(result.reason))
        if result.not_representable:
            why.append("not-representable")
        elif result.status == "ok" and not why and not result.is_reliable:
            why.append("mostly-unseen")
        if why:
            doubts.update(why)
            row = result.reconstruction
            to_check.append((row.has_mesh, -np.nan_to_num(result.residual_m), row.building_id))
        status[result.status] += 1
        reasons.update(filter(None, [result.reason]))
        methods.update([result.reconstruction.method] if result.reconstruction.has_mesh else [])
        not_representable += result.not_representable
        # only buildings that lack nothing but points; others without points lack a geometry, for instance
        without_points += result.num_points == 0 and result.reason in UNSEEN
        triangles += result.reconstruction.num_triangles
    return {
        "total": len(results),
        "status": dict(status),
        "reasons": dict(reasons),
        "methods": dict(methods),
        "not_representable": not_representable,
        "without_points": without_points,
        "triangles": triangles,
        "doubts": dict(doubts.most_common()),
        "to_check": [building_id for *_, building_id in sorted(to_check)],
    }


def mesh(result: Result, config: Reconstruct) -> Body:
    """The building's mesh in the CRS of the cloud, with the materials of its footprint or of ``config``."""
    row = result.reconstruction
    materials = surface_materials(result.columns, config)
    return Body.of_building(row.building_id, row.placed_mesh, materials)


def kept(results: Sequence[Result], config: Reconstruct) -> Sequence[Result]:
    """The results with only those columns of their footprints that ``config.keep_columns`` names."""
    return Lazy(lambda result: with_columns(result, config.keep_columns), results)


def surface_materials(columns: Mapping[str, Any], config: Reconstruct) -> dict[str, str]:
    """The material of walls, roof, floor (``ground``) and open ground (``outer_floor``) of a building whose footprint
    has these input columns."""
    stated = materials_of(columns) if config.materials.from_footprints else {}
    wall = stated.get("wall", config.materials.wall)
    return {
        "wall": wall,
        "roof": stated.get("roof", config.materials.roof),
        "ground": wall,
        "outer_floor": config.materials.ground,
    }
