"""What a network says about buildings. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Prediction:
    """Predicted parameters of b buildings.

    eave_height_m: float (b,), eave above ground. angle_deg: per building an angle per edge, over all rings in the
    order of the argument. class_probability: likewise (edges, 3), of 0 degrees, of 90 degrees and of a slope.
    probability: per building (1 + v,), uncalibrated, that the height is within 0.5 m and each angle of the exterior
    within 5 degrees. confidence: float (b,), the expected share of values that are
    (:func:`p2wss.nets.decoding.expected_share`). A footprint too large for the number format has NaN everywhere,
    no probability and confidence 0.
    """

    eave_height_m: np.ndarray
    angle_deg: list[np.ndarray]
    class_probability: list[np.ndarray]
    probability: list[np.ndarray]
    confidence: np.ndarray
