"""Run by an interpreter that has Sionna RT: load a scene, look for back faces from outside, trace paths.

    python sionna_tracing.py STEM_sionna

Prints one line of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from sionna import rt

NUM_RAYS, NUM_ABOVE, NUM_BELOW = 200_000, 16, 32


def back_faces(scene: rt.Scene, direction: np.ndarray, aim_m: np.ndarray) -> tuple[int, int]:
    """How many of the rays from 300 m before the points ``aim_m`` meet a face, and how many meet one from behind.

    In single precision, a ray within some 10 micrometres of an edge may pass between its two faces. What is met from
    behind is so by a ray 1 mm beside it, too.
    """
    num_hits, behind = meets(scene, direction, aim_m)
    aside_m = np.cross(direction[behind], [1.0, 0.0, 0.0])
    aside_m *= 1e-3 / np.linalg.norm(aside_m, axis=1, keepdims=True)
    return num_hits, len(meets(scene, direction[behind], aim_m[behind] + aside_m)[1])


def meets(scene: rt.Scene, direction: np.ndarray, aim_m: np.ndarray) -> tuple[int, np.ndarray]:
    """How many of the rays meet a face, and the numbers of those that meet one from behind."""
    if not len(aim_m):
        return 0, np.zeros(0, int)
    ray = mi.Ray3f(
        mi.Point3f((aim_m - 300 * direction).T.astype(np.float32)),
        mi.Vector3f(direction.T.astype(np.float32)),
    )
    hit = scene.mi_scene.ray_intersect(ray)
    is_hit = np.array(hit.is_valid())
    # n is the normal of the face as its vertices are ordered
    return int(is_hit.sum()), np.flatnonzero(is_hit & (np.array(dr.dot(hit.n, ray.d)) > 1e-6))


def traced(folder: Path) -> dict[str, Any]:
    start = time.perf_counter()
    scene = rt.load_scene(str(folder / "scene.xml"), merge_shapes=False)
    load_s = time.perf_counter() - start
    # materials are evaluated, or refused, at the frequency
    scene.frequency = 1e9 * json.loads((folder / "scene.json").read_text())["frequency_ghz"]
    bounds = scene.mi_scene.bbox()
    low, high = np.array(bounds.min).ravel(), np.array(bounds.max).ravel()
    draw = np.random.default_rng(0)
    aim_m = draw.uniform(low, high, (NUM_RAYS, 3))
    slanted = draw.normal(size=(NUM_RAYS, 3))
    slanted[:, 2] = -np.abs(slanted[:, 2]) - 0.2
    slanted /= np.linalg.norm(slanted, axis=1)[:, None]
    down_hits, down_back = back_faces(scene, np.tile([0.0, 0.0, -1.0], (NUM_RAYS, 1)), aim_m)
    slanted_hits, slanted_back = back_faces(scene, slanted, aim_m)

    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.rx_array = scene.tx_array
    middle = (low + high) / 2
    scene.add(rt.Transmitter("tx", position=[float(middle[0]), float(middle[1]), float(high[2]) + 10]))
    # receivers above the roofs, and some between the houses or in them
    angle = np.arange(NUM_ABOVE) * 2 * np.pi / NUM_ABOVE
    ring = middle[:2] + 0.3 * (high - low)[:2] * np.column_stack([np.cos(angle), np.sin(angle)])
    above = np.column_stack([ring, np.full(NUM_ABOVE, high[2] + 3)])
    below = draw.uniform(low + 0.15 * (high - low), high - 0.15 * (high - low), (NUM_BELOW, 3))
    below[:, 2] = low[2] + 5.5
    for number, position in enumerate(np.concatenate([above, below]).tolist()):
        scene.add(rt.Receiver(f"rx-{number}", position=position))
    start = time.perf_counter()
    paths = rt.PathSolver()(scene, max_depth=1, refraction=False, diffraction=True)
    path_s = time.perf_counter() - start
    valid = np.array(paths.valid)
    # (depth, receiver, transmitter, path)
    interaction = np.array(paths.interactions)[0]
    reflected = valid & (interaction == rt.InteractionType.SPECULAR)
    diffracted = valid & (interaction == rt.InteractionType.DIFFRACTION)
    # every cell of the map's surface is a triangle
    surface = mi.load_dict(
        {
            "type": "ply",
            "filename": str(folder / "terrain_top.ply"),
            "to_world": mi.ScalarTransform4f().translate([0, 0, 1.5]),
        }
    )
    start = time.perf_counter()
    gain = np.array(
        rt.RadioMapSolver()(scene, measurement_surface=surface, max_depth=3, samples_per_tx=10**6).path_gain
    )
    return {
        "variant": mi.variant(),
        "load_s": round(load_s, 2),
        "shapes": sorted(scene.objects),
        "materials": sorted(scene.radio_materials),
        "down": [down_hits, down_back],
        "slanted": [slanted_hits, slanted_back],
        "paths": int(valid.sum()),
        "reflected": int(reflected.sum()),
        "diffracted": int(diffracted.sum()),
        "path_s": round(path_s, 2),
        "cells": int(gain.size),
        "lit_cells": int((gain > 0).sum()),
        "map_s": round(time.perf_counter() - start, 2),
    }


if __name__ == "__main__":
    print(json.dumps(traced(Path(sys.argv[1]))))
