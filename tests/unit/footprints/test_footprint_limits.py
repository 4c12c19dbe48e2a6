"""Geometries of every kind: repaired or with a reason, in seconds."""

from __future__ import annotations

import time
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from feature_tables import clean_footprints, read_footprints

from p2wss.config import Scenes
from p2wss.footprints.limits import repaired


def star(num_vertices: int) -> shapely.Polygon:
    angle = 2 * np.pi * np.arange(num_vertices) * (num_vertices // 2 - 1) / num_vertices
    return shapely.Polygon(30 * np.column_stack([np.cos(angle), np.sin(angle)]))


def circle(num_vertices: int, noise_m: float, radius_m: float = 20.0) -> shapely.Polygon:
    angle = 2 * np.pi * np.arange(num_vertices) / num_vertices
    radius = radius_m + np.random.default_rng(1).normal(0, noise_m, num_vertices)
    return shapely.Polygon(radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))


@pytest.mark.parametrize(
    ("shape", "reason"),
    [
        (star(1_000_001), "too-many-edges"),
        (star(2001), "too-many-crossings"),
        (circle(20_000, 0.5), None),
        (circle(100_000, 0.05), "too-many-edges"),
        (circle(100_000, 0.0), "ok"),
        (shapely.box(0, 0, 1e5, 1e5), "implausible-size"),
        (circle(20_000, 1000, 5e4), "implausible-size"),
    ],
)
def test_a_hard_footprint_is_repaired_or_has_a_reason_within_ten_seconds(
    shape: shapely.Polygon, reason: str | None
) -> None:
    neighbour = shapely.box(19.9, 100, 30, 110)
    frame = gpd.GeoDataFrame({"building_id": ["a", "b"]}, geometry=[shape, neighbour], crs=2154)
    start = time.process_time()
    result = clean_footprints(frame, Scenes(simplify_m=0.3))
    assert time.process_time() - start < 10
    status = dict(zip(result["building_id"], result["status"], strict=True))
    assert status["b"] == "ok"
    if reason is not None:
        assert status["a"] == reason
    if reason == "ok":
        assert result.geometry.iloc[0].area == pytest.approx(shape.area, rel=0.02)


def test_a_star_of_few_vertices_is_repaired() -> None:
    shapes, reason = repaired(np.array([star(41)]))
    assert list(reason) == ["ok"] and shapes[0].is_valid and shapes[0].area > 1000


def test_thinning_stays_within_its_tolerance() -> None:
    shape = circle(50_000, 0.02)
    shapes, reason = repaired(np.array([shape]), 0.2)
    assert list(reason) == ["ok"] and len(shapes[0].exterior.coords) < 1000
    assert shapely.hausdorff_distance(shapes[0].exterior, shape.exterior) < 0.2


def test_a_tiny_courtyard_of_many_vertices_goes() -> None:
    house = shapely.box(-9, -9, 9, 9)
    shapes, reason = repaired(
        np.array([shapely.Polygon(house.exterior, [circle(3000, 0, 0.01).exterior])]), 0.2
    )
    assert list(reason) == ["ok"] and shapes[0].equals(house)


def test_few_vertices_are_not_changed() -> None:
    shape = circle(1500, 0.001)
    shapes, _ = repaired(np.array([shape]))
    assert shapes[0].equals_exact(shape, 0)


# what files can hold, as text of CSV files of GDAL
GEOMETRIES = {
    "CURVEPOLYGON (COMPOUNDCURVE (CIRCULARSTRING (0 0,5 5,10 0),(10 0,0 0)))": ("ok", np.pi * 12.5),
    "MULTISURFACE (CURVEPOLYGON (CIRCULARSTRING (0 0,5 5,10 0,5 -5,0 0)))": ("ok", np.pi * 25),
    "GEOMETRYCOLLECTION (POLYGON ((0 0,9 0,9 9,0 9,0 0)),POINT (1 1))": ("ok", 81),
    "GEOMETRYCOLLECTION (POINT (1 1),LINESTRING (0 0,1 1))": ("not-a-polygon", 0),
    "TIN Z (((0 0 1,9 0 1,9 9 1,0 0 1)),((0 0 1,9 9 1,0 9 4,0 0 1)))": ("ok", 81),
    "POLYHEDRALSURFACE Z (((0 0 0,9 0 0,9 9 0,0 9 0,0 0 0)),((0 0 0,9 0 0,9 0 5,0 0 5,0 0 0)))": ("ok", 81),
    "POLYGON ZM ((0 0 1 2,9 0 1 2,9 9 1 2,0 9 1 2,0 0 1 2))": ("ok", 81),
    "POLYGON ((0 0,9 0,9 9,0 9))": ("ok", 81),
    "POLYGON ((0 0,9 0,9 nan,0 9,0 0))": ("non-finite", 0),
    "POLYGON EMPTY": ("empty", 0),
    "": ("empty", 0),
    "LINESTRING (0 0,9 9)": ("not-a-polygon", 0),
    "POINT (3 3)": ("not-a-polygon", 0),
}


@pytest.mark.parametrize(
    "rows", [list(GEOMETRIES), [g for g in GEOMETRIES if "TIN" not in g and "HEDRAL" not in g]]
)
def test_a_file_of_all_kinds_of_geometries_has_a_row_for_each(tmp_path: Path, rows: list[str]) -> None:
    # GDAL reads a shape that is not finite as no shape
    path = tmp_path / "f.csv"
    path.write_text("name,WKT\n" + "".join(f'B{i},"{text}"\n' for i, text in enumerate(rows)))
    frame = read_footprints(path, "name", needs_crs=False)
    # each at its own place
    frame.geometry = [
        shape and shapely.transform(shape, lambda xy, k=k: xy + np.array([100.0 * k, 0.0]))
        for k, shape in enumerate(frame.geometry)
    ]
    result = clean_footprints(frame, Scenes(snap_m=0, simplify_m=0))
    assert list(result["building_id"]) == [f"B{i}" for i in range(len(rows))]
    for text, status, shape in zip(rows, result["status"], result.geometry, strict=True):
        expected, area = GEOMETRIES[text]
        assert status in ({expected, "empty"} if expected == "non-finite" else {expected}), text
        assert shape.area == pytest.approx(area, rel=0.02), text
