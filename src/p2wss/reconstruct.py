"""From points and footprints to closed buildings: by the network, flat, or with constant values.

Everything here works on buildings in memory. The evaluation and ``p2wss reconstruct`` share it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import shapely

from p2wss import footprints, skeleton
from p2wss.config import Reconstruct
from p2wss.skeleton.types import Meshes, Polygons

BUILDING_CLASS = 6
GROUND_CLASS = 2


@dataclass(frozen=True)
class Building:
    """What is known of one building before its reconstruction.

    rings: footprint, each (n, 2), exterior first and counter-clockwise, courtyards clockwise, relative to
    ``origin_xy_m``. point_m: (m, 3), x and y relative to the origin, z in the height system of the cloud.
    classification: uint8 (m,). ground_z_m: z of the ground at the building, NaN if unknown.
    """

    building_id: str
    tile: str
    origin_xy_m: tuple[float, float]
    rings: Sequence[np.ndarray]
    point_m: np.ndarray
    classification: np.ndarray
    ground_z_m: float

    @property
    def polygon(self) -> shapely.Polygon:
        return shapely.Polygon(self.rings[0], self.rings[1:])


@dataclass(frozen=True)
class Reconstruction:
    """One row of ``io.RECONSTRUCTIONS``: what a method made of a building. Without a mesh, ``triangle`` is
    (0, 3) and ``status`` says why. Mesh: x and y relative to ``origin_xy_m``, z above ``ground_z_m``."""

    building_id: str
    tile: str
    method: str
    status: str
    origin_xy_m: tuple[float, float]
    ground_z_m: float
    rings: Sequence[np.ndarray]
    eave_height_m: float | None
    angle_deg: np.ndarray | None
    confidence: float | None
    vertex_m: np.ndarray
    triangle: np.ndarray
    kind: np.ndarray
    edge: np.ndarray

    @property
    def has_mesh(self) -> bool:
        return len(self.triangle) > 0


@dataclass(frozen=True)
class Parameters:
    """Decoded parameters of a batch of buildings: heights above ground (b,), an array of angles per building
    with a value per edge over all rings, confidence (b,) from 0 to 1."""

    eave_height_m: np.ndarray
    angle_deg: Sequence[np.ndarray]
    confidence: np.ndarray


class Predictor(Protocol):
    """The part of the network that reconstruction needs; ``p2wss.model`` has the real one."""

    @property
    def max_num_vertices(self) -> int:
        """Largest number of footprint vertices, all rings together, that :meth:`predict` takes."""
        ...

    def predict(self, points_m: Sequence[np.ndarray], rings: Sequence[Sequence[np.ndarray]]) -> Parameters:
        """Heights, angles and confidence. Points (n, 3) with z above the estimated ground, rings as in
        :class:`Building`."""
        ...


def reconstruct(
    buildings: Sequence[Building], predictor: Predictor, config: Reconstruct, method: str = "point2wss"
) -> list[Reconstruction]:
    """One reconstruction per building with the network's height and angles, in the order given.

    A building with fewer than ``min_num_points`` points, or whose mesh the kernel rejects, has no mesh here
    and a status; :func:`with_fallback` gives it a flat roof.
    """
    meshed = [_mesh_footprint(building, config) for building in buildings]
    enough = [i for i, b in enumerate(buildings) if len(b.point_m) >= config.min_num_points]
    height = np.full(len(buildings), np.nan)
    confidence = np.full(len(buildings), np.nan)
    angle: list[np.ndarray] = [np.zeros(0)] * len(buildings)
    ground = [ground_z_m(building) for building in buildings]
    for start in range(0, len(enough), config.batch_size):
        batch = enough[start : start + config.batch_size]
        seen = [simplify_to(meshed[i], predictor.max_num_vertices) for i in batch]
        parameters = predictor.predict(
            [buildings[i].point_m - [0, 0, ground[i]] for i in batch], [_rings(p) for p in seen]
        )
        for k, i in enumerate(batch):
            height[i] = max(float(parameters.eave_height_m[k]), config.min_eave_height_m)
            confidence[i] = parameters.confidence[k]
            angle[i] = transfer_angles(_rings(seen[k]), parameters.angle_deg[k], _rings(meshed[i]))
    return _build(
        buildings,
        [_rings(polygon) for polygon in meshed],
        ground,
        height,
        angle,
        confidence,
        method,
        config,
        refused=f"fewer than {config.min_num_points} points",
    )


def with_fallback(
    reconstructions: Sequence[Reconstruction], buildings: Sequence[Building], config: Reconstruct
) -> list[Reconstruction]:
    """Flat roofs (method ``lod1``) for the buildings without a mesh that have any point; their status keeps
    the reason."""
    result = list(reconstructions)
    missing = [i for i, r in enumerate(result) if not r.has_mesh]
    for i, flat in zip(missing, lod1([buildings[i] for i in missing], config), strict=True):
        if flat.has_mesh:
            result[i] = replace(flat, status=result[i].status)
        elif not len(buildings[i].point_m):
            result[i] = replace(result[i], status=flat.status)
    return result


def lod1(buildings: Sequence[Building], config: Reconstruct) -> list[Reconstruction]:
    """Flat roofs at the median height of the points on each building (:func:`flat_height_m`)."""
    height = np.array([flat_height_m(building) for building in buildings])
    return constant(buildings, height, 0.0, config, "lod1", refused="no point above the ground")


def constant(
    buildings: Sequence[Building],
    eave_height_m: np.ndarray,
    angle_deg: float,
    config: Reconstruct,
    method: str = "constant",
    refused: str = "no height",
) -> list[Reconstruction]:
    """Buildings with given heights (b,), NaN for none, and the same angle at every edge."""
    rings = [_rings(_mesh_footprint(building, config)) for building in buildings]
    angle = [np.full(sum(map(len, r)), angle_deg) for r in rings]
    ground = [ground_z_m(building) for building in buildings]
    unknown = np.full(len(buildings), np.nan)
    return _build(
        buildings, rings, ground, np.asarray(eave_height_m, float), angle, unknown, method, config, refused
    )


def ground_z_m(building: Building) -> float:
    """The ground that the crop found, else the lowest percentile of the points; NaN without any."""
    if np.isfinite(building.ground_z_m):
        return float(building.ground_z_m)
    # without ground points the lowest hits are the foot of a wall, at best
    return float(np.quantile(building.point_m[:, 2], 0.01)) if len(building.point_m) else float("nan")


def flat_height_m(building: Building) -> float:
    """Median height above ground of the points inside the footprint: of class 6 if there is any, else of
    those that are not ground and at least 1 m above it. NaN if none is left."""
    if not len(building.point_m):
        return float("nan")
    x, y, z = building.point_m.T
    above = z - ground_z_m(building)
    inside = shapely.contains_xy(building.polygon, x, y)
    chosen = inside & (building.classification == BUILDING_CLASS)
    if not chosen.any():
        chosen = inside & (building.classification != GROUND_CLASS) & (above >= 1.0)
    return float(np.median(above[chosen])) if chosen.any() else float("nan")


def simplify_to(polygon: shapely.Polygon, max_num_vertices: int) -> shapely.Polygon:
    """The polygon with at most so many vertices over all rings, by Douglas-Peucker with a growing tolerance.

    Courtyards stay as long as there is room for them: triangles of all rings must fit, else the smallest
    courtyards are left out. What cannot be simplified further without losing its shape becomes its minimum
    rotated rectangle, or with room for three vertices only, a triangle of the hull.
    """
    holes = sorted(polygon.interiors, key=lambda ring: shapely.Polygon(ring).area, reverse=True)
    room = max(max_num_vertices - 4, 0) // 4
    polygon = shapely.Polygon(polygon.exterior, holes[:room])
    tolerance = 0.05
    simple = polygon
    size = float(np.hypot(*np.subtract(polygon.bounds[2:], polygon.bounds[:2])))
    while _num_vertices(simple) > max_num_vertices and tolerance < size:
        candidate = polygon.simplify(tolerance, preserve_topology=True)
        if isinstance(candidate, shapely.Polygon) and candidate.is_valid and not candidate.is_empty:
            simple = candidate
        tolerance *= 1.25
    if _num_vertices(simple) > max_num_vertices:
        box = polygon.minimum_rotated_rectangle
        simple = box if isinstance(box, shapely.Polygon) and max_num_vertices >= 4 else _triangle(polygon)
    return shapely.orient_polygons(simple, exterior_cw=False)


def transfer_angles(
    known: Sequence[np.ndarray], angle_deg: np.ndarray, wanted: Sequence[np.ndarray]
) -> np.ndarray:
    """Angles of the edges of ``known`` (rings, a value per edge) for the edges of ``wanted``: the same building
    with more or fewer vertices.

    Each edge takes the angle of the nearest edge (between their middles and the segment) that faces within 45
    degrees of its own direction; where none does, of the nearest one.
    """
    if len(known) == len(wanted) and all(map(np.array_equal, known, wanted)):
        return np.asarray(angle_deg, float)
    start, end = _edges(known)
    from_, to = _edges(wanted)
    middle = (from_ + to) / 2
    along = end - start
    length = np.linalg.norm(along, axis=1)
    share = np.einsum("wkd,kd->wk", middle[:, None] - start, along) / length**2
    foot = start + np.clip(share, 0, 1)[..., None] * along
    distance = np.linalg.norm(middle[:, None] - foot, axis=2)
    direction = to - from_
    cosine = (direction @ along.T) / (np.linalg.norm(direction, axis=1)[:, None] * length)
    facing = cosine >= np.sqrt(0.5)
    cost = np.where(facing, distance, distance + distance.max(initial=0) + 1)
    return np.asarray(angle_deg, float)[cost.argmin(axis=1)]


def columns(reconstructions: Sequence[Reconstruction], dataset: str | Sequence[str]) -> dict[str, Any]:
    """The columns of ``io.RECONSTRUCTIONS``."""
    rows = reconstructions
    names = [dataset] * len(rows) if isinstance(dataset, str) else list(dataset)
    return {
        "dataset": names,
        "building_id": [r.building_id for r in rows],
        "tile": [r.tile for r in rows],
        "method": [r.method for r in rows],
        "status": [r.status for r in rows],
        "origin_x_m": [r.origin_xy_m[0] for r in rows],
        "origin_y_m": [r.origin_xy_m[1] for r in rows],
        "ground_z_m": [r.ground_z_m for r in rows],
        **footprints.to_columns(Polygons.from_rings([list(r.rings) for r in rows]), np.zeros((len(rows), 2))),
        "eave_height_m": [r.eave_height_m for r in rows],
        "angle_deg": [r.angle_deg for r in rows],
        "confidence": [r.confidence for r in rows],
        "vertex_xyz_m": [r.vertex_m.ravel() for r in rows],
        "triangle": [r.triangle.ravel() for r in rows],
        "triangle_kind": [r.kind for r in rows],
        "triangle_edge": [r.edge for r in rows],
    }


def no_mesh(building: Building, method: str, status: str) -> Reconstruction:
    """The row of a building that a method could not reconstruct."""
    return Reconstruction(
        building.building_id,
        building.tile,
        method,
        status,
        building.origin_xy_m,
        ground_z_m(building),
        building.rings,
        None,
        None,
        None,
        np.zeros((0, 3)),
        np.zeros((0, 3), np.int32),
        np.zeros(0, np.uint8),
        np.zeros(0, np.int32),
    )


def _build(
    buildings: Sequence[Building],
    rings: Sequence[Sequence[np.ndarray]],
    ground: Sequence[float],
    eave_height_m: np.ndarray,
    angle_deg: Sequence[np.ndarray],
    confidence: np.ndarray,
    method: str,
    config: Reconstruct,
    refused: str,
) -> list[Reconstruction]:
    """Meshes through the kernel, which checks each; a building without a finite height is refused."""
    result = [no_mesh(b, method, refused if len(b.point_m) else "no point") for b in buildings]
    usable = np.flatnonzero(np.isfinite(eave_height_m) & np.isfinite(ground))
    if not len(usable):
        return result
    meshes: Meshes = skeleton.build(
        Polygons.from_rings([list(rings[i]) for i in usable]),
        np.concatenate([angle_deg[i] for i in usable]),
        eave_height_m[usable],
        max_roof_height_m=config.max_roof_height_m,
    )
    for k, i in enumerate(usable):
        status = skeleton.Status(int(meshes.status[k]))
        vertex, triangle, kind, edge = meshes.mesh(k)
        accepted = status == skeleton.Status.OK
        result[i] = Reconstruction(
            buildings[i].building_id,
            buildings[i].tile,
            method,
            "ok" if accepted else status.reason,
            buildings[i].origin_xy_m,
            ground[i],
            rings[i],
            float(eave_height_m[i]),
            angle_deg[i],
            float(confidence[i]) if np.isfinite(confidence[i]) else None,
            vertex,
            triangle,
            kind,
            edge,
        )
    return result


def _mesh_footprint(building: Building, config: Reconstruct) -> shapely.Polygon:
    polygon = building.polygon
    if config.simplify_m == 0:
        return polygon
    simple = polygon.simplify(config.simplify_m, preserve_topology=True)
    usable = isinstance(simple, shapely.Polygon) and simple.is_valid and simple.area > 0
    return shapely.orient_polygons(simple if usable else polygon, exterior_cw=False)


def _rings(polygon: shapely.Polygon) -> list[np.ndarray]:
    return [np.asarray(ring.coords)[:-1, :2] for ring in (polygon.exterior, *polygon.interiors)]


def _edges(rings: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate(list(rings)), np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])


def _num_vertices(polygon: shapely.Polygon) -> int:
    return shapely.get_num_coordinates(polygon) - 1 - len(polygon.interiors)


def _triangle(polygon: shapely.Polygon) -> shapely.Polygon:
    ring = np.asarray(polygon.convex_hull.exterior.coords)[:-1]
    far = ring[np.linalg.norm(ring - ring[0], axis=1).argmax()]
    side = far - ring[0]
    off = np.abs((ring - ring[0]) @ [-side[1], side[0]])
    return shapely.Polygon([ring[0], far, ring[off.argmax()]])
