"""A gable house of 8 m by 8 m in a footprint that includes a yard of 6 m by 8 m, as the fit reconstructs it."""

from __future__ import annotations

import numpy as np
from kernel_unions import union

from p2wss.data import reasons
from p2wss.data.building import Reconstruction
from p2wss.fit.fitting import with_floors
from p2wss.fit.parametric import FittedRoof

HOUSE_M2, YARD_M2, YARD_M, EAVE_M, SLOPE_DEG = 64.0, 48.0, 1.0, 5.0, 40.0
FOOTPRINT = np.array([[0, 0], [14, 0], [14, 8], [0, 8.0]])


def yard_house(x_m: float = 652000.0, y_m: float = 6861000.0, ground_z_m: float = 100.0) -> Reconstruction:
    """The house is at x from 0 to 8 m, its yard beside it."""
    house, yard = FOOTPRINT * [8 / 14, 1], FOOTPRINT * [6 / 14, 1] + [8, 0]
    angle_deg = np.array([SLOPE_DEG, 90, SLOPE_DEG, 90])
    parts = [
        FittedRoof([house], angle_deg, EAVE_M, 0.0),
        FittedRoof([yard], np.zeros(4), 0.2, 0.0),
    ]
    mesh = union(parts, YARD_M, 12.0)
    in_yard = np.array([[11.0, 4.0, 0.2]])
    marked = with_floors(mesh, in_yard, 1)
    return Reconstruction(
        "yard", "t", "fit", reasons.OK, (x_m, y_m), ground_z_m, [FOOTPRINT], EAVE_M, angle_deg,
        marked, 2,
    )  # fmt: skip
