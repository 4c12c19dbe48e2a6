"""The mesh formats: for each, a function from bodies to the content of its files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from p2wss.formats import helios
from p2wss.formats.glb import glb
from p2wss.formats.meshes import Body, Frame, mtl, obj, ply, stl
from p2wss.formats.sionna import scene_files


@dataclass(frozen=True)
class FileOptions:
    """What a writer needs besides bodies and frame. stem: the stem of the file names. facts: the provenance. The other
    fields are settings of the section ``reconstruct``."""

    stem: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    frequency_ghz: float = 3.5
    split_materials: bool = False
    map_cell_m: float = 2.0


def _library(stem: str) -> str:
    """The name of the file of materials beside an OBJ file, without blanks: in an OBJ file, a blank separates names."""
    return f"{'_'.join(stem.split())}.mtl"


# A writer returns the contents of files by their names, which are relative to the folder of the output and have "/".
# They are written in this order: the file that a reader opens comes last, after the files that it names
Writer = Callable[[Sequence[Body], Frame, FileOptions], dict[str, bytes]]

# one entry per mesh format of ``reconstruct.outputs``
MESH_WRITERS: dict[str, Writer] = {
    "glb": lambda bodies, frame, options: {f"{options.stem}.glb": glb(bodies, frame, dict(options.facts))},
    "obj": lambda bodies, frame, options: {
        _library(options.stem): mtl(bodies),
        f"{options.stem}.obj": obj(bodies, frame, _library(options.stem)),
    },
    "ply": lambda bodies, frame, options: {f"{options.stem}.ply": ply(bodies, frame)},
    "stl": lambda bodies, frame, options: {f"{options.stem}.stl": stl(bodies, frame)},
    "sionna": lambda bodies, frame, options: {
        f"{options.stem}_sionna/{name}": content
        for name, content in scene_files(
            bodies,
            frame,
            options.facts,
            options.frequency_ghz,
            options.split_materials,
            options.map_cell_m,
        ).items()
    },
    "helios": lambda bodies, frame, options: {
        f"{options.stem}_helios/{name}": content
        for name, content in helios.scene_files(bodies, frame).items()
    },
}
# formats of which `--per-building` writes a file per mesh
SINGLE_FILES = ("glb", "obj", "ply", "stl")
