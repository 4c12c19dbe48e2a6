"""Electrical properties of building materials, Recommendation ITU-R P.2040, as Sionna RT 2.2 has them too."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class _Fit:
    """Relative permittivity a f^b and conductivity c f^d in S/m, for the frequency f in GHz from low to high."""

    low: float
    high: float
    a: float
    b: float
    c: float
    d: float


# ITU-R P.2040, table 3 (the rows of materials that p2wss names)
TABLE = {
    "concrete": (_Fit(1, 100, 5.24, 0, 0.0462, 0.7822), _Fit(110, 330, 5.17, 0, 0.0145, 1.09)),
    "brick": (_Fit(1, 40, 3.91, 0, 0.0238, 0.16), _Fit(110, 330, 4.15, 0, 0.0006, 1.5712)),
    "plasterboard": (_Fit(1, 100, 2.73, 0, 0.0085, 0.9395), _Fit(110, 330, 2.56, 0, 0.0001, 1.7799)),
    "wood": (_Fit(0.001, 100, 1.99, 0, 0.0047, 1.0718), _Fit(110, 330, 1.82, 0, 0.004, 1.0761)),
    "glass": (_Fit(0.1, 100, 6.31, 0, 0.0036, 1.3394), _Fit(220, 450, 5.79, 0, 0.0004, 1.658)),
    "chipboard": (_Fit(1, 100, 2.58, 0, 0.0217, 0.78), _Fit(100, 200, 2.16, 0, 0.0023, 1.359)),
    "plywood": (_Fit(1, 40, 2.71, 0, 0.33, 0), _Fit(110, 330, 1.94, 0, 0.0067, 0.9982)),
    "marble": (_Fit(1, 60, 7.074, 0, 0.0055, 0.9262), _Fit(110, 330, 7.94, 0, 0.0001, 1.733)),
    "metal": (_Fit(1, 100, 1, 0, 1e7, 0),),
    "very_dry_ground": (_Fit(1, 10, 3, 0, 0.00015, 2.52),),
    "medium_dry_ground": (_Fit(1, 10, 15, -0.1, 0.035, 1.63),),
    "wet_ground": (_Fit(1, 10, 30, -0.4, 0.15, 1.3),),
}


@dataclass(frozen=True)
class Properties:
    """Properties at a frequency. valid_ghz: the range of frequencies of the row of the table. held_from_ghz: the end of
    this range from which the complex permittivity was taken; None if the range contains the frequency."""

    relative_permittivity: float
    conductivity_s_per_m: float
    valid_ghz: tuple[float, float]
    held_from_ghz: float | None


def properties(itu_type: str, frequency_ghz: float) -> Properties:
    """The properties of a type in :data:`TABLE`.

    At a frequency for which the recommendation does not define them, the complex permittivity of the nearest defined
    frequency is used. The conductivity then grows in proportion to the frequency.
    """
    nearest = [(fit, min(max(frequency_ghz, fit.low), fit.high)) for fit in TABLE[itu_type]]
    fit, valid = min(nearest, key=lambda pair: abs(math.log(pair[1] / frequency_ghz)))
    permittivity = fit.a * valid**fit.b
    conductivity = fit.c * valid**fit.d * frequency_ghz / valid
    held_from_ghz = None if valid == frequency_ghz else valid
    return Properties(permittivity, conductivity, (fit.low, fit.high), held_from_ghz)
