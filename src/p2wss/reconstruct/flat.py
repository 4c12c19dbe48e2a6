"""Buildings without a fitted roof: flat ones, and ones of constant height and angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely

from p2wss.config import Reconstruct
from p2wss.data.building import NO_POINT, Building, Reconstruction, ground_z_m
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS
from p2wss.fit.mesh import build_meshes, kernel_angles, mesh_footprint


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
    return build_meshes(buildings, rings, ground, height, angle, unknown, method, config, why)


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
