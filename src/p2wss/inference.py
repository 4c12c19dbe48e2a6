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
NO_POINT = "no point"
# of the heights of a cloud without ground points: the foot of a wall, at best
GROUND_QUANTILE = 0.02


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
    (0, 3) and ``status`` says why. Mesh: x and y relative to ``origin_xy_m``, z above ``ground_z_m``.

    num_parts: with a height each. Of several, ``eave_height_m`` is that of the largest, ``angle_deg`` those of
    the parts along the footprint, and ``edge`` numbers the planes instead of the edges. class_probability: of a
    network, (edges, 3): that each edge has 0 degrees, 90 degrees or a slope."""

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
    num_parts: int = 1
    class_probability: np.ndarray | None = None

    @property
    def has_mesh(self) -> bool:
        return len(self.triangle) > 0


class Parameters(Protocol):
    """Decoded parameters of b buildings: heights above ground (b,), an array of angles per building with a
    value per edge over all rings, another (edges, 3) with the probabilities of 0 degrees, 90 degrees and a slope,
    confidence (b,) from 0 to 1. NaN: the network cannot take the footprint."""

    @property
    def eave_height_m(self) -> np.ndarray: ...

    @property
    def angle_deg(self) -> Sequence[np.ndarray]: ...

    @property
    def class_probability(self) -> Sequence[np.ndarray]: ...

    @property
    def confidence(self) -> np.ndarray: ...


class Predictor(Protocol):
    """The part of :class:`p2wss.model.Predictor` that reconstruction needs."""

    @property
    def max_num_vertices(self) -> int:
        """Largest number of vertices of an exterior ring."""
        ...

    def predict(self, points_m: Sequence[np.ndarray], rings: Sequence[Sequence[np.ndarray]]) -> Parameters:
        """From points (n, 3) with z above the estimated ground, and rings as in :class:`Building`."""
        ...


def reconstruct(
    buildings: Sequence[Building], predictor: Predictor, config: Reconstruct, method: str = "point2wss"
) -> list[Reconstruction]:
    """One reconstruction per building with the network's height and angles, in the order given.

    A building with fewer than ``min_num_points`` points, or whose mesh the kernel rejects, has no mesh here
    and a status; :func:`with_fallback` gives it a flat roof.
    """
    meshed = [mesh_footprint(building, config) for building in buildings]
    seen = [simplify_exterior(rings, predictor.max_num_vertices) for rings in meshed]
    ground = [ground_z_m(building) for building in buildings]
    height = np.full(len(buildings), np.nan)
    confidence = np.full(len(buildings), np.nan)
    angle = [np.zeros(sum(map(len, rings))) for rings in meshed]
    odds: list[np.ndarray | None] = [None] * len(buildings)
    refused = ["" if len(b.point_m) else NO_POINT for b in buildings]
    enough = []
    for i, building in enumerate(buildings):
        if len(building.point_m) >= config.min_num_points:
            enough.append(i)
        elif not refused[i]:
            refused[i] = f"fewer than {config.min_num_points} points"
    if enough:
        decoded = predictor.predict(
            [buildings[i].point_m - [0, 0, ground[i]] for i in enough], [seen[i] for i in enough]
        )
        for k, i in enumerate(enough):
            if np.isfinite(decoded.eave_height_m[k]):
                height[i] = max(float(decoded.eave_height_m[k]), config.min_eave_height_m)
                confidence[i] = decoded.confidence[k]
                angle[i] = kernel_angles(transfer_angles(seen[i], decoded.angle_deg[k], meshed[i]))
                odds[i] = transfer_angles(seen[i], decoded.class_probability[k], meshed[i])
            else:
                refused[i] = "footprint too large for the network"
    made = build(buildings, meshed, ground, height, angle, confidence, method, config, refused)
    return [replace(one, class_probability=own) for one, own in zip(made, odds, strict=True)]


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
    height = np.maximum(height, config.min_eave_height_m)
    return constant(buildings, height, 0.0, config, "lod1", refused="no point on the building")


def constant(
    buildings: Sequence[Building],
    eave_height_m: np.ndarray,
    angle_deg: float,
    config: Reconstruct,
    method: str = "constant",
    refused: str = "no height",
) -> list[Reconstruction]:
    """Buildings with given heights (b,), NaN for none, and the same angle at every edge."""
    rings = [mesh_footprint(building, config) for building in buildings]
    angle = [kernel_angles(np.full(sum(map(len, r)), angle_deg)) for r in rings]
    ground = [ground_z_m(building) for building in buildings]
    unknown = np.full(len(buildings), np.nan)
    why = [refused if len(building.point_m) else NO_POINT for building in buildings]
    height = np.asarray(eave_height_m, float)
    return build(buildings, rings, ground, height, angle, unknown, method, config, why)


def ground_z_m(building: Building) -> float:
    """The ground that the crop found, else a low quantile of the points; NaN without any."""
    if np.isfinite(building.ground_z_m):
        return float(building.ground_z_m)
    return (
        float(np.quantile(building.point_m[:, 2], GROUND_QUANTILE)) if len(building.point_m) else float("nan")
    )


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


def simplify_exterior(rings: Sequence[np.ndarray], max_num_vertices: int) -> list[np.ndarray]:
    """The rings with at most so many vertices in the exterior, by Douglas-Peucker with a growing tolerance.

    Courtyards stay as they are. An exterior that keeps more vertices whatever the tolerance becomes its
    smallest rectangle.
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
    return [_rings(shapely.orient_polygons(simple, exterior_cw=False))[0], *rings[1:]]


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
    known: Sequence[np.ndarray], angle_deg: np.ndarray, wanted: Sequence[np.ndarray]
) -> np.ndarray:
    """Angles of the edges of ``known`` (rings, a value or a row per edge) for those of ``wanted``: the same
    building with more or fewer vertices.

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
        "class_probability": [
            None if r.class_probability is None else r.class_probability.ravel() for r in rows
        ],
        "confidence": [r.confidence for r in rows],
        "num_parts": [r.num_parts for r in rows],
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


def build(
    buildings: Sequence[Building],
    rings: Sequence[Sequence[np.ndarray]],
    ground: Sequence[float],
    eave_height_m: np.ndarray,
    angle_deg: Sequence[np.ndarray],
    confidence: np.ndarray,
    method: str,
    config: Reconstruct,
    refused: Sequence[str],
    top_height_m: np.ndarray | float = np.inf,
) -> list[Reconstruction]:
    """Meshes through the kernel, which checks each. A building without a finite height is refused.

    rings, ground (b,), eave_height_m (b,), angle_deg and confidence (b,): one per building. refused: why a
    building without a height has none. top_height_m: one for all or (b,), of a flat cut above the eave.
    """
    result = [no_mesh(b, method, why) for b, why in zip(buildings, refused, strict=True)]
    usable = np.flatnonzero(np.isfinite(eave_height_m) & np.isfinite(ground)).tolist()
    if not usable:
        return result
    top_height = np.broadcast_to(np.asarray(top_height_m, float), len(buildings))
    meshes: Meshes = skeleton.build(
        Polygons.from_rings([list(rings[i]) for i in usable]),
        np.concatenate([angle_deg[i] for i in usable]),
        eave_height_m[usable],
        max_roof_height_m=np.minimum(top_height, config.max_roof_height_m)[usable],
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


def mesh_footprint(building: Building, config: Reconstruct) -> list[np.ndarray]:
    """The rings that the mesh gets: simplified, unless that leaves no simple polygon."""
    if config.simplify_m == 0:
        return list(building.rings)
    simple = building.polygon.simplify(config.simplify_m, preserve_topology=True)
    if not isinstance(simple, shapely.Polygon) or not simple.is_valid or simple.is_empty:
        return list(building.rings)
    return _rings(shapely.orient_polygons(simple, exterior_cw=False))


def _rings(polygon: shapely.Polygon) -> list[np.ndarray]:
    return [np.asarray(ring.coords)[:-1, :2] for ring in (polygon.exterior, *polygon.interiors)]


def _edges(rings: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate(list(rings)), np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])


def _num_vertices(polygon: shapely.Polygon) -> int:
    return len(polygon.exterior.coords) - 1
