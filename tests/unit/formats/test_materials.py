"""Materials: BD TOPO's codes, and the same names in the settings and in the table."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from p2wss.config.reconstruct import MaterialName, Materials
from p2wss.formats.materials import DEFAULTS, MATERIALS, ROOF_CODES, WALL_CODES, materials_of


@pytest.mark.parametrize(
    ("walls", "roof", "expected"),
    [
        ("10", "01", {"wall": "stone", "roof": "tile"}),
        ("20", "10", {"wall": "millstone", "roof": "tile"}),
        ("35", "29", {"wall": "concrete", "roof": "slate"}),
        ("05", "93", {"wall": "concrete_block", "roof": "zinc"}),
        ("16", "4", {"wall": "stone", "roof": "concrete"}),
        # tables that have stored the codes as numbers
        (5, 20.0, {"wall": "concrete_block", "roof": "slate"}),
        # unknown and other
        ("00", "90", {}),
        (None, np.nan, {}),
        ("", "x", {}),
    ],
)
def test_codes(walls: object, roof: object, expected: dict[str, str]) -> None:
    served = {"cleabs": "B1", "materiaux_des_murs": walls, "materiaux_de_la_toiture": roof}
    delivered = {"ID": "B1", "MAT_MURS": walls, "MAT_TOITS": roof}
    assert materials_of(served) == materials_of(delivered) == expected


def test_other_tables_state_no_material() -> None:
    assert materials_of({"identificatie": "1", "wall": "10"}) == {} == materials_of({})


def test_every_material_can_be_set_and_every_code_has_one() -> None:
    assert set(get_args(MaterialName)) == set(MATERIALS)
    names = {*WALL_CODES.values(), *ROOF_CODES.values(), *DEFAULTS.values()}
    assert names <= set(MATERIALS)
    settings = Materials()
    assert (settings.wall, settings.roof, settings.ground) == (
        DEFAULTS["wall"],
        DEFAULTS["roof"],
        DEFAULTS["terrain"],
    )
