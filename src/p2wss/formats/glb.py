"""Meshes as one binary glTF 2.0 file: metres, y up as glTF prescribes, origin in the asset's extras."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual.material import PBRMaterial


def glb(
    meshes: Iterable[tuple[str, np.ndarray, np.ndarray]],
    origin_m: np.ndarray,
    crs: str | None,
    facts: dict[str, Any],
) -> bytes:
    """Bytes of a GLB with one node per mesh (name, vertices (v, 3) in the CRS, triangles (t, 3)).

    A point (x, y, z) of the CRS has the coordinates (x - x0, z - z0, y0 - y) in the file, with ``origin_m`` =
    (x0, y0, z0). The extras of the asset say so, and hold ``facts`` under ``p2wss``.
    """
    scene = trimesh.Scene()
    material = PBRMaterial(
        name="building", baseColorFactor=[205, 196, 182, 255], metallicFactor=0.0, roughnessFactor=0.9
    )
    for name, vertex_m, triangle in meshes:
        local = np.asarray(vertex_m, float) - origin_m
        up = np.column_stack([local[:, 0], local[:, 2], -local[:, 1]])
        visual = trimesh.visual.TextureVisuals(material=material)
        scene.add_geometry(
            trimesh.Trimesh(up, triangle, visual=visual, process=False), node_name=name, geom_name=name
        )

    def with_extras(tree: dict[str, Any]) -> None:
        tree["asset"]["extras"] = {
            "p2wss": facts,
            "crs": crs,
            "origin_m": [float(value) for value in origin_m],
            "axes": "x = easting - origin_m[0], y = height - origin_m[2], z = origin_m[1] - northing; metres",
        }

    return export_glb(scene, tree_postprocessor=with_extras)
