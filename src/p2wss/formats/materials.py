"""Materials of walls, roofs and ground: names, their types in ITU-R P.2040, colours, and the codes of BD TOPO.

BD TOPO's ``materiaux_des_murs`` and ``materiaux_de_la_toiture`` (``MAT_MURS`` and ``MAT_TOITS`` in shapefiles) hold two
characters from the tax files, one for each of two materials: the variables ``dmatgm`` (matériaux des gros murs) and
``dmatto`` (matériaux des toitures) of the "fichiers fonciers". Source: IGN, "BD TOPO, descriptif de contenu", class
Bâtiment, and the dictionary of the fichiers fonciers (Cerema), which both list the digits.
"""

from __future__ import annotations

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
