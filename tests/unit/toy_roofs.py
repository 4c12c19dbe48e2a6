"""Points on roofs with known parameters."""

import numpy as np
import shapely

from p2wss.skeleton import Polygons
from p2wss.skeleton import roof_points as roof


def sample(rings, angle_deg, eave_z_m, num_points, noise_m=0.0, top_m=np.inf, seed=0):
    """Points on the roof, from the kernel's exact queries."""
    rng = np.random.default_rng(seed)
    polygon = shapely.Polygon(rings[0], rings[1:])
    xy = rng.uniform(polygon.bounds[:2], polygon.bounds[2:], (num_points * 4, 2))
    xy = xy[shapely.contains_xy(polygon, xy[:, 0], xy[:, 1])][:num_points]
    z = roof(
        Polygons.from_rings([list(rings)]), np.asarray(angle_deg, float), eave_z_m, xy,
        np.zeros(len(xy), int), max_roof_height_m=top_m,
    ).z_m  # fmt: skip
    return np.column_stack([xy, z + noise_m * rng.standard_normal(len(xy))])
