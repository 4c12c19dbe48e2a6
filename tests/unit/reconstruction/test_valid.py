"""Solids that break a rule: simpler fits take their place, then a flat roof with the reason."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from p2wss import skeleton
from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction
from p2wss.fit import fitting
from p2wss.fit.settings import THRESHOLDS
from p2wss.mesh import Mesh
from p2wss.mesh.repair import surfaces_to_write
from p2wss.mesh.rules import Breach
from p2wss.reconstruction import product
from p2wss.reconstruction.product import reconstruct_buildings, simpler_fits, with_valid_solids
from p2wss.skeleton.types import Polygons


def pyramid(apex_m: float, num_parts: int = 1) -> Reconstruction:
    """A hip roof on a square; its apex is moved to a height, below the floor too."""
    ring = np.array([[0, 0], [8, 0], [8, 8], [0, 8]], float)
    meshes = skeleton.build(Polygons.from_rings([[ring]]), np.full(4, 40.0), np.array([5.0]))
    mesh = Mesh.of_kernel(meshes, 0)
    vertex = mesh.vertex_m.copy()
    vertex[vertex[:, 2] > 5.5, 2] = apex_m
    return Reconstruction(
        "a", "t", "fit", reasons.OK, (1e5, 2e5), 10.0, [ring], 5.0, np.full(4, 40.0), mesh.moved(vertex), num_parts
    )  # fmt: skip


def building() -> Building:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.2, 7.8, (300, 2))
    points = np.column_stack([xy, np.full(300, 6.0)])
    ground = np.column_stack([rng.uniform(-1, 0, (20, 2)), np.zeros(20)])
    return Building(
        "a",
        "t",
        (1e5, 2e5),
        pyramid(7).rings,
        np.vstack([points, ground]),
        np.repeat([6, 2], [300, 20]),
        10.0,
    )


def test_a_valid_solid_stays_as_it_is() -> None:
    good = pyramid(8)
    (after,) = with_valid_solids([good], [building()])
    assert is_same(after, good)


def is_same(after: Reconstruction, before: Reconstruction) -> bool:
    """Whether two solids are the same, except that walls may be put exactly on the footprint."""
    return np.array_equal(after.mesh.triangle, before.mesh.triangle) and np.allclose(
        after.mesh.vertex_m, before.mesh.vertex_m, atol=1e-6
    )


def test_the_first_valid_simpler_one_takes_the_place() -> None:
    bad, worse, good = pyramid(-2, 3), pyramid(-1), pyramid(8)
    assert {breach.code for breach in surfaces_to_write(bad.placed_mesh)[1]} == {306}
    rows = []

    def simpler(row: int) -> Iterator[Reconstruction]:
        rows.append(row)
        yield from [replace(good, mesh=None), worse, good]

    first, second = with_valid_solids([good, bad], [building()] * 2, simpler)
    assert is_same(first, good) and is_same(second, good) and rows == [1]


def test_without_a_simpler_one_there_is_no_mesh() -> None:
    (after,) = with_valid_solids([pyramid(-2)], [building()])
    assert not after.has_mesh and after.status == reasons.INVALID_SOLID


def test_simpler_fits_have_fewer_faces_then_the_parameters_of_the_paper(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = []

    def fit(buildings: Any, config: Reconstruct, *others: Any) -> list[Reconstruction]:
        thresholds = others[0] if others else THRESHOLDS
        dearer = thresholds.planes.prices.face_m3 / THRESHOLDS.planes.prices.face_m3
        asked.append((config.detail, config.roofs, dearer))
        return [pyramid(8)]

    monkeypatch.setattr(fitting, "fit", fit)
    list(simpler_fits(building(), Reconstruct(detail="high")))
    assert asked == [*(("high", "planes", factor) for factor in (2, 4, 8)), ("high", "parametric", 1)]


def test_the_product_falls_back_to_a_flat_roof_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    (fitted,) = reconstruct_buildings([building()], None, Reconstruct())
    assert fitted.status == reasons.OK and fitted.method == "fit"
    monkeypatch.setattr(fitting, "fit", lambda buildings, *_: [pyramid(-2)] * len(buildings))
    (flat,) = reconstruct_buildings([building()], None, Reconstruct())
    assert (flat.method, flat.status) == ("lod1", reasons.INVALID_SOLID)
    assert flat.has_mesh and flat.eave_height_m == pytest.approx(6.0)
    # nothing is valid
    monkeypatch.setattr(product, "surfaces_to_write", lambda mesh, origin_m: ([], [Breach(302)]))
    (none,) = reconstruct_buildings([building()], None, Reconstruct())
    assert not none.has_mesh and none.status == reasons.INVALID_SOLID
