"""What a network says about buildings. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Prediction:
    """Predicted parameters of b buildings.

    eave_height_m: float (b,), eave above ground. angle_deg: per building an angle per edge, over all rings in the
    order of the argument. class_probability: likewise (edges, 3), of 0 degrees, of 90 degrees and of a slope.
    A footprint too large for the number format has NaN everywhere.
    """

    eave_height_m: np.ndarray
    angle_deg: list[np.ndarray]
    class_probability: list[np.ndarray]
