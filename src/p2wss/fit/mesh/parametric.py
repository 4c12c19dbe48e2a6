"""Meshes of parametric buildings: prepares footprints and angles for the kernel, and calls it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from p2wss import skeleton
from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.fit.directions import edge_ends
from p2wss.mesh import Mesh
from p2wss.mesh.planar import with_exact_faces
from p2wss.skeleton.types import Meshes, Polygons


def simplify_exterior(rings: Sequence[np.ndarray], max_num_vertices: int) -> list[np.ndarray]:
    """The rings with at most ``max_num_vertices`` vertices in the exterior, by the Douglas-Peucker algorithm with a
    growing tolerance.

    Courtyards stay as they are. An exterior that keeps more vertices at any tolerance becomes its smallest enclosing
    rectangle.
    """
    exterior = shapely.Polygon(rings[0])
    simple: Any = exterior
    tolerance = 0.05
    size = float(np.hypot(*np.subtract(exterior.bounds[2:], exterior.bounds[:2])))
    while _num_vertices(simple) > max_num_vertices and tolerance < size:
        simple = exterior.simplify(tolerance, preserve_topology=True)
        tolerance *= 1.25
    if _num_vertices(simple) > max_num_vertices:
        simple = exterior.minimum_rotated_rectangle
    if simple is exterior:
        return list(rings)
    exterior = shapely.orient_polygons(simple, exterior_cw=False).exterior
    return [shapely.get_coordinates(exterior)[:-1], *rings[1:]]


def kernel_angles(angle_deg: np.ndarray) -> np.ndarray:
    """The nearest angles that the kernel takes: 0, 90, or 5 to 85 degrees.

    >>> kernel_angles(np.array([2.0, 4.0, 35.0, 86.0, 99.0]))
    array([ 0.,  5., 35., 85., 90.])
    """
    angle = np.clip(np.asarray(angle_deg, float), 0, 90)
    lowest, steepest = 5.0, 85.0
    angle = np.where(angle < lowest / 2, 0.0, np.where(angle < lowest, lowest, angle))
    return np.where(angle > (steepest + 90) / 2, 90.0, np.where(angle > steepest, steepest, angle))


def transfer_angles(
    source_rings: Sequence[np.ndarray], angle_deg: np.ndarray, target_rings: Sequence[np.ndarray]
) -> np.ndarray:
    """Angles (a value or a row per edge) of ``source_rings`` for the edges of ``target_rings``, which describe the same
    building with more or fewer vertices.

    Each target edge takes the angle of the source edge nearest to its midpoint among those that face within 45
    degrees of its direction or, if there is none, among all.
    """
    if len(source_rings) == len(target_rings) and all(map(np.array_equal, source_rings, target_rings)):
        return np.asarray(angle_deg, float)
    start, end = np.moveaxis(edge_ends(source_rings), 1, 0)
    target_start, target_end = np.moveaxis(edge_ends(target_rings), 1, 0)
    midpoint = (target_start + target_end) / 2
    along = end - start
    length = np.linalg.norm(along, axis=1)
    share = np.einsum("wkd,kd->wk", midpoint[:, None] - start, along) / length**2
    foot = start + np.clip(share, 0, 1)[..., None] * along
    distance = np.linalg.norm(midpoint[:, None] - foot, axis=2)
    direction = target_end - target_start
    cosine = (direction @ along.T) / (np.linalg.norm(direction, axis=1)[:, None] * length)
    facing = cosine >= np.sqrt(0.5)
    cost = np.where(facing, distance, distance + distance.max(initial=0) + 1)
    return np.asarray(angle_deg, float)[cost.argmin(axis=1)]


def build_meshes(
    buildings: Sequence[Building],
    rings: Sequence[Sequence[np.ndarray]],
    eave_height_m: np.ndarray,
    angle_deg: Sequence[np.ndarray],
    method: str,
    config: Reconstruct,
    status: Sequence[str],
) -> list[Reconstruction]:
    """Meshes through the kernel, which checks each. A building without a finite height has none.

    rings, eave_height_m (b,), angle_deg: one per building. status: why a building without a height has no mesh.
    """
    result = [no_mesh(b, method, reason) for b, reason in zip(buildings, status, strict=True)]
    ground_z_m = [building.ground_z_m for building in buildings]
    usable = np.flatnonzero(np.isfinite(eave_height_m) & np.isfinite(ground_z_m)).tolist()
    if not usable:
        return result
    meshes: Meshes = skeleton.build(
        Polygons.from_rings([list(rings[i]) for i in usable]),
        np.concatenate([angle_deg[i] for i in usable]),
        eave_height_m[usable],
        max_roof_height_m=config.max_roof_height_m,
    )
    for k, i in enumerate(usable):
        code = skeleton.Status(int(meshes.status[k]))
        result[i] = Reconstruction(
            buildings[i].building_id,
            buildings[i].tile,
            method,
            reasons.OK if code == skeleton.Status.OK else code.reason,
            buildings[i].origin_xy_m,
            buildings[i].ground_z_m,
            rings[i],
            float(eave_height_m[i]),
            angle_deg[i],
            with_exact_faces(Mesh.of_kernel(meshes, k)) if code == skeleton.Status.OK else None,
        )
    return result


def kernel_mesh(
    rings: Sequence[np.ndarray], angle_deg: np.ndarray, eave_height_m: float, max_roof_height_m: float
) -> Mesh | None:
    """The kernel's building over a polygon; None if the kernel refuses it."""
    polygons = Polygons.from_rings([list(rings)])
    meshes = skeleton.build(
        polygons, angle_deg, np.array([eave_height_m]), max_roof_height_m=max_roof_height_m
    )
    return with_exact_faces(Mesh.of_kernel(meshes, 0)) if meshes.status[0] == skeleton.Status.OK else None


def _num_vertices(polygon: shapely.Polygon) -> int:
    return len(polygon.exterior.coords) - 1
