"""Chamfer distance, number of triangles and errors of every reconstruction (paper, section 5.3)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from p2wss.config import Eval
from p2wss.data.building import Reconstruction
from p2wss.data.seeds import generator
from p2wss.eval.cases import Case, Key, local_points
from p2wss.eval.causes import FAR_M, UNEXPLAINED_M, cause_of_error
from p2wss.eval.methods import fit_parts, main_method
from p2wss.eval.metrics.chamfer import chamfer_distance_m
from p2wss.eval.metrics.height import height_rmse_m, surface_height_m
from p2wss.eval.metrics.mesh_facts import mesh_facts, out_of_plane_m
from p2wss.eval.roof_kinds import roof_kind
from p2wss.mesh import Mesh
from p2wss.mesh.surface import distance_to_mesh, sample_surface
from p2wss.reconstruct.product import NETWORK
from p2wss.skeleton.types import FaceKind
from p2wss.storage.schemas.crops import REAL

# with fewer points on the building, distances to the roof mean nothing
MIN_ROOF_POINTS = 10
PLANAR_M = 0.01
SMALL_FACE_M2 = 0.25
# from the footprint's edges: nearer points may be on a wall, where a height over the roof means nothing
INNER_M = 0.5
# a value within these of the label counts as correct
CORRECT_M, CORRECT_DEG = 0.5, 5.0
_ROOF = (FaceKind.ROOF, FaceKind.FLAT)
_MESH_MEASURES = (
    "num_parts",
    "num_triangles",
    "num_mesh_vertices",
    "watertight",
    "oriented",
    "manifold",
    "planar",
    "num_small_faces",
    "chamfer_m",
    "roof_chamfer_m",
    "points_to_mesh_m",
    "far_share",
    "height_rmse_m",
    "height_bias_m",
    "overshoot_m",
)


def measure(
    cases: Sequence[Case],
    reconstructions: Mapping[str, Mapping[Key, Reconstruction]],
    config: Eval,
) -> Iterator[dict[str, Any]]:
    """Rows of the schema ``MEASURES``, one per case and method, methods in the order given.

    A method's mapping may lack a case on which the method was not run; there is no row for it.
    """
    main = main_method(list(reconstructions))
    for method, by_key in reconstructions.items():
        for case in cases:
            if case.key in by_key:
                row = measure_building(case, by_key[case.key], config)
                if method == main or (method == NETWORK and case.dataset == REAL):
                    row["cause"] = _cause(case, row, reconstructions, method)
                yield row


def _cause(
    case: Case, row: dict[str, Any], reconstructions: Mapping[str, Mapping[Key, Reconstruction]], method: str
) -> str | None:
    """The kind of cause of the error, of real buildings and of those that are far from their points."""
    distance_m = row["points_to_mesh_m"]
    if case.dataset != REAL and distance_m is not None and distance_m <= UNEXPLAINED_M:
        return None
    num_parts = fit_parts({name: by_key.get(case.key) for name, by_key in reconstructions.items()})
    return cause_of_error(case, reconstructions[method][case.key], num_parts).kind


def measure_building(case: Case, reconstruction: Reconstruction, config: Eval) -> dict[str, Any]:
    """One row of the schema ``MEASURES``. Random draws depend on the seed, the building and the method alone."""
    building = case.building
    x, y, _ = building.point_m.T
    num_inside = int(shapely.contains_xy(building.polygon, x, y).sum())
    row: dict[str, Any] = {
        "dataset": case.dataset,
        "building_id": building.building_id,
        "tile": building.tile,
        "method": reconstruction.method,
        "status": reconstruction.status,
        "num_points": len(building.point_m),
        "num_vertices": sum(map(len, building.rings)),
        "density_per_m2": num_inside / building.polygon.area,
        "roof_type": case.roof_type,
        # a flat roof instead of a mesh of the method says nothing of the building
        "roof_kind": roof_kind(reconstruction.rings, reconstruction.angle_deg, reconstruction.num_parts)
        if reconstruction.angle_deg is not None and reconstruction.status == "ok"
        else None,
        "visible_roof_share": case.visible_roof_share,
        "confidence": reconstruction.confidence,
        "cause": None,
        **dict.fromkeys(_MESH_MEASURES),
        **_parameter_errors(case, reconstruction),
    }
    mesh = reconstruction.mesh
    if mesh is None:
        return row
    row |= {"num_parts": reconstruction.num_parts, **_mesh_measures(mesh)}
    point_m = local_points(case, reconstruction)
    draw = generator(config.seed, "eval.measure", building.tile, building.building_id, reconstruction.method)
    samples = sample_surface(mesh.vertex_m, mesh.triangle, config.num_samples, draw)
    row["chamfer_m"] = _finite(chamfer_distance_m(subset(case, point_m, config), samples))
    is_on_building = building.is_on_building
    if is_on_building.sum() >= MIN_ROOF_POINTS:
        inner = shapely.contains_xy(building.polygon.buffer(-INNER_M), x[is_on_building], y[is_on_building])
        row |= _roof_measures(mesh, point_m[is_on_building], inner, config, draw)
    return row


def _mesh_measures(mesh: Mesh) -> dict[str, Any]:
    facts = mesh_facts(mesh.vertex_m, mesh.triangle)
    area = np.bincount(mesh.face, mesh.area_m2)
    above = np.bincount(mesh.face, mesh.kind != FaceKind.GROUND) > 0
    return {
        "num_triangles": len(mesh.triangle),
        "num_mesh_vertices": facts.num_vertices,
        "watertight": facts.watertight,
        "oriented": facts.oriented,
        "manifold": facts.manifold,
        "planar": bool(out_of_plane_m(mesh.vertex_m, mesh.triangle, mesh.face).max() <= PLANAR_M),
        "num_small_faces": int((above & (area < SMALL_FACE_M2)).sum()),
    }


def _roof_measures(
    mesh: Mesh,
    on_building: np.ndarray,
    inner: np.ndarray,
    config: Eval,
    draw: np.random.Generator,
) -> dict[str, Any]:
    roof = mesh.triangle[np.isin(mesh.kind, _ROOF)]
    roof_samples = sample_surface(mesh.vertex_m, roof, config.num_samples, draw)
    distance = distance_to_mesh(on_building, mesh.vertex_m, mesh.triangle)
    place = on_building[inner]
    above = place[:, 2] - surface_height_m(place[:, :2], mesh.vertex_m, mesh.triangle)
    heights = above[~np.isnan(above)]
    return {
        "roof_chamfer_m": _finite(chamfer_distance_m(on_building, roof_samples)),
        "points_to_mesh_m": float(distance.mean()),
        "far_share": float((distance > FAR_M).mean()),
        "height_rmse_m": _finite(height_rmse_m(above)),
        "height_bias_m": float(np.median(heights)) if len(heights) else None,
        "overshoot_m": float(mesh.vertex_m[:, 2].max() - on_building[:, 2].max()),
    }


def subset(case: Case, point_m: np.ndarray, config: Eval) -> np.ndarray:
    """At most ``max_num_points`` of a building's points, the same for every method."""
    if len(point_m) <= config.max_num_points:
        return point_m
    draw = generator(config.seed, "eval.subset", case.building.tile, case.building.building_id)
    return point_m[np.sort(draw.choice(len(point_m), config.max_num_points, replace=False))]


def _parameter_errors(case: Case, reconstruction: Reconstruction) -> dict[str, float | None]:
    """Errors against the labels; None without labels, or where the reconstruction has other edges than the label."""
    errors: dict[str, float | None] = {
        "height_error_m": None,
        "angle_error_deg": None,
        "right_share": None,
    }
    if case.eave_height_m is None or case.angle_deg is None or reconstruction.eave_height_m is None:
        return errors
    eave_z_m = reconstruction.ground_z_m + reconstruction.eave_height_m
    height_error = abs(eave_z_m - (case.label_terrain_z_m or 0.0) - case.eave_height_m)
    errors["height_error_m"] = height_error
    if reconstruction.angle_deg is not None and len(reconstruction.angle_deg) == len(case.angle_deg):
        angle_error = np.abs(reconstruction.angle_deg - case.angle_deg)
        errors["angle_error_deg"] = float(angle_error.mean())
        is_correct = np.append(angle_error <= CORRECT_DEG, height_error <= CORRECT_M)
        errors["right_share"] = float(is_correct.mean())
    return errors


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
