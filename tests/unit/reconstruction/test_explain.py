"""Why a roof is as it is: ``p2wss explain`` and ``Scene.explain``."""

from __future__ import annotations

import re
from pathlib import Path

import control_houses as houses
import geopandas as gpd
import numpy as np
import pytest
import shapely

import p2wss
from p2wss import cli
from p2wss.fit import fitting
from p2wss.reconstruction import explain

PLACE = "EPSG:26910"


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    houses.footprints(PLACE).to_file(tmp_path / "f.gpkg")
    return houses.write_cloud(tmp_path / "c.laz", PLACE, PLACE), tmp_path / "f.gpkg"


def test_the_planes_of_a_gable_roof(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = np.meshgrid(np.arange(-4, 14, 0.4), np.arange(-4, 10, 0.4))
    inside = (x > 0) & (x < 10) & (y > 0) & (y < 6)
    z = np.where(inside, 5 + np.minimum(y, 6 - y), 0)
    points = np.column_stack([each.ravel() for each in (x, y, z, np.where(inside, 6, 2))])
    footprints = gpd.GeoDataFrame({"id": ["a"]}, geometry=[shapely.box(0, 0, 10, 6)], crs=2154)
    with p2wss.reconstruct(points, footprints, model="none", progress=False) as scene:
        explanation = scene.explain("a")
        solid, again = scene["a"].solid, explanation.building.solid
    assert solid is not None and again is not None and (solid.vertex_m == again.vertex_m).all()
    text = str(explanation)
    assert text.startswith("a: ok, method fit\n2 of 2 planes are used")
    # the slope is that which was drawn, the planes face away from each other, and each of them saves much
    rows = [line.split() for line in text.splitlines() if re.match(r" +\d", line)]
    assert [float(row[3]) for row in rows] == pytest.approx([45, 45], abs=0.1)
    assert sorted(float(row[4]) for row in rows) == pytest.approx([0, 180], abs=0.1)
    assert all(float(row[6]) > 5 for row in rows)
    # what is left of the cost is edges and faces
    cost = dict(re.findall(r"([a-z ]+) (\d+\.\d+)", text.splitlines()[-1]))
    total_m3 = float(cost.pop("cost"))
    assert total_m3 == pytest.approx(sum(map(float, cost.values())), abs=0.02)
    assert float(cost[" points off the planes"]) < 0.1 * total_m3
    assert fitting.TRACE.get() is None
    monkeypatch.setattr(explain, "_MAX_COMPARED", 1)
    assert str(explanation).count("too many planes") == 2


def test_open_ground_is_no_plane_of_the_building() -> None:
    """The other half of the footprint is a yard, whose ground the points show."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-3.8, 24, 0.4), np.arange(-3.8, 12, 0.4)))
    inside = (x > 0) & (x < 10) & (y > 0) & (y < 8)
    points = np.column_stack([x, y, np.where(inside, 5, 0), np.where(inside, 6, 2)])
    footprints = gpd.GeoDataFrame({"id": ["a"]}, geometry=[shapely.box(0, 0, 20, 8)], crs=2154)
    with p2wss.reconstruct(points, footprints, model="none", progress=False) as scene:
        built_m2, text = scene["a"].attributes["ground_area_m2"], str(scene.explain("a"))
    assert built_m2 == pytest.approx(80, abs=4)
    (stated_m2,) = re.findall(r"1 of 2 planes are used; \d+ points on (\d+) m2", text)
    assert float(stated_m2) == pytest.approx(built_m2, abs=1)
    assert text.count("open ground: outside the building") == 1


def test_a_building_without_points_is_explained_as_the_run_has_it() -> None:
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-3.8, 24, 0.4), np.arange(-3.8, 12, 0.4)))
    inside = (x > 0) & (x < 10) & (y > 0) & (y < 8)
    points = np.column_stack([x, y, np.where(inside, 5, 0), np.where(inside, 6, 2)])
    shapes = [shapely.box(each, 0, each + 10, 8) for each in (0, 200, 400)]
    table = {"id": ["a", "b", "c"], "height": [5.0, 6.0, np.nan]}
    footprints = gpd.GeoDataFrame(table, geometry=shapes, crs=2154)
    config = {"reconstruct": {"height_field": "height"}}
    with p2wss.reconstruct(points, footprints, model="none", progress=False, config=config) as scene:
        texts = [str(scene.explain(each)) for each in ("b", "c")]
    assert texts[0].startswith("b: flat (height-from-attribute), method lod1\nno planes")
    assert texts[1].startswith("c: none (no-points), method None\nno planes")


def test_a_limit_of_triangles_decides_nothing_for_one_building(files: tuple[Path, Path]) -> None:
    """It would be fitted once more, at low detail, and that be explained, as if the first solid were not valid."""
    texts = []
    for limit in (None, 4):
        config = {"reconstruct": {"max_triangles": limit}}
        with p2wss.reconstruct(*files, model="none", progress=False, config=config) as scene:
            texts.append(str(scene.explain("gable")))
    assert texts[0] == texts[1] and "cost" in texts[0]


def test_a_parametric_building_has_no_planes(files: tuple[Path, Path]) -> None:
    config = {"reconstruct": {"roofs": "parametric"}}
    with p2wss.reconstruct(*files, model="none", progress=False, config=config) as scene:
        assert "no planes were fitted" in str(scene.explain("gable"))


def test_the_command(files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["explain", *map(str, files)]
    assert cli.main([*words, "gable", "--out", str(tmp_path / "why.svg")]) == 0
    assert "2 of 4 planes are used" in capsys.readouterr().out
    assert (tmp_path / "why.svg").read_text().count("<svg") == 1
    assert cli.main([*words, "gabel"]) == 2
    assert "has no building gabel" in capsys.readouterr().err
    assert cli.main([*words, "gable", "--out", str(tmp_path / "why.pdf")]) == 2
    assert "a picture is a .svg or a .png file" in capsys.readouterr().err
    assert cli.main(["explain", str(files[0]), "gable"]) == 2
    assert not (tmp_path / "why.pdf").exists()


def test_a_scene_of_a_file_has_no_points(files: tuple[Path, Path], tmp_path: Path) -> None:
    with p2wss.reconstruct(*files, model="none", progress=False) as scene:
        path = next(each for each in scene.write(tmp_path, ["cityjson"], "a") if ".city." in each.name)
    with pytest.raises(p2wss.InputError, match="has no points"):
        p2wss.read(path).explain("gable")


def test_a_footprint_in_parts_is_explained_part_by_part(files: tuple[Path, Path]) -> None:
    frame = gpd.read_file(files[1])
    whole = gpd.GeoDataFrame(
        {"id": ["both"]}, geometry=[shapely.MultiPolygon(list(frame.geometry[:2]))], crs=frame.crs
    )
    with p2wss.reconstruct(files[0], whole, model="none", progress=False) as scene:
        assert str(scene.explain("both-1")).startswith("both-1: ok")
        with pytest.raises(p2wss.InputError, match="both: is in parts; choose from both-1, both-2"):
            scene.explain("both")
