"""The mesh formats: for each, a function from meshes to the content of its files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from p2wss.formats.glb import glb
from p2wss.formats.meshes import Frame, Mesh, mtl, obj, ply, stl
from p2wss.formats.sionna import scene_files
from p2wss.formats.tiles3d import tileset_files


@dataclass(frozen=True)
class FileOptions:
    """What a writer needs besides meshes and frame. stem: of the names of the files. facts: provenance. The others are
    settings of the section ``reconstruct``."""

    stem: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    frequency_ghz: float = 3.5
    split_materials: bool = False
    map_cell_m: float = 2.0


# contents by the names of the files, relative to the folder of the output and with "/", in the order of writing: the
# file that a reader opens comes last, when those that it names exist
Writer = Callable[[Sequence[Mesh], Frame, FileOptions], dict[str, bytes]]

# one entry per mesh format of ``reconstruct.outputs``
MESH_WRITERS: dict[str, Writer] = {
    "glb": lambda meshes, frame, options: {f"{options.stem}.glb": glb(meshes, frame, dict(options.facts))},
    "obj": lambda meshes, frame, options: {
        f"{options.stem}.mtl": mtl(meshes),
        f"{options.stem}.obj": obj(meshes, frame, f"{options.stem}.mtl"),
    },
    "ply": lambda meshes, frame, options: {f"{options.stem}.ply": ply(meshes, frame)},
    "stl": lambda meshes, frame, options: {f"{options.stem}.stl": stl(meshes, frame)},
    "sionna": lambda meshes, frame, options: {
        f"{options.stem}_sionna/{name}": content
        for name, content in scene_files(
            meshes,
            frame,
            options.facts,
            options.frequency_ghz,
            options.split_materials,
            options.map_cell_m,
        ).items()
    },
    "3dtiles": lambda meshes, frame, options: {
        f"{options.stem}_3dtiles/{name}": content
        for name, content in tileset_files(meshes, frame, options.facts).items()
    },
}
# those that `--per-building` writes a file of per mesh
SINGLE_FILES = ("glb", "obj", "ply", "stl")
