"""Whether the solids of a CityJSON file are valid by ISO 19107."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from p2wss.formats import cityjson_read
from p2wss.formats.cityjson_read import Shell
from p2wss.mesh.faces import doubled_area
from p2wss.mesh.rules import MEANINGS, VAL3DITY, breaches
from p2wss.mesh.topology import doubled_areas
from p2wss.mesh.triangulation import triangulated_in_space
from p2wss.skeleton.groups import groups
from p2wss.storage.messages import InputError

if TYPE_CHECKING:
    import manifold3d

OVERLAP, APART = 501, 503


@dataclass(frozen=True)
class Validity:
    """The solids of a file that break rules of ISO 19107.

    Attributes
    ----------
    num_solids : int
        The number of solids in the file.
    invalid : dict of str to list of str
        The rules that each invalid solid breaks, as codes of val3dity with their meanings. Keys are names of city
        objects with the level of detail.
    """

    num_solids: int
    invalid: dict[str, list[str]]


def check_file(path: str | Path) -> Validity:
    """Check all solids against the rules of ISO 19107 (:mod:`p2wss.mesh.rules`), with the default tolerances of
    val3dity.

    Raises :class:`InputError` for a file that is missing, broken or without solids.
    """
    num_solids, codes = 0, defaultdict(set)
    composites: defaultdict[tuple[str, str, int], list[list[Shell]]] = defaultdict(list)
    for shell in cityjson_read.shells(path):
        num_solids += shell.number == 0
        name = f"{shell.name} (LoD {shell.lod})" if shell.lod else shell.name
        if shell.composite is not None:
            solids = composites[shell.name, name, shell.composite]
            solids += [[]] if shell.number == 0 else []
            solids[-1].append(shell)
        for breach in breaches(shell.vertex_m, shell.surfaces, is_outer=shell.number == 0):
            codes[name].add(breach.code)
    for (_, name, _), solids in composites.items():
        # a boolean operation needs solids that are valid themselves
        if name not in codes and (code := _breach_of_composite(solids)):
            codes[name].add(code)
    if not num_solids:
        raise InputError(f"{path}: has no solids to check")
    invalid = {
        name: [f"{code} {MEANINGS[code]}" for code in sorted(numbers)] for name, numbers in codes.items()
    }
    return Validity(num_solids, invalid)


def _breach_of_composite(solids: Sequence[Sequence[Shell]]) -> int | None:
    """The rule that the solids of a composite, each a list of shells, break together; None if they break none.
    :data:`OVERLAP`: two of them have more volume in common than touching faces have within the tolerance.
    :data:`APART`: they are not all connected, as gaps are larger than the tolerance."""
    corners = [np.concatenate([_corners(shell) for shell in solid]) for solid in solids]
    # coordinates of a CRS are too large for accurate differences
    corners = [each - corners[0].min(axis=(0, 1)) for each in corners]
    bodies = [_manifold(each) for each in corners]
    boxes = [(each.min(axis=(0, 1)), each.max(axis=(0, 1))) for each in corners]
    touching = []
    for a, b in combinations(range(len(solids)), 2):
        low, high = np.maximum(boxes[a][0], boxes[b][0]), np.minimum(boxes[a][1], boxes[b][1])
        if (low - high > VAL3DITY.snap_m).any():
            continue
        area_m2 = min(np.linalg.norm(doubled_areas(corners[k]), axis=1).sum() / 2 for k in (a, b))
        if (bodies[a] ^ bodies[b]).volume() > VAL3DITY.snap_m * area_m2:
            return OVERLAP
        if bodies[a].min_gap(bodies[b], 2 * VAL3DITY.snap_m) <= VAL3DITY.snap_m:
            touching.append((a, b))
    return APART if groups(len(solids), np.array(touching, int).reshape(-1, 2)).any() else None


def _corners(shell: Shell) -> np.ndarray:
    """float64 (t, 3, 3): the corners of the triangles of a shell, oriented as its polygons."""
    rings = [list(surface.rings) for surface in shell.surfaces]
    area = np.array([doubled_area(shell.vertex_m[face[0]]) for face in rings])
    normal = area / np.maximum(np.linalg.norm(area, axis=1), 1e-300)[:, None]
    triangle, _ = triangulated_in_space(shell.vertex_m, rings, normal)
    return shell.vertex_m[triangle]


def _manifold(corner_m: np.ndarray) -> manifold3d.Manifold:
    """The solid of triangles (t, 3, 3); vertices in one place, within the tolerance, are merged."""
    from p2wss.mesh.booleans import manifold3d

    places = np.round(corner_m.reshape(-1, 3) / VAL3DITY.snap_m).astype(np.int64)
    _, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
    triangle = number.reshape(-1, 3).astype(np.uint64)
    return manifold3d.Manifold(
        manifold3d.Mesh64(np.ascontiguousarray(corner_m.reshape(-1, 3)[first]), triangle)
    )
