"""Make the solids of reconstructions valid by the rules of ISO 19107: repair them, or replace them by simpler ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.fit import fitting
from p2wss.fit.mesh.walls import REACH_M, with_exact_walls
from p2wss.mesh import Mesh
from p2wss.mesh.repair import repaired

# of a row: simpler reconstructions, the best first
Simpler = Callable[[int], Iterable[Reconstruction]]


def with_valid_solids(
    reconstructions: Sequence[Reconstruction],
    buildings: Sequence[Building],
    simpler: Simpler = lambda row: (),
) -> list[Reconstruction]:
    """The reconstructions, all of whose meshes are valid solids once they are stored in a file, with outer walls on the
    edges of the footprints (:mod:`p2wss.fit.mesh.walls`).

    A solid that violates a rule is repaired by moving vertices by millimetres; otherwise it is replaced by the first
    valid one of ``simpler``; otherwise the building has no mesh, for the reason ``invalid-solid``.
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
        (with_exact_walls(mesh, reconstruction.rings, reach_m) for reach_m in (REACH_M, 0.0)), [mesh]
    )
    return next(filter(None, (_as_valid_solid(reconstruction, candidate) for candidate in candidates)), None)


def simpler_fits(
    building: Building,
    initial: Reconstruction | None,
    method: str,
    config: Reconstruct,
) -> Iterator[Reconstruction]:
    """Fits with fewer details than an invalid one: with fewer faces, then the parametric building."""
    for simpler in ({"detail": "low"}, {"roofs": "parametric"}):
        (fitted,) = fitting.fit([building], config.model_copy(update=simpler), [initial], method)
        yield fitted


def _as_valid_solid(reconstruction: Reconstruction, mesh: Mesh) -> Reconstruction | None:
    """The reconstruction with a mesh if that follows the rules, else with a repaired one, or None."""
    in_crs = mesh.translated(reconstruction.position_m)
    valid = repaired(in_crs)
    if valid is None:
        return None
    solid, surfaces = valid
    if solid is not in_crs:
        mesh = solid.translated(-reconstruction.position_m)
    return replace(reconstruction, mesh=mesh, surfaces=surfaces)
