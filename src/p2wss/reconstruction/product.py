"""The product: the function behind ``p2wss reconstruct``, which the evaluation measures too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from p2wss.config import Reconstruct
from p2wss.data.building import Building, Reconstruction
from p2wss.fit import fitting
from p2wss.reconstruction.flat import with_fallback
from p2wss.reconstruction.network import Predictor, reconstruct_with_network, with_supposed_roofs
from p2wss.reconstruction.valid import simpler_fits, with_valid_solids

# names of the methods, in files and reports
NETWORK, FIT, COMPLETION_AND_FIT = "point2wss", fitting.METHOD, f"completion+{fitting.METHOD}"


def reconstruct_buildings(
    buildings: Sequence[Building], predictor: Predictor | None, config: Reconstruct
) -> list[Reconstruction]:
    """The product: one reconstruction per building, in order.

    With a predictor, each is the paper's building with the network's height and angles. Without one they are fitted to
    the points; with ``config.completion``, a network supposes what roofs of planes are like between few points, and
    they are fitted to that, too. Where these give no mesh, the result is a flat roof of the method ``lod1`` whose
    status has the reason (:func:`p2wss.reconstruction.flat.with_fallback`). All meshes are valid solids
    (:mod:`p2wss.reconstruction.valid`).
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
    missing = [i for i, reconstruction in enumerate(reconstructions) if not reconstruction.has_mesh]
    flat = flat_roofs([reconstructions[i] for i in missing], [buildings[i] for i in missing], config)
    for i, valid in zip(missing, flat, strict=True):
        reconstructions[i] = valid
    return reconstructions


def flat_roofs(
    missing: Sequence[Reconstruction], buildings: Sequence[Building], config: Reconstruct
) -> list[Reconstruction]:
    """Valid solids with flat roofs for buildings without a mesh, or the reasons for none."""
    return with_valid_solids(with_fallback(missing, buildings, config), buildings)


def method_name(predictor: Predictor | None) -> str:
    """``point2wss`` or ``fit``."""
    return FIT if predictor is None else NETWORK
