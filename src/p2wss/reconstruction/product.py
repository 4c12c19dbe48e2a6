"""The product: the function behind ``p2wss reconstruct``, which the evaluation measures too, and the reconstructions of
which it consists: fits, buildings with predicted heights and angles, and flat roofs.

Solids that are not valid by the rules of ISO 19107 are replaced by simpler ones.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Protocol

import numpy as np

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.fit import fitting
from p2wss.fit.parametric import (
    MIN_NUM_POINTS,
    build_meshes,
    kernel_angles,
    simplify_exterior,
    transfer_angles,
)
from p2wss.fit.settings import THRESHOLDS
from p2wss.mesh.repair import surfaces_to_write
from p2wss.nets.prediction import Prediction
from p2wss.nets.supposed import supposed_roof

# factors on the prices, for simpler roofs that replace an invalid one
_PRICES = (2.0, 4.0, 8.0)
# for a row: an iterator of simpler reconstructions, the best first, which computes each when it is needed
Simpler = Callable[[int], Iterator[Reconstruction]]
# names of the methods, in files and reports
NETWORK, FIT, COMPLETION_AND_FIT = "point2wss", fitting.METHOD, f"completion+{fitting.METHOD}"


class Predictor(Protocol):
    """The part of :class:`p2wss.nets.predictor.Point2WssPredictor` that reconstruction needs."""

    @property
    def max_num_vertices(self) -> int:
        """The largest number of vertices of an exterior ring that the network takes."""

    @property
    def on_building(self) -> bool:
        """Whether the network was also trained on clouds of only the points on a building, and should get only such."""

    def predict(self, points_m: Sequence[np.ndarray], rings: Sequence[Sequence[np.ndarray]]) -> Prediction:
        """The heights and angles of buildings. points_m: for each building (n, 3), z above the ground. rings: as in
        :class:`Building`."""


def with_valid_solids(
    reconstructions: Sequence[Reconstruction],
    buildings: Sequence[Building],
    simpler: Simpler = lambda row: iter(()),
) -> list[Reconstruction]:
    """The reconstructions, with only meshes that are valid solids when stored in a file.

    A solid that breaks a rule is replaced by the first valid reconstruction of ``simpler``. If there is none, the
    building gets no mesh, for the reason ``invalid-solid``.
    """
    result = list(reconstructions)
    for row, reconstruction in enumerate(reconstructions):
        # reconstructions with surfaces have been found valid
        if reconstruction.mesh is not None and not reconstruction.surfaces:
            valid = filter(None, map(_as_valid_solid, chain([reconstruction], simpler(row))))
            result[row] = next(valid, None) or no_mesh(
                buildings[row], reconstruction.method, reasons.INVALID_SOLID
            )
    return result


def simpler_fits(building: Building, config: Reconstruct) -> Iterator[Reconstruction]:
    """Simpler fits in place of an invalid one: with fewer and fewer faces, and at last the parametric building."""
    for factor in _PRICES:
        fewer = replace(THRESHOLDS, planes=THRESHOLDS.planes.times(factor))
        yield from fitting.fit([building], config, fewer)
    yield from fitting.fit([building], config.model_copy(update={"roofs": "parametric"}))


def _as_valid_solid(reconstruction: Reconstruction) -> Reconstruction | None:
    """The reconstruction with its surfaces, if its solid is valid; else None."""
    if reconstruction.mesh is None:
        return None
    surfaces, broken = surfaces_to_write(reconstruction.mesh, reconstruction.position_m)
    return None if broken else replace(reconstruction, surfaces=surfaces)


def reconstruct_buildings(
    buildings: Sequence[Building], predictor: Predictor | None, config: Reconstruct
) -> list[Reconstruction]:
    """The product: one reconstruction per building, in order.

    With a predictor, a building is the paper's building with the network's height and angles. Without a predictor, it
    is fitted to the points. With ``config.completion``, a network supposes the roof between few points, and roofs of
    planes are fitted to the supposed roof, too. Where this gives no mesh, the result is a flat roof of the method
    ``lod1``, with the reason as status (:func:`with_fallback`). All meshes are valid solids.
    """
    if predictor is not None:
        predicted = reconstruct_with_network(buildings, predictor, config)
        reconstructions = with_valid_solids(predicted, buildings)
    else:
        if config.completion and config.roofs == "planes":
            buildings = with_supposed_roofs(buildings)
        fits = [
            replace(fit, method=COMPLETION_AND_FIT) if len(building.supposed_m) else fit
            for fit, building in zip(fitting.fit(buildings, config), buildings, strict=True)
        ]
        reconstructions = with_valid_solids(fits, buildings, lambda row: simpler_fits(buildings[row], config))
    return flat_roofs(reconstructions, buildings, config)


def flat_roofs(
    reconstructions: Sequence[Reconstruction], buildings: Sequence[Building], config: Reconstruct
) -> list[Reconstruction]:
    """The reconstructions, with flat roofs for buildings without a mesh. All meshes are valid solids; where a flat roof
    is not possible either, the status has the reason."""
    return with_valid_solids(with_fallback(reconstructions, buildings, config), buildings)


def method_name(predictor: Predictor | None) -> str:
    """The method without completion and fallback: :data:`FIT` without a predictor, else :data:`NETWORK`."""
    return FIT if predictor is None else NETWORK


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


def reconstruct_with_network(
    buildings: Sequence[Building], predictor: Predictor, config: Reconstruct
) -> list[Reconstruction]:
    """One reconstruction per building with the network's height and angles, in order.

    A building with fewer than ``min_num_points`` points, or whose mesh the kernel rejects, has a status and no mesh;
    :func:`with_fallback` replaces it by a flat roof.
    """
    mesh_rings = [building.rings for building in buildings]
    network_rings = [simplify_exterior(rings, predictor.max_num_vertices) for rings in mesh_rings]
    height = np.full(len(buildings), np.nan)
    angle = [np.zeros(sum(map(len, rings))) for rings in mesh_rings]
    num_points = [len(building.point_m) for building in buildings]
    with_points = [i for i, num in enumerate(num_points) if num >= config.min_num_points]
    status = [reasons.TOO_FEW_POINTS if num else reasons.NO_POINTS for num in num_points]
    if with_points:
        prediction = predictor.predict(
            [
                _on_building_m(buildings[i]) if predictor.on_building else buildings[i].point_m
                for i in with_points
            ],
            [network_rings[i] for i in with_points],
        )
        for k, i in enumerate(with_points):
            if np.isfinite(prediction.eave_height_m[k]):
                height[i] = max(float(prediction.eave_height_m[k]), config.min_eave_height_m)
                angle_deg = transfer_angles(network_rings[i], prediction.angle_deg[k], mesh_rings[i])
                angle[i] = kernel_angles(angle_deg)
            status[i] = reasons.OK if np.isfinite(height[i]) else reasons.FOOTPRINT_TOO_LARGE
    return build_meshes(buildings, mesh_rings, height, angle, "point2wss", config, status)


def with_supposed_roofs(buildings: Sequence[Building]) -> list[Building]:
    """The buildings, in which buildings with few points per square metre get ``supposed_m``: the roof that a network
    supposes between the points (:mod:`p2wss.nets.supposed`)."""
    result = []
    for building in buildings:
        roof_m = building.point_m[building.is_on_building]
        has_planes = len(roof_m) + len(building.around_m) >= THRESHOLDS.min_plane_points
        if has_planes and MIN_NUM_POINTS <= len(roof_m) < THRESHOLDS.known_per_m2 * building.polygon.area:
            supposed_m = supposed_roof(building.polygon, roof_m, building.around_m)
            building = replace(building, supposed_m=supposed_m)
        result.append(building)
    return result


def _on_building_m(building: Building) -> np.ndarray:
    """The points (n, 3) on the building; all points if these are too few to show a roof. Plants, neighbours and things
    on the ground are left out because they look different in the simulation from which the network learnt."""
    on_m = building.point_m[building.is_on_building]
    return on_m if len(on_m) >= MIN_NUM_POINTS else building.point_m
