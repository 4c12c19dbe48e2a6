"""Buildings without a fitted roof: flat ones, and ones of constant height and angle."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction
from p2wss.fit.parametric import build_meshes, kernel_angles


def with_fallback(
    reconstructions: Sequence[Reconstruction], buildings: Sequence[Building], config: Reconstruct
) -> list[Reconstruction]:
    """The reconstructions, with flat roofs (method ``lod1``) for buildings without a mesh.

    The roof is at the median height of the points on the building, and the status keeps the reason. Without such
    points, it is at the height that the footprint states, with the status "height-from-attribute". If there is no
    stated height, or no ground for it, the building stays without a mesh, and the status tells which is missing.
    """
    result = list(reconstructions)
    missing = [i for i, r in enumerate(result) if not r.has_mesh]
    of_missing = [buildings[i] for i in missing]
    height = np.array([flat_height_m(building) for building in of_missing])
    # a stated height cannot be used without a ground
    has_no_ground = [np.isnan(b.ground_z_m) and np.isfinite(b.stated_height_m) for b in of_missing]
    stated = [b.stated_height_m if np.isfinite(b.ground_z_m) else np.nan for b in of_missing]
    is_stated = np.isnan(height)
    height = np.maximum(np.where(is_stated, stated, height), config.min_eave_height_m)
    flat = constant(of_missing, height, 0.0, config, "lod1", reasons.NO_POINTS_ON_BUILDING)
    for k, i in enumerate(missing):
        if flat[k].has_mesh:
            status = reasons.HEIGHT_FROM_ATTRIBUTE if is_stated[k] else result[i].status
            result[i] = replace(flat[k], status=status)
        elif is_stated[k]:
            result[i] = replace(result[i], status=reasons.NO_GROUND if has_no_ground[k] else flat[k].status)
    return result


def lod1(buildings: Sequence[Building], config: Reconstruct) -> list[Reconstruction]:
    """Flat roofs at the median height of the points on each building (:func:`flat_height_m`)."""
    height = np.array([flat_height_m(building) for building in buildings])
    height = np.maximum(height, config.min_eave_height_m)
    return constant(buildings, height, 0.0, config, "lod1", reason=reasons.NO_POINTS_ON_BUILDING)


def constant(
    buildings: Sequence[Building],
    eave_height_m: np.ndarray,
    angle_deg: float,
    config: Reconstruct,
    method: str = "constant",
    reason: str = reasons.NO_HEIGHT,
) -> list[Reconstruction]:
    """Buildings with the same angle at every edge. eave_height_m: (b,); a building with NaN gets no mesh, for
    ``reason``, or because it has no points."""
    rings = [building.rings for building in buildings]
    angle = [kernel_angles(np.full(sum(map(len, r)), angle_deg)) for r in rings]
    status = [reason if len(building.point_m) else reasons.NO_POINTS for building in buildings]
    return build_meshes(buildings, rings, eave_height_m, angle, method, config, status)


def flat_height_m(building: Building) -> float:
    """Median height above ground of the points on the building; NaN without any."""
    z_m = building.point_m[building.is_on_building, 2]
    return float(np.median(z_m)) if len(z_m) else float("nan")
