"""Materials of walls, roofs and ground: names, their types in ITU-R P.2040 with the electrical properties that it
states (as Sionna RT 2.2 has them, too), colours, and the codes of BD TOPO.

BD TOPO's ``materiaux_des_murs`` and ``materiaux_de_la_toiture`` (``MAT_MURS`` and ``MAT_TOITS`` in shapefiles) hold two
characters from the tax files, one for each of two materials: the variables ``dmatgm`` (matériaux des gros murs) and
``dmatto`` (matériaux des toitures) of the "fichiers fonciers". Source: IGN, "BD TOPO, descriptif de contenu", class
Bâtiment, and the dictionary of the fichiers fonciers (Cerema), which both list the digits.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Material:
    """itu_type: type of ITU-R P.2040, the nearest one for a material that the recommendation does not list.
    colour: red, green, blue in sRGB, 0 to 255."""

    itu_type: str
    colour: tuple[int, int, int]


# the recommendation whose types (table 3) are used
EDITION = "ITU-R P.2040-3"
# the types of the recommendation that occur outdoors, and the materials of BD TOPO
MATERIALS = {
    "concrete": Material("concrete", (186, 184, 178)),
    "brick": Material("brick", (165, 92, 70)),
    "wood": Material("wood", (150, 111, 72)),
    "glass": Material("glass", (150, 178, 190)),
    "marble": Material("marble", (214, 208, 192)),
    "metal": Material("metal", (140, 146, 152)),
    "plasterboard": Material("plasterboard", (222, 218, 208)),
    "chipboard": Material("chipboard", (178, 146, 104)),
    "plywood": Material("plywood", (190, 158, 116)),
    "very_dry_ground": Material("very_dry_ground", (176, 160, 124)),
    "medium_dry_ground": Material("medium_dry_ground", (146, 158, 122)),
    "wet_ground": Material("wet_ground", (108, 124, 92)),
    # natural stone: the only one of the recommendation is marble
    "stone": Material("marble", (205, 196, 182)),
    "millstone": Material("marble", (188, 160, 120)),
    "slate": Material("marble", (86, 94, 106)),
    "concrete_block": Material("concrete", (172, 170, 166)),
    # fired clay, as brick is
    "tile": Material("brick", (178, 98, 66)),
    "zinc": Material("metal", (150, 158, 168)),
}
# default material of each surface; the floor ("ground") is not seen from outside, an outer floor is open ground
DEFAULTS = {
    "wall": "concrete",
    "roof": "concrete",
    "ground": "concrete",
    "outer_floor": "medium_dry_ground",
    "terrain": "medium_dry_ground",
    "vegetation": "wood",
}

# 0 is unknown (indéterminé), 9 is other (autres)
WALL_CODES = {
    "1": "stone",  # pierre
    "2": "millstone",  # meulière
    "3": "concrete",  # béton
    "4": "brick",  # briques
    "5": "concrete_block",  # aggloméré
    "6": "wood",  # bois
}
ROOF_CODES = {
    "1": "tile",  # tuiles
    "2": "slate",  # ardoises
    "3": "zinc",  # zinc, aluminium
    "4": "concrete",  # béton
}
# for each surface: names of the column, in lower case, and the meanings of its digits
_COLUMNS = {
    "wall": (("materiaux_des_murs", "mat_murs"), WALL_CODES),
    "roof": (("materiaux_de_la_toiture", "mat_toits"), ROOF_CODES),
}


def materials_of(row: Mapping[str, Any]) -> dict[str, str]:
    """The materials that a footprint's columns state, by the name of the surface (``wall``, ``roof``).

    row: values of the input columns by their names. Of two materials, the first known one is taken. A surface with an
    unknown or another material is not in the result.

    >>> materials_of({"MAT_MURS": "49", "MAT_TOITS": "00"})
    {'wall': 'brick'}
    """
    by_name = {str(name).lower(): value for name, value in row.items()}
    result = {}
    for surface, (columns, codes) in _COLUMNS.items():
        digits = [digit for column in columns for digit in _digits(by_name.get(column))]
        known = [codes[digit] for digit in digits if digit in codes]
        if known:
            result[surface] = known[0]
    return result


def _digits(code: Any) -> str:
    """The digits of a code as text; a number, as some files store it, gets two digits: 5 is 05. "" without a code."""
    if isinstance(code, (int, float)) and not isinstance(code, bool):
        return f"{int(code):02d}" if math.isfinite(code) else ""
    return code.strip() if isinstance(code, str) else ""


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
