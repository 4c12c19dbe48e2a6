"""Solids that are not valid by the rules of ISO 19107 are replaced by simpler ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.fit import fitting
from p2wss.fit.settings import THRESHOLDS
from p2wss.mesh.repair import surfaces_to_write

# multiples of the prices of roofs that replace an invalid one
_PRICES = (2.0, 4.0, 8.0)
# of a row: simpler reconstructions, the best first
Simpler = Callable[[int], Iterable[Reconstruction]]


def with_valid_solids(
    reconstructions: Sequence[Reconstruction],
    buildings: Sequence[Building],
    simpler: Simpler = lambda row: (),
) -> list[Reconstruction]:
    """The reconstructions, all of whose meshes are valid solids once they are stored in a file.

    A solid that violates a rule is replaced by the first valid one of ``simpler``; otherwise the building has no mesh,
    for the reason ``invalid-solid``.
    """
    result = list(reconstructions)
    for row, reconstruction in enumerate(reconstructions):
        if reconstruction.mesh is None:
            continue
        valid = _as_valid_solid(reconstruction)
        if valid is None:
            candidates = (_as_valid_solid(each) for each in simpler(row))
            valid = next(filter(None, candidates), None)
        result[row] = valid or no_mesh(buildings[row], reconstruction.method, reasons.INVALID_SOLID)
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
