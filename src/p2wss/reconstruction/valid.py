"""Make the solids of reconstructions exact, and valid by the rules of ISO 19107, or replace them by simpler ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.fit import fitting
from p2wss.fit.mesh.walls import REACH_M, with_exact_walls
from p2wss.fit.settings import THRESHOLDS
from p2wss.mesh import Mesh
from p2wss.mesh.planar import with_exact_faces
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
    """The reconstructions, all of whose meshes are valid solids once they are stored in a file, with outer walls on the
    edges of the footprints (:mod:`p2wss.fit.mesh.walls`) and exact faces (:mod:`p2wss.mesh.planar`).

    A solid that violates a rule is replaced by the first valid one of ``simpler``; otherwise the building has no mesh,
    for the reason ``invalid-solid``.
    """
    result = list(reconstructions)
    for row, reconstruction in enumerate(reconstructions):
        if reconstruction.mesh is None:
            continue
        valid = _on_footprint(reconstruction)
        if valid is None:
            candidates = (_on_footprint(each) for each in simpler(row))
            valid = next(filter(None, candidates), None)
        result[row] = valid or no_mesh(buildings[row], reconstruction.method, reasons.INVALID_SOLID)
    return result


def _on_footprint(reconstruction: Reconstruction) -> Reconstruction | None:
    """A valid solid, if possible one whose outer walls are exactly on the edges of the footprint; None if there is
    none."""
    mesh = reconstruction.mesh
    if mesh is None:
        return None
    candidates = chain(
        (
            with_exact_faces(with_exact_walls(mesh, reconstruction.rings, reach_m))
            for reach_m in (REACH_M, 0.0)
        ),
        [mesh],
    )
    return next(filter(None, (_as_valid_solid(reconstruction, candidate) for candidate in candidates)), None)


def simpler_fits(building: Building, config: Reconstruct) -> Iterator[Reconstruction]:
    """Fits with fewer details than an invalid one: with fewer and fewer faces, at last the parametric building."""
    for factor in _PRICES:
        fewer = replace(THRESHOLDS, planes=THRESHOLDS.planes.times(factor))
        yield from fitting.fit([building], config, fewer)
    yield from fitting.fit([building], config.model_copy(update={"roofs": "parametric"}))


def _as_valid_solid(reconstruction: Reconstruction, mesh: Mesh) -> Reconstruction | None:
    """The reconstruction with a mesh if that follows the rules, or None."""
    surfaces, broken = surfaces_to_write(mesh, reconstruction.position_m)
    return None if broken else replace(reconstruction, mesh=mesh, surfaces=surfaces)
