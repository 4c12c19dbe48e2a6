"""What a network says about buildings. Imports no torch."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Prediction:
    """Predicted parameters of b buildings.

    eave_height_m: float (b,), eave above ground. angle_deg: per building an angle per edge, over all rings in the
    order of the argument. A footprint too large for the number format has NaN everywhere.
    """

    eave_height_m: np.ndarray
    angle_deg: list[np.ndarray]
