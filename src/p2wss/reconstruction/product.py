"""The product: the function behind ``p2wss reconstruct``, which the evaluation measures too.

Solids that are not valid by the rules of ISO 19107 are replaced by simpler ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.fit import fitting
from p2wss.fit.settings import THRESHOLDS
from p2wss.mesh.repair import surfaces_to_write
from p2wss.reconstruction.flat import with_fallback
from p2wss.reconstruction.network import Predictor, reconstruct_with_network, with_supposed_roofs

# multiples of the prices of roofs that replace an invalid one
_PRICES = (2.0, 4.0, 8.0)
# of a row: simpler reconstructions, the best first, made as they are asked for
Simpler = Callable[[int], Iterator[Reconstruction]]
# names of the methods, in files and reports
NETWORK, FIT, COMPLETION_AND_FIT = "point2wss", fitting.METHOD, f"completion+{fitting.METHOD}"


def with_valid_solids(
    reconstructions: Sequence[Reconstruction],
    buildings: Sequence[Building],
    simpler: Simpler = lambda row: iter(()),
) -> list[Reconstruction]:
    """The reconstructions, all of whose meshes are valid solids once they are stored in a file.

    A solid that violates a rule is replaced by the first valid one of ``simpler``; otherwise the building has no mesh,
    for the reason ``invalid-solid``.
    """
    result = list(reconstructions)
    for row, reconstruction in enumerate(reconstructions):
        # those with surfaces are known to be valid
        if reconstruction.mesh is not None and not reconstruction.surfaces:
            valid = filter(None, map(_as_valid_solid, chain([reconstruction], simpler(row))))
            result[row] = next(valid, None) or no_mesh(
                buildings[row], reconstruction.method, reasons.INVALID_SOLID
            )
    return result


def simpler_fits(building: Building, config: Reconstruct) -> Iterator[Reconstruction]:
    """Fits with fewer details than an invalid one: with fewer and fewer faces, at last the parametric building."""
    for factor in _PRICES:
        fewer = replace(THRESHOLDS, planes=THRESHOLDS.planes.times(factor))
        yield from fitting.fit([building], config, fewer)
    yield from fitting.fit([building], config.model_copy(update={"roofs": "parametric"}))


def _as_valid_solid(reconstruction: Reconstruction) -> Reconstruction | None:
    """The reconstruction with its surfaces if its solid follows the rules, or None."""
    if reconstruction.mesh is None:
        return None
    surfaces, broken = surfaces_to_write(reconstruction.mesh, reconstruction.position_m)
    return None if broken else replace(reconstruction, surfaces=surfaces)


def reconstruct_buildings(
    buildings: Sequence[Building], predictor: Predictor | None, config: Reconstruct
) -> list[Reconstruction]:
    """The product: one reconstruction per building, in order.

    With a predictor, each is the paper's building with the network's height and angles. Without one they are fitted to
    the points; with ``config.completion``, a network supposes what roofs of planes are like between few points, and
    they are fitted to that, too. Where these give no mesh, the result is a flat roof of the method ``lod1`` whose
    status has the reason (:func:`p2wss.reconstruction.flat.with_fallback`). All meshes are valid solids
    (:mod:`p2wss.reconstruction.product`).
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
    """The same with valid solids with flat roofs for buildings without a mesh, or the reasons for none."""
    return with_valid_solids(with_fallback(reconstructions, buildings, config), buildings)


def method_name(predictor: Predictor | None) -> str:
    """``point2wss`` or ``fit``."""
    return FIT if predictor is None else NETWORK
