"""Reconstructions of the buildings of the evaluation by each of its methods."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from p2wss.config import Config, Reconstruct
from p2wss.data.building import Reconstruction, no_mesh
from p2wss.eval import roofer
from p2wss.eval.cases import Case, Medians
from p2wss.reconstruction.product import (
    FIT,
    NETWORK,
    Predictor,
    constant,
    lod1,
    reconstruct_buildings,
    reconstruct_with_network,
)
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.crops import SIMULATED

# names of the results of the method "masked", the settings of Table 1 with the footprint hidden from the network: with
# visible signs, as in the paper, and with masked signs
MASKED = ("all_masked", "all_masked_signs")
NAMES = (NETWORK, FIT, "masked", "lod1", "constant", roofer.METHOD)


class MaskedPredictor(Predictor, Protocol):
    """The part of :class:`p2wss.nets.predictor.Point2WssPredictor` that Table 1 needs."""

    def reconstruct_all_masked(
        self, points_m: Sequence[np.ndarray], footprints_m: Sequence[np.ndarray], signs_visible: bool = True
    ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        """Heights (b,), footprints (v, 2) and angles (v,) with all numerical tokens masked."""


class Inputs(NamedTuple):
    """What methods need beside the buildings. predictor: for point2wss and masked. medians: for constant. crs: of the
    buildings, for Roofer."""

    config: Config
    predictor: MaskedPredictor | None = None
    medians: Medians | None = None
    crs: str | None = None


def reconstruct(method: str, cases: Sequence[Case], inputs: Inputs) -> list[Reconstruction]:
    """The reconstructions of a method for the cases of one shard, at least one, in order.

    Cases for which it was not run are left out: all cases if Roofer cannot be run, cases without labels for the masked
    settings. ``point2wss`` is the paper's method, the network with the views of its training; a building that it cannot
    reconstruct has no mesh. ``fit`` is the result of ``p2wss reconstruct``; a flat roof used as a fallback counts as a
    result of the method, with the reason as its status. ``constant``: all buildings with the median height and angle.
    Raises :class:`InputError` for an unknown name.
    """
    config = for_dataset(inputs.config.reconstruct, cases[0].dataset)
    buildings = [case.building for case in cases]
    if method == "lod1":
        return lod1(buildings, config)
    if method == "constant" and inputs.medians is not None:
        height_m = np.full(len(buildings), inputs.medians.eave_height_m)
        return constant(buildings, height_m, inputs.medians.angle_deg, config)
    if method == roofer.METHOD:
        return roofer.reconstruct(cases, inputs.crs, inputs.config.eval)
    if method == FIT:
        return [replace(row, method=FIT) for row in reconstruct_buildings(buildings, None, config)]
    if method == NETWORK and inputs.predictor is not None:
        return reconstruct_with_network(buildings, inputs.predictor, config)
    if method == "masked" and inputs.predictor is not None:
        return _masked(cases, inputs.predictor, config)
    raise InputError(f"cannot reconstruct by {method}: choose one of {', '.join(NAMES)}, with what it needs")


def for_dataset(config: Reconstruct, dataset: str) -> Reconstruct:
    """The settings for a data set.

    Simulated buildings are parametric, and so are their roofs. For real buildings the settings of the product are used
    as they are.
    """
    if dataset != SIMULATED:
        return config
    return config.model_copy(update={"roofs": "parametric"})


def _masked(cases: Sequence[Case], predictor: MaskedPredictor, config: Reconstruct) -> list[Reconstruction]:
    """Parameters without meshes, for the labelled buildings that the network supports."""
    buildings = [
        case.building
        for case in cases
        if case.is_labelled
        and len(case.building.point_m) >= config.min_num_points
        and len(case.building.rings) == 1
        and len(case.building.rings[0]) <= predictor.max_num_vertices
    ]
    clouds_m = [building.point_m for building in buildings]
    footprints_m = [building.rings[0] for building in buildings]
    result = []
    for method in MASKED:
        readings = predictor.reconstruct_all_masked(clouds_m, footprints_m, method == MASKED[0])
        for building, height_m, xy_m, angle_deg in zip(buildings, *readings, strict=True):
            # NaN for a footprint that the number format cannot represent
            if np.isfinite(height_m):
                row = no_mesh(building, method, "ok")
                result.append(replace(row, rings=[xy_m], eave_height_m=float(height_m), angle_deg=angle_deg))
    return result
