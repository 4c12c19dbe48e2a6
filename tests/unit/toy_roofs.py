"""Points on roofs with known parameters."""

import numpy as np
import shapely

from p2wss.mesh import Mesh
from p2wss.skeleton import FaceKind, Polygons
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


def bent_ridge(plan):
    """A gable roof over a rectangle of 12 by 8 m whose slopes have a bent border: 3 cm beside their ridge, one of them
    is 15 mm higher."""
    vertex_m = [(*xy, z) for z in (0.0, 5.0) for xy in plan.tolist()]
    vertex_m += [(6, 0, 6.5), (6, 8, 6.5), (6.03, 4, 6.5075), (6.03, 4, 6.4925)]
    faces = [
        (FaceKind.GROUND, (0, 2, 1), (0, 3, 2)),
        (FaceKind.WALL, (0, 1, 5), (0, 5, 8), (0, 8, 4)),
        (FaceKind.WALL, (2, 3, 7), (2, 7, 9), (2, 9, 6)),
        (FaceKind.WALL, (0, 4, 7), (0, 7, 3)),
        (FaceKind.WALL, (1, 2, 6), (1, 6, 5)),
        (FaceKind.WALL, (8, 11, 10)),
        (FaceKind.WALL, (9, 10, 11)),
        (FaceKind.ROOF, (4, 8, 10), (4, 10, 7), (7, 10, 9)),
        (FaceKind.ROOF, (5, 6, 11), (6, 9, 11), (8, 5, 11)),
    ]
    rows = [(kind, label, each) for label, (kind, *face) in enumerate(faces) for each in face]
    kind, label, triangle = zip(*rows, strict=True)
    return Mesh(np.array(vertex_m), np.array(triangle, np.int32), np.array(kind, np.uint8), np.array(label))
