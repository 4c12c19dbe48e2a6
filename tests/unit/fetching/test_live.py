"""What the code needs of IGN's services: of the real ones weekly, of what stands for them in other tests always."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from pytest_httpserver import HTTPServer

from p2wss.config import load
from p2wss.fetching.bdtopo import SPELLINGS, normalise
from p2wss.fetching.geoplateforme import GeoplateformeSource

from .service import serve_miniature

CRS = "EPSG:2154"
# in Paris, and in the miniature
BOUNDS = (653100.0, 6860700.0, 653300.0, 6860900.0)


@pytest.fixture(params=[pytest.param("ign", marks=pytest.mark.live), "imitation"])
def source(request: pytest.FixtureRequest, httpserver: HTTPServer, tmp_path: Path) -> GeoplateformeSource:
    served = {} if request.param == "ign" else serve_miniature(httpserver)
    # several pages, and several maps
    limits = {"page_size": 10, "dtm_max_pixels": 150}
    config = load({"fetch": served}, {"fetch": {"geoplateforme": limits}}).fetch.geoplateforme
    return GeoplateformeSource(config, CRS, tmp_path, None)


def test_footprints_have_the_columns_and_the_crs(source: GeoplateformeSource) -> None:
    footprints = source.footprints(BOUNDS)
    assert len(footprints) > source.config.page_size and footprints["cleabs"].is_unique
    assert {wfs for wfs, _ in SPELLINGS.values()} <= set(footprints.columns)
    assert footprints.envelope.intersects(shapely.box(*BOUNDS)).all()
    rows = normalise(footprints, CRS, source.name)
    assert (
        rows["hauteur_m"].between(1, 350).mean() > 0.5
        and rows["building_id"].str.startswith("BATIMENT").all()
    )


def test_terrain_is_heights_of_the_requested_cells(source: GeoplateformeSource) -> None:
    heights_m = source.dtm(BOUNDS).height_m
    assert min(heights_m.shape) > source.config.dtm_max_pixels
    assert np.isfinite(heights_m).all() and 20 < heights_m.min() <= heights_m.max() < 150


def test_an_index_lists_lidar_that_can_be_downloaded(
    source: GeoplateformeSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its first bytes, as a tile has some hundred megabytes."""
    seen: list[str] = []

    def begin(url: str, path: Path, magic: bytes) -> None:
        with source.client._response(url, {}) as response:
            assert next(response.iter_content(len(magic))) == magic
        seen.append(url)

    monkeypatch.setattr(source.client, "download", begin)
    monkeypatch.setattr(
        source, "_tiles", lambda urls: [source._download(url, tmp_path / "tile") for url in urls]
    )
    assert len(source.lidar(BOUNDS)) == len(seen) == 1
