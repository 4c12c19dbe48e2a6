"""Open ground within a footprint that stays, as the building would be in pieces without it: its faces are no roofs."""

from dataclasses import replace

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.surface import topmost
from p2wss.skeleton.types import FaceKind

# a level face higher above the ground than this is a roof, whatever points are over it
_MAX_HEIGHT_M = 2.0


def with_floors(mesh: Mesh, point_m: np.ndarray, num_open: int) -> Mesh:
    """The mesh with the kind ``FLOOR`` for open ground. At least one face remains a roof.

    point_m: (m, 3), the points to which the roof is fitted; the last ``num_open`` are of open ground. A face
    is open ground if it is level, at most 2 m above the ground, and most of the points over it are of open ground.
    """
    if not num_open:
        return mesh
    kind = mesh.kind
    is_low = (kind == FaceKind.FLAT) & (mesh.corner_m[:, :, 2].max(axis=1) <= _MAX_HEIGHT_M)
    # the label of the face over each point plus one, 0 for none
    over = np.append(mesh.label[is_low], -1)[topmost(mesh.corner_m[is_low], point_m)[0]] + 1
    size = mesh.label.max() + 2
    num, num_ground = (np.bincount(each, minlength=size) for each in (over, over[-num_open:]))
    is_floor = is_low & (2 * num_ground > num)[mesh.label + 1]
    is_roof = ((kind == FaceKind.ROOF) | (kind == FaceKind.FLAT)) & ~is_floor
    kind = np.where(is_floor, np.uint8(FaceKind.FLOOR), kind)
    return replace(mesh, kind=kind) if is_roof.any() else mesh
