"""The product: the function behind ``p2wss reconstruct``, which the evaluation measures too.

Solids that are not valid by the rules of ISO 19107 are replaced by simpler ones.
"""

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

# factors on the prices, for simpler roofs that replace an invalid one
_PRICES = (2.0, 4.0, 8.0)
# for a row: an iterator of simpler reconstructions, the best first, which computes each when it is needed
Simpler = Callable[[int], Iterator[Reconstruction]]
# names of the methods, in files and reports
NETWORK, FIT, COMPLETION_AND_FIT = "point2wss", fitting.METHOD, f"completion+{fitting.METHOD}"


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
    ``lod1``, with the reason as status (:func:`p2wss.reconstruction.flat.with_fallback`). All meshes are valid solids.
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
