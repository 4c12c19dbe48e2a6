"""Chamfer distance, triangles and errors of every reconstruction (paper, section 5.3)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from p2wss.config import Eval
from p2wss.eval.cases import Case
from p2wss.inference import BUILDING_CLASS, Reconstruction
from p2wss.metrics.chamfer import chamfer_distance_m
from p2wss.metrics.mesh_facts import mesh_facts
from p2wss.metrics.surface import distance_to_mesh, sample_surface
from p2wss.seeds import generator
from p2wss.skeleton.types import FaceKind

# with fewer points on the building the roof's distance says nothing
MIN_ROOF_POINTS = 10
_MESH_MEASURES = (
    "num_triangles",
    "watertight",
    "oriented",
    "chamfer_m",
    "roof_chamfer_m",
    "points_to_mesh_m",
)


def measure(
    cases: Sequence[Case],
    reconstructions: Iterable[Mapping[tuple[str, str, str], Reconstruction]],
    config: Eval,
) -> Iterator[dict[str, Any]]:
    """Rows of ``io.MEASURES``, one per case and method, methods in the order given.

    A method's mapping may lack a case: the method was not run on it, and the row is left out.
    """
    for method in reconstructions:
        for case in cases:
            if case.key in method:
                yield measure_building(case, method[case.key], config)


def measure_building(case: Case, reconstruction: Reconstruction, config: Eval) -> dict[str, Any]:
    """One row of ``io.MEASURES``. The draws depend on the seed, the building and the method alone."""
    building = case.building
    row: dict[str, Any] = {
        "dataset": case.dataset,
        "building_id": building.building_id,
        "tile": building.tile,
        "method": reconstruction.method,
        "status": reconstruction.status,
        "num_points": len(building.point_m),
        "num_vertices": sum(map(len, building.rings)),
        "roof_type": case.roof_type,
        "visible_roof_share": case.visible_roof_share,
        "confidence": reconstruction.confidence,
        **dict.fromkeys(_MESH_MEASURES),
        **_parameter_errors(case, reconstruction),
    }
    if not reconstruction.has_mesh:
        return row
    vertex_m, triangle = reconstruction.vertex_m, reconstruction.triangle
    facts = mesh_facts(vertex_m, triangle)
    row |= {"num_triangles": len(triangle), "watertight": facts.watertight, "oriented": facts.oriented}
    shift = np.subtract(building.origin_xy_m, reconstruction.origin_xy_m)
    point_m = building.point_m + np.array([*shift, -reconstruction.ground_z_m])
    names = (building.tile, building.building_id)
    draw = generator(config.seed, "eval.measure", *names, reconstruction.method)
    samples = sample_surface(vertex_m, triangle, config.num_samples, draw)
    row["chamfer_m"] = _finite(chamfer_distance_m(subset(case, point_m, config), samples))
    on_building = point_m[_on_building(case)]
    if len(on_building) >= MIN_ROOF_POINTS:
        roof = triangle[np.isin(reconstruction.kind, (FaceKind.ROOF, FaceKind.FLAT))]
        roof_samples = sample_surface(vertex_m, roof, config.num_samples, draw)
        row["roof_chamfer_m"] = _finite(chamfer_distance_m(on_building, roof_samples))
        row["points_to_mesh_m"] = float(distance_to_mesh(on_building, vertex_m, triangle).mean())
    return row


def subset(case: Case, point_m: np.ndarray, config: Eval) -> np.ndarray:
    """At most ``max_num_points`` of a building's points: the same for every method."""
    if len(point_m) <= config.max_num_points:
        return point_m
    draw = generator(config.seed, "eval.subset", case.building.tile, case.building.building_id)
    return point_m[np.sort(draw.choice(len(point_m), config.max_num_points, replace=False))]


def _on_building(case: Case) -> np.ndarray:
    """Points inside the footprint of the class building; where the cloud has no such class, those not below
    2 m above the ground."""
    building = case.building
    x, y, z = building.point_m.T
    inside = shapely.contains_xy(building.polygon, x, y)
    chosen = inside & (building.classification == BUILDING_CLASS)
    if not chosen.any() and np.isfinite(building.ground_z_m):
        chosen = inside & (z >= building.ground_z_m + 2.0)
    return chosen


def _parameter_errors(case: Case, reconstruction: Reconstruction) -> dict[str, float | None]:
    """Errors against the labels; None without labels, or where the method has other edges than the label."""
    errors: dict[str, float | None] = {"height_error_m": None, "angle_error_deg": None}
    if case.eave_height_m is None or case.angle_deg is None or reconstruction.eave_height_m is None:
        return errors
    eave_z_m = reconstruction.ground_z_m + reconstruction.eave_height_m
    errors["height_error_m"] = abs(eave_z_m - (case.label_ground_z_m or 0.0) - case.eave_height_m)
    angle = reconstruction.angle_deg
    if angle is not None and len(angle) == len(case.angle_deg):
        errors["angle_error_deg"] = float(np.abs(angle - case.angle_deg).mean())
    return errors


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
