"""The folder for HELIOS++, read back as its loaders do."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh

from p2wss import skeleton
from p2wss.data.terrain import Terrain
from p2wss.formats import helios
from p2wss.formats.meshes import VEGETATION, Body, frame_around
from p2wss.mesh import Mesh
from p2wss.reconstruction.skin import terrain_mesh
from p2wss.skeleton.types import Polygons

X, Y = 84805.0, 447472.0


def bodies() -> list[Body]:
    """A gable house of brick with tiles, a tree and the terrain."""
    ring = np.array([[0, 0], [10, 0], [10, 8], [0, 8]], float)
    built = skeleton.build(Polygons.from_rings([[ring]]), np.array([35.0, 90, 35, 90]), np.array([5.0]))
    house = Mesh.of_kernel(built, 0).translated([X + 10, Y + 10, 2])
    ball = trimesh.creation.icosphere(1, 3.0)
    kind = np.full(len(ball.faces), VEGETATION, np.uint8)
    tree = Mesh(
        ball.vertices + np.array([X + 30, Y + 15, 8]), ball.faces.astype(np.int32), kind, np.arange(len(kind))
    )
    heights = 2 + 0.05 * np.arange(60, dtype=np.float32)[None] + np.zeros((40, 1), np.float32)
    land = Terrain(heights, X, Y + 40, 1.0)
    return [
        Body.of_building("Dé l'Eau 1", house, {"wall": "brick", "roof": "tile", "ground": "glass"}),
        Body.of_building("tree-1", tree),
        terrain_mesh.block(terrain_mesh.window(land, (X + 4, Y + 4, X + 50, Y + 30)), 0.1),
    ]


def read_mtl(path: Path) -> dict[str, dict[str, str]]:
    """Keys and values of each material."""
    result: dict[str, dict[str, str]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition(" ")
        if key == "newmtl":
            material = result.setdefault(value, {})
        elif key != "#":
            material[key] = value
    return result


def test_a_part_per_mesh_with_the_class_of_its_points(tmp_path: Path) -> None:
    meshes = bodies()
    frame = frame_around(meshes, "EPSG:28992")
    files = helios.scene_files(meshes, frame)
    assert list(files)[-1] == "scene.xml"
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    document = ElementTree.parse(tmp_path / "scene.xml").getroot()
    (scene,) = document.findall("scene")
    assert document.tag == "document" and scene.get("id") == "scene"
    classes = []
    for number, (part, body) in enumerate(zip(scene.findall("part"), meshes, strict=True), 1):
        (loader,) = part.findall("filter")
        given = {param.get("key"): param.get("value") for param in loader.findall("param")}
        assert part.get("id") == str(number) and loader.get("type") == "objloader" and given["up"] == "z"
        path = tmp_path / str(given["filepath"])
        loaded = trimesh.load(path, force="mesh", skip_materials=True)
        loaded.merge_vertices()
        assert loaded.is_watertight and len(loaded.faces) == len(body.mesh.triangle)
        assert np.isclose(loaded.volume, body.mesh.volume_m3, rtol=1e-3)
        low_m = body.mesh.vertex_m.min(axis=0) - frame.origin_m
        assert np.abs(loaded.bounds[0] - low_m).max() < 1e-4
        rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
        (library,) = [row[1] for row in rows if row[0] == "mtllib"]
        materials = read_mtl(path.parent / library)
        assert {row[1] for row in rows if row[0] == "usemtl"} == set(materials)
        classes.append({name: int(each["helios_classification"]) for name, each in materials.items()})
        spectra = {name: each.get("helios_spectra") for name, each in materials.items()}
        ground = {each["helios_isGround"] for each in materials.values()}
        assert ground == {"true" if body.is_terrain else "false"}
        if number == 1:
            assert spectra == {"brick": "shingle_red", "tile": "shingle_red", "glass": None}
    assert classes == [{"brick": 6, "tile": 6, "glass": 6}, {"wood": 5}, {"medium_dry_ground": 2}]
