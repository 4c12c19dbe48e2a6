"""Displaced footprints for simulated crops, which imitate errors of maps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from p2wss.data import polygon_arrays
from p2wss.data.seeds import generator
from p2wss.footprints.coverage import block_numbers
from p2wss.skeleton.types import Polygons

_TOUCHING_M = 0.01


def with_errors(
    polygons: Polygons, names: Sequence[str], error_m: tuple[float, float], seed: int
) -> Polygons:
    """The polygons with a shift per block and noise per vertex, normal along either axis.

    names: of the polygons. error_m: standard deviations of the shift and of the noise. Footprints that touch shift
    alike, and a vertex that several share moves alike in all of them: the draws depend on the first name of the block
    and on the place of the vertex. A polygon that would then cross itself has the shift alone. Numbers of edges, their
    order and their angles stay those of the labels.
    """
    shift_m, noise_m = error_m
    if not (shift_m or noise_m) or not len(polygons.xy_m):
        return polygons
    num_vertices = np.diff(polygons.vertex_offset)
    of_polygon = block_numbers(polygon_arrays.to_geometries(polygons), _TOUCHING_M)
    first: dict[int, str] = {}
    for block, name in zip(of_polygon.tolist(), map(str, names), strict=True):
        first[block] = min(name, first.get(block, name))
    shifts = {
        block: generator(seed, "footprint-shift", name).normal(0, shift_m, 2) for block, name in first.items()
    }
    shifted = polygons.xy_m + np.repeat([shifts[b] for b in of_polygon.tolist()], num_vertices, axis=0)
    place, node = np.unique(np.round(1000 * polygons.xy_m).astype(np.int64), axis=0, return_inverse=True)
    draws = [generator(seed, "footprint-vertex", x, y).normal(0, noise_m, 2) for x, y in place.tolist()]
    noisy = Polygons(shifted + np.array(draws)[node.ravel()], polygons.ring_offset, polygons.polygon_offset)
    is_valid = np.repeat(shapely.is_valid(polygon_arrays.to_geometries(noisy)), num_vertices)
    xy_m = np.where(is_valid[:, None], noisy.xy_m, shifted)
    return Polygons(xy_m, polygons.ring_offset, polygons.polygon_offset)
