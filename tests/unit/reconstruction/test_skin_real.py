"""Skins of real rows of houses, fitted to real points, with and without their terrain."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from places import SHARED
from skin_solids import Solid, assert_closed, united, volume
from test_skin_terrain import together

from p2wss.clouds import reading as clouds
from p2wss.config import Config, Reconstruct
from p2wss.data.terrain import Terrain
from p2wss.footprints import cleaning as footprints
from p2wss.reconstruction.area import footprint_settings, window
from p2wss.reconstruction.outputs import exports
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.result import Result
from p2wss.reconstruction.skin import block_skins, skins
from p2wss.reconstruction.skin.solids import TOLERANCE_M
from p2wss.skeleton.types import FaceKind

DELFT = SHARED / "data" / "delft_ahn3"
pytestmark = pytest.mark.skipif(not DELFT.exists(), reason="no real data beside the checkout")


@pytest.fixture(scope="module")
def results() -> list[Result]:
    features = footprints.read_footprints(DELFT / "footprints.gpkg", needs_crs=False)
    frame = footprints.clean_footprints(features, footprint_settings(Config()))
    cloud = clouds.read_clouds([DELFT / "ahn3.laz"], window(frame))
    return run(frame, cloud, None, "delft", Reconstruct())


def test_rows_of_delft(results: list[Result]) -> None:
    rows = [result.reconstruction for result in results]
    solids = [Solid(row.building_id, row.placed_mesh) for row in rows]
    exact, joined = skins(dict(solids), max_lowering_m=0.0), skins(dict(solids))
    for skin in (*exact, *joined):
        assert skin.failure is None
        assert_closed(skin)
    assert max(len(skin.building_ids) for skin in joined) > 20 and len(joined) < 12
    total = sum(volume(skin.mesh.vertex_m, skin.mesh.triangle) for skin in exact)
    # roofs of neighbours within 12 cm meet, which moves a roof by a few millimetres in the mean
    assert total == pytest.approx(united(solids).volume(), rel=6e-4)
    # no vertex leaves the plane of a face, but for what is merged
    for skin in joined:
        mesh = skin.mesh.translated(-skin.mesh.vertex_m.min(axis=0))
        away_m = (mesh.planes.normal[mesh.number][:, None] * mesh.corner_m).sum(axis=2)
        offset_m = np.zeros(len(mesh.planes.normal))
        offset_m[mesh.number] = away_m[:, 0]
        away_m -= offset_m[mesh.number][:, None]
        assert np.abs(away_m[mesh.planes.area_m2[mesh.number] > 0.1]).max() < 2 * TOLERANCE_M


def test_rows_of_delft_on_their_terrain(results: list[Result]) -> None:
    with rasterio.open(DELFT / "dtm.asc") as raster:
        height = raster.read(1, masked=True).astype(np.float32).filled(np.nan)
        land = Terrain(height, raster.bounds.left, raster.bounds.top, raster.res[0])
    config = Reconstruct()
    buildings = [exports.mesh(result, config) for result in results]
    buildings, ground = exports.with_terrain(buildings, land, config)
    closed = block_skins.joined(buildings, np.inf)
    standing, with_holes = block_skins.on_terrain(closed, ground)
    assert all((skin.mesh.kind != FaceKind.GROUND).all() for skin in standing)
    corner = ground.mesh.vertex_m.min(axis=0)
    place, triangle = together(standing, with_holes.mesh, corner)
    assert volume(place, triangle) > volume(ground.mesh.vertex_m - corner, ground.mesh.triangle) + 20_000
