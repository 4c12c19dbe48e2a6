"""Meshes as a binary glTF 2.0 file: metres, y up as glTF prescribes, origin in the extras of the asset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual.material import PBRMaterial

from p2wss.formats.meshes import TERRAIN, Frame, Mesh

_COLORS = {"building": [205, 196, 182, 255], "terrain": [146, 158, 122, 255]}


def glb(meshes: Sequence[Mesh], frame: Frame, facts: dict[str, Any]) -> bytes:
    """Bytes of a GLB with one node per mesh.

    A point (x, y, z) of the CRS has the coordinates (x - x0, z - z0, y0 - y) in the file, with
    ``frame.origin_m`` = (x0, y0, z0). The extras of the asset document this, and hold ``facts`` under ``p2wss``.
    """
    scene = trimesh.Scene()
    materials = {
        name: PBRMaterial(name=name, baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.9)
        for name, color in _COLORS.items()
    }
    for mesh in meshes:
        local = np.asarray(mesh.vertex_m, float) - frame.origin_m
        up = np.column_stack([local[:, 0], local[:, 2], -local[:, 1]])
        material = materials["terrain" if TERRAIN in mesh.kind else "building"]
        visual = trimesh.visual.TextureVisuals(material=material)
        shape = trimesh.Trimesh(up, mesh.triangle, visual=visual, process=False)
        scene.add_geometry(shape, node_name=mesh.name, geom_name=mesh.name)

    def with_extras(tree: dict[str, Any]) -> None:
        tree["asset"]["extras"] = {
            "p2wss": facts,
            "crs": frame.crs,
            "origin_m": [float(value) for value in frame.origin_m],
            "axes": "x = easting - origin_m[0], y = height - origin_m[2], z = origin_m[1] - northing; metres",
        }

    return export_glb(scene, tree_postprocessor=with_extras)
