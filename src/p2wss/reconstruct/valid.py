"""Make the solids of reconstructions valid by the rules of ISO 19107: repair them, or replace them by simpler ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.fit import fitting
from p2wss.fit.mesh.walls import REACH_M, with_exact_walls
from p2wss.mesh.repair import LabelledMesh, repaired

# (row, invalid reconstruction): simpler ones, the best first
Simpler = Callable[[int, Reconstruction], Iterable[Reconstruction]]


def with_valid_solids(
    reconstructions: Sequence[Reconstruction],
    buildings: Sequence[Building],
    simpler: Simpler = lambda row, invalid: (),
) -> list[Reconstruction]:
    """The reconstructions, all of whose meshes are valid solids once they are stored in a file, with outer walls on the
    edges of the footprints (:mod:`p2wss.fit.mesh.walls`).

    A solid that violates a rule is repaired by moving vertices by millimetres; otherwise it is replaced by the first
    valid one of ``simpler``; otherwise the building has no mesh, for the reason ``invalid-solid``.
    """
    result = list(reconstructions)
    for row, reconstruction in enumerate(reconstructions):
        if not reconstruction.has_mesh:
            continue
        valid = _on_footprint(reconstruction)
        if valid is None:
            candidates = (_on_footprint(each) for each in simpler(row, reconstruction) if each.has_mesh)
            valid = next(filter(None, candidates), None)
        result[row] = valid or no_mesh(buildings[row], reconstruction.method, reasons.INVALID_SOLID)
    return result


def _on_footprint(reconstruction: Reconstruction) -> Reconstruction | None:
    """A valid solid, if possible one whose outer walls are exactly on the edges of the footprint; None if there is
    none."""
    for reach_m in (REACH_M, 0.0):
        exact = as_valid_solid(with_exact_walls(reconstruction, reach_m))
        if exact is not None:
            return exact
    return as_valid_solid(reconstruction)


def simpler_fits(
    building: Building,
    invalid: Reconstruction,
    initial: Reconstruction | None,
    method: str,
    config: Reconstruct,
) -> Iterator[Reconstruction]:
    """Fits with fewer details than an invalid one: without dormers, then with fewer and fewer parts."""
    most = invalid.num_parts if config.dormers else invalid.num_parts - 1
    for max_parts in range(most, 0, -1):
        simple = config.model_copy(update={"dormers": False, "max_parts": max_parts})
        yield fitting.fit([building], simple, [initial], method)[0]


def as_valid_solid(reconstruction: Reconstruction) -> Reconstruction | None:
    """The reconstruction if its solid follows the rules, else a repaired one, or None."""
    mesh = labelled_mesh(reconstruction)
    valid = repaired(mesh)
    if valid is None or valid is mesh:
        return None if valid is None else reconstruction
    vertex_m = valid.vertex_m - _position(reconstruction)
    return replace(
        reconstruction, vertex_m=vertex_m, triangle=valid.triangle, kind=valid.kind, edge=valid.edge
    )


def labelled_mesh(reconstruction: Reconstruction) -> LabelledMesh:
    """The mesh of a reconstruction in the CRS of the cloud."""
    return LabelledMesh(
        reconstruction.vertex_m + _position(reconstruction),
        reconstruction.triangle,
        reconstruction.kind,
        reconstruction.edge,
    )


def _position(reconstruction: Reconstruction) -> np.ndarray:
    return np.array([*reconstruction.origin_xy_m, reconstruction.ground_z_m])
