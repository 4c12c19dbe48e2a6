"""Faces over open ground within a footprint: no roofs in the measures, and drawn in a colour of their own."""

from __future__ import annotations

import numpy as np
import pytest
from yard_house import yard_house

from p2wss.config import Config
from p2wss.data.building import Building
from p2wss.eval.cases import Case
from p2wss.eval.measure import measure_building
from p2wss.formats.viewer import FACE_COLORS
from p2wss.mesh.surface import sample_surface
from p2wss.skeleton.types import FaceKind
from p2wss.storage.schemas.crops import REAL


def test_the_floor_of_a_yard_is_no_roof() -> None:
    """All points are on the roof: with the yard, the chamfer distance would be that of the whole mesh."""
    row = yard_house()
    roof = np.isin(row.mesh.kind, (FaceKind.ROOF, FaceKind.FLAT))
    point_m = sample_surface(row.mesh.vertex_m, row.mesh.triangle[roof], 1500, np.random.default_rng(0))
    classes = np.full(len(point_m), 6, np.uint8)
    building = Building(
        "yard",
        "t",
        row.origin_xy_m,
        list(row.rings),
        point_m,
        classes,
        row.ground_z_m,
    )
    measured = measure_building(Case(REAL, building, 1.0, None, None, None, None), row, Config())
    assert measured["roof_chamfer_m"] == pytest.approx(0.1, abs=0.05)
    assert measured["chamfer_m"] > 1 and measured["points_to_mesh_m"] < 1e-6


def test_every_kind_of_face_has_a_colour() -> None:
    assert set(FACE_COLORS) == set(FaceKind) and len(set(FACE_COLORS.values())) == len(FaceKind)
