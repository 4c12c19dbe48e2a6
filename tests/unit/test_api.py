"""The public interface: the examples of its page and of its docstrings, and what these do not show."""

from __future__ import annotations

import base64
import copy
import doctest
import html
import inspect
import json
import os
import pickle
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pytest
import shapely
import trimesh
from matplotlib import pyplot
from places import ROOT, SHARED

import p2wss
from p2wss.reconstruction.inputs import open_clouds

PAGE = ROOT / "docs" / "manual" / "python.md"
DELFT = SHARED / "data" / "delft_ahn3"


def test_every_example_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) > 6
    names: dict[str, object] = {}
    for block in blocks:
        exec(block, names)
    assert {"survey.city.json", "survey.glb"} <= {path.name for path in (tmp_path / "out").iterdir()}


@pytest.mark.parametrize("name", ["neighbourhood", "simulated_scan"])
def test_every_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    notebook = json.loads((ROOT / f"docs/notebooks/{name}.ipynb").read_text(encoding="utf-8"))
    names: dict[str, object] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    pyplot.close("all")


def test_the_examples_of_docstrings() -> None:
    runner = doctest.DocTestRunner()
    for each in (p2wss, *(inspect.unwrap(getattr(p2wss, name)) for name in p2wss.__all__)):
        for examples in doctest.DocTestFinder(recurse=False).find(each, globs=dict(vars(p2wss))):
            runner.run(examples)
    assert runner.tries > 10 and runner.failures == 0


def test_importing_it_imports_nothing_slow() -> None:
    code = "import sys, p2wss; print([name for name in ('numpy', 'torch', 'shapely') if name in sys.modules])"
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    output = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert output.stdout.strip() == "[]", output.stderr


def test_functions_stay_functions_when_their_packages_are_imported() -> None:
    """No package has the name of a function, which its import would replace."""
    import p2wss.fetching.http

    assert callable(p2wss.reconstruct) and callable(p2wss.fetch)


HOST = """
import gc, os, pickle, sqlite3, sys
affinity = getattr(os, "sched_getaffinity", lambda _: None)
state = lambda: (dict(os.environ), [name for name, each in sys.modules.items() if each is None], affinity(0))
before = state()
import p2wss
import geopandas, shapely
from test_api import footprints, gable_points
before = before[0], state()[1], before[2]  # other packages try for modules that they can do without
scene = p2wss.reconstruct(gable_points(), footprints()[:1], model="none", progress=False)
scene.write(sys.argv[1], ["gpkg", "glb"])
assert state() == before and gc.isenabled() and gc.get_freeze_count() == 0
for path in (f"{sys.argv[1]}/cloud.gpkg", f"{sys.argv[1]}/own.gpkg"):
    geopandas.GeoSeries([shapely.box(0, 0, 1, 1)], crs=2154).to_file(f"{sys.argv[1]}/own.gpkg")
    print(sqlite3.connect(path).execute("SELECT last_change FROM gpkg_contents").fetchone()[0][:4])
"""


def test_the_process_of_the_host_is_as_before(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT / "tests/unit")])}
    environment.pop("OGR_CURRENT_DATE", None)
    words = [sys.executable, "-c", HOST, str(tmp_path)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    ours, own = done.stdout.split()
    assert (
        ours == "1970" and int(own) >= 2025
    )  # the same bytes in every run; the host's files have their time


def test_names_are_those_of_the_interface() -> None:
    assert {*dir(p2wss)} == {*p2wss.__all__, "__version__"}
    words = [sys.executable, "-m", "p2wss", "--version"]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    output = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert output.stdout == f"p2wss {p2wss.__version__}\n", output.stderr


def test_a_scene_can_be_copied_and_pickled(tmp_path: Path) -> None:
    scene = p2wss.reconstruct(gable_points(), footprints()[:1], model="none", progress=False)
    for each in (pickle.loads(pickle.dumps(scene)), copy.copy(scene), copy.deepcopy(scene)):
        np.testing.assert_array_equal(each["a"].mesh.vertices, scene["a"].mesh.vertices)
        assert each.summary == scene.summary and dict(each["a"].attributes) == dict(scene["a"].attributes)
        assert each.crs == scene.crs and len(each.write(tmp_path, ["obj"])) == 2
        with pytest.raises(p2wss.InputError, match="has no points"):
            each.points("a")


def test_points_are_those_that_the_building_was_fitted_to() -> None:
    """The fit moves walls inwards to where the roof begins."""
    wide = footprints()[:1].set_geometry([shapely.box(0, 0, 10, 6.5)])
    scene = p2wss.reconstruct(gable_points(), wide, model="none", progress=False)
    assert scene["a"].footprint.area < 0.98 * 65
    assert len(scene.points("a")) == scene["a"].attributes["num_points"]


def test_a_copy_and_a_file_are_written_with_materials_and_plants_or_say_what_is_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    walls = footprints()[:1].assign(MAT_MURS="49")
    config = {
        "reconstruct": {"outputs": ["cityjson", "obj"], "materials": {"roof": "tile"}, "per_building": True}
    }
    scene = p2wss.reconstruct(gable_points(), walls, model="none", progress=False, config=config)
    written = scene.write(tmp_path / "run", name="town")
    assert sorted(written) == sorted(path for path in (tmp_path / "run").rglob("*") if path.is_file())
    scene.plants = {"plant": scene["a"].solid}
    path = pickle.loads(pickle.dumps(scene)).write(tmp_path, name="copy")[-1]
    assert "written without cityjson" in caplog.text
    lines = path.read_text().splitlines()
    assert {"usemtl brick", "usemtl tile", "o plant"} <= set(lines)
    again = p2wss.read(tmp_path / "run" / "town.city.json")
    with pytest.raises(p2wss.InputError, match="needs a reconstruction"):
        again.write(tmp_path)
    assert "usemtl brick" in again.write(tmp_path, ["obj"])[-1].read_text()


def test_a_page_has_the_materials_of_columns_that_are_not_kept() -> None:
    walls = footprints()[:1].assign(MAT_MURS="49")
    config = {"reconstruct": {"keep_columns": ["id"]}}
    scene = p2wss.reconstruct(gable_points(), walls, model="none", progress=False, config=config)
    data = json.loads(scene.to_html().split('id="viewer-data">')[1].split("</script>")[0])
    (house,) = data["buildings"]
    assert house["inputs"] == ["id"] and house["materials"] == {"wall": "brick"}


def test_a_scene_is_shown_as_its_page(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = p2wss.reconstruct(gable_points(), footprints()[:2], model="none", progress=False)
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    path = scene.show()
    assert (
        path is not None and opened == [path.as_uri()] and path.read_text(encoding="utf-8") == scene.to_html()
    )
    assert (
        'id="viewer-data"' in scene.to_html()
        and 'id="viewer-data"' in pickle.loads(pickle.dumps(scene)).to_html()
    )
    # within a notebook
    shown: list[object] = []
    shell = SimpleNamespace(kernel=object())
    display = SimpleNamespace(display=lambda each: shown.append(each._repr_html_()))
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell, display=display))
    assert scene.show() is None and len(opened) == 1
    (text,) = shown
    inner = re.fullmatch(r'<iframe srcdoc="([^"]*)".*</iframe>', str(text), re.DOTALL)
    assert inner is not None and html.unescape(inner[1]) == scene.to_html()


def test_the_page_has_the_ground_what_has_no_mesh_and_the_files() -> None:
    cloud = gable_points() + np.array([0, 0, 7, 0])
    scene = p2wss.reconstruct(cloud, footprints()[:2], model="none", progress=False)
    page = scene.to_html()
    data = json.loads(page.split('id="viewer-data">')[1].split("</script>")[0])
    meshes = {each["id"]: each["meshes"] for each in data["buildings"]}
    assert list(meshes["a"]) == ["p2wss"] and list(meshes["b"]) == ["outlines"]
    assert [each["state"] for each in data["buildings"]] == ["ok", "none"]
    ground = next(each for each in data["around"] if each["key"] == "ground")
    z_m = np.frombuffer(base64.b64decode(ground["vertices"]), "<i4").reshape(-1, 3)[:, 2] / 1000
    wall = (
        np.frombuffer(base64.b64decode(meshes["a"]["p2wss"]["vertices"]), "<i4").reshape(-1, 3)[:, 2] / 1000
    )
    assert np.ptp(z_m) < 0.2 and z_m.mean() == pytest.approx(wall.min(), abs=0.2)
    assert data["crs"] == "RGF93 v1 / Lambert-93"
    assert f"Made by p2wss {p2wss.__version__} from cloud, footprints." in page


def test_a_scene_is_drawn_by_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "Agg")
    scene = p2wss.reconstruct(gable_points(), footprints()[:2], model="none", progress=False)
    assert [each.status for each in scene.values()] == ["ok", "none"]
    plan = scene.plot("plan")
    boxes = [path.get_extents().bounds for path in plan.collections[0].get_paths()]
    # the outline without a mesh, and two roofs of 10 by 3 m
    assert boxes[0] == pytest.approx((50, 0, 10, 6)) and len(boxes) == 3
    assert sorted(box[1] for box in boxes[1:]) == pytest.approx([0, 3], abs=0.3)
    oblique = scene.plot(ids="a")
    assert len(oblique.collections[0].get_paths()) == 4  # two walls and two roofs are seen
    pyplot.close("all")
    with pytest.raises(p2wss.InputError, match="choose from plan, oblique"):
        scene.plot("above")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(p2wss.InputError, match=r"needs matplotlib; type: pip install 'p2wss\[report\]'"):
        scene.plot()


def test_footprints_are_explored_on_a_map(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = p2wss.reconstruct(gable_points(), footprints()[:2], crs=2154, model="none", progress=False)
    page = scene.explore("reason", tiles=None).get_root().render()
    # degrees, as CRS of the map
    assert '"building_id": "a"' in page and '"reason": "no-points"' in page and "leaflet" in page
    for wrong in ("nonsense", "geometry", "points_date"):
        with pytest.raises(p2wss.InputError, match=f"column: choose from .*status.*, not '{wrong}'"):
            scene.explore(wrong)
    monkeypatch.setitem(sys.modules, "folium", None)
    with pytest.raises(p2wss.InputError, match=r"needs folium; type: pip install 'p2wss\[map\]'"):
        scene.explore()


def gable_points(x_m: float = 0.0) -> np.ndarray:
    """Points of a house of 10 by 6 metres at ``x_m`` and of the ground around it, with classes."""
    x, y = np.meshgrid(np.arange(-4, 14, 0.4), np.arange(-4, 10, 0.4))
    inside = (x > 0) & (x < 10) & (y > 0) & (y < 6)
    z = np.where(inside, 5 + np.minimum(y, 6 - y), 0)
    return np.column_stack([each.ravel() for each in (x + x_m, y, z, np.where(inside, 6, 2))])


def footprints() -> gpd.GeoDataFrame:
    boxes = [shapely.box(0, 0, 10, 6), shapely.box(50, 0, 60, 6), shapely.box(100, 0, 110, 6)]
    return gpd.GeoDataFrame({"id": ["a", "b", "c"]}, geometry=boxes, crs=2154)


def test_buildings_are_chosen_by_ids_and_by_a_box() -> None:
    cloud = np.concatenate([gable_points(), gable_points(50), gable_points(100)])
    done = []
    options = {"model": "none", "progress": lambda *numbers: done.append(numbers)}
    whole = p2wss.reconstruct(cloud, footprints(), **options)
    assert list(whole) == ["a", "b", "c"] and done[-1] == (3, 3) and "3 ok" in whole.summary
    by_id = p2wss.reconstruct(cloud, footprints(), ids=["b"], **options)
    by_box = p2wss.reconstruct(cloud, footprints(), bbox=(40, -10, 70, 20), **options)
    for scene in (by_id, by_box):
        assert list(scene) == ["b"]
        np.testing.assert_array_equal(scene["b"].mesh.vertices, whole["b"].mesh.vertices)
    # parts of a footprint are of its id, but no footprints whose ids only look like that
    parts = footprints().assign(id=["a", "a-1", "b"])
    parts.loc[2, "geometry"] = shapely.MultiPolygon(
        [shapely.box(100, 0, 110, 6), shapely.box(50, 20, 60, 26)]
    )
    assert list(p2wss.reconstruct(cloud, parts, ids=["a"], **options)) == ["a"]
    assert list(p2wss.reconstruct(cloud, parts, ids=["b"], **options)) == ["b-1", "b-2"]
    others = parts.assign(id=["b-1", "a-1", "b"])
    assert list(p2wss.reconstruct(cloud, others, ids=["b"], **options)) == ["b-2", "b-3"]
    with pytest.raises(p2wss.InputError, match="has no building a"):
        p2wss.reconstruct(cloud, others, ids=["a"], **options)
    with pytest.raises(p2wss.InputError, match="has no building nobody"):
        p2wss.reconstruct(cloud, footprints(), ids=["nobody"], **options)
    with pytest.raises(p2wss.InputError, match="is that in the CRS of the run"):
        p2wss.reconstruct(cloud, footprints(), bbox=(2.3, 48.8, 2.4, 48.9), **options)


def test_a_scene_is_closed_with_its_files_and_reading_one_gives_the_same_meshes(tmp_path: Path) -> None:
    with p2wss.reconstruct(gable_points(), footprints()[:1], model="none", progress=False) as scene:
        scene.write(tmp_path, ["cityjson"], name="town")
        solid, skin = scene["a"].mesh, scene.to_trimesh(skin=True)
        assert skin.geometry["a"].is_watertight
    text = re.sub(r'("residual_m": ?)[\d.]+', r'\1"near"', (tmp_path / "town.city.json").read_text())
    (tmp_path / "outlines.city.json").write_text(re.sub(r'"checksum": ?"[^"]*",?', "", text))
    assert '"state":"ok"' in p2wss.read(tmp_path / "outlines.city.json").to_html()
    again = p2wss.read(tmp_path / "town.city.json")
    assert again.crs == 2154 and again["a"].footprint.area == pytest.approx(60, abs=0.1)
    assert again["a"].mesh.volume == pytest.approx(solid.volume, abs=0.1)
    assert {each.kind for each in again["a"].surfaces} == {"GroundSurface", "WallSurface", "RoofSurface"}
    paths = again.write(tmp_path, ["obj", "ply"])
    assert {path.suffix for path in paths} == {".obj", ".mtl", ".ply"}
    with pytest.raises(p2wss.InputError, match="has no points"):
        again.points("a")
    with pytest.raises(p2wss.InputError, match="needs a reconstruction"):
        again.write(tmp_path, ["gpkg"])
    with pytest.raises(p2wss.InputError, match="name a folder"):
        again.write(tmp_path / "copy.obj", ["obj"])


def test_meshes_of_a_file_in_feet_are_written_in_metres(tmp_path: Path) -> None:
    with p2wss.reconstruct(gable_points(), footprints()[:1], model="none", progress=False) as scene:
        scene.write(tmp_path, ["cityjson"], name="town")
    path = tmp_path / "town.city.json"
    city = json.loads(path.read_text())
    city["metadata"]["referenceSystem"] = "https://www.opengis.net/def/crs/EPSG/0/2263"
    path.write_text(json.dumps(city))
    feet = p2wss.read(path)
    feet.write(tmp_path, ["ply", "sionna"])
    written = trimesh.load(tmp_path / "town.ply")
    assert written.volume == pytest.approx(feet["a"].mesh.volume * (1200 / 3937) ** 3, rel=1e-3)
    assert json.loads((tmp_path / "town_sionna" / "scene.json").read_text())["crs"] == "EPSG:32118"
    # and flown over in metres
    survey, roofs = p2wss.scan(feet), feet["a"].mesh.extents * 1200 / 3937
    assert survey.header.parse_crs().to_epsg() == 32118
    assert np.ptp(survey.xyz[survey.classification == 6], axis=0) == pytest.approx(roofs, abs=0.5)
    with pytest.raises(p2wss.InputError, match=r"crs: .* is not in metres"):
        p2wss.scan(feet["a"].mesh, crs=feet.crs)


def test_outlines_of_an_array() -> None:
    frame = p2wss.outlines(gable_points(), crs="EPSG:2154")
    assert len(frame) == 1 and 45 < frame.area.iloc[0] < 60  # walls stand back from the eaves


def test_columns_of_tables_of_points_are_found_by_their_names() -> None:
    table = pd.DataFrame({"Z": [3.0, 4.0], "intensity": [90.0, 900.0], "X": [1.0, 5.0], "y": [2.0, 6.0]})
    for classes, expected in (({}, [1, 1]), ({"Classification": [2, 6]}, [2, 6])):
        _, cloud = open_clouds(table.assign(**classes))
        assert cloud is not None and cloud.classification.tolist() == expected
        assert np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m]).tolist() == [[1, 2, 3], [5, 6, 4]]


def test_classes_of_points_in_memory_are_those_of_the_config() -> None:
    """As of files: noise and what a producer's classes ignore do not count, and others are of what they say."""
    cloud, config = (
        gable_points(),
        {"region": {"classes": {"preset": "custom", "building": [20], "ground": [2]}}},
    )
    expected = p2wss.reconstruct(cloud, footprints()[:1], model="none", progress=False)["a"].attributes
    coded = np.where((np.arange(4) == 3) & (cloud == 6), 20, cloud)
    noise = cloud[cloud[:, 3] == 6] + [0, 0, 9, 1]
    with_noise = np.concatenate([coded, noise])
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.x, las.y, las.z, las.classification = with_noise.T
    for given in (with_noise, las):
        scene = p2wss.reconstruct(
            given, footprints()[:1], model="none", progress=False, config=config, crs="EPSG:2154"
        )
        names = ("status", "num_points", "ground_source", "shift_source")
        assert [scene["a"].attributes[name] for name in names] == [expected[name] for name in names]
        assert abs(scene["a"].attributes["volume_m3"] - expected["volume_m3"]) < 2


def test_wrong_roofs_and_clouds_are_one_line() -> None:
    square = [[0, 0], [8, 0], [8, 8], [0, 8]]
    with pytest.raises(p2wss.InputError, match="4 edges, but there are 3 angles"):
        p2wss.roof(square, 3, [45, 45, 45])
    with pytest.raises(p2wss.InputError, match="no roof over this footprint"):
        p2wss.roof(square, 3, 3)
    with pytest.raises(p2wss.InputError, match=r"has shape \(5, 2\)"):
        p2wss.reconstruct(np.zeros((5, 2)), footprints())
    with pytest.raises(p2wss.InputError, match="id_field: state the name of a column, not 3"):
        p2wss.evaluate("buildings.city.json", footprints(), gable_points(), id_field=3)  # type: ignore[arg-type]


def test_degrees_are_not_taken_for_metres() -> None:
    with pytest.raises(p2wss.InputError, match="not in metres"):
        p2wss.fetch((2.35, 48.85, 2.36, 48.86), "EPSG:2154")
    with pytest.raises(p2wss.InputError, match="not in degrees"):
        p2wss.fetch((651000, 6861000, 652000, 6862000))


def test_a_place_is_fetched_into_a_folder(tmp_path: Path) -> None:
    mini = ROOT / "tests" / "mini"
    folder = {
        "footprints": str(mini / "bdtopo" / "BDTOPO_mini.gpkg"),
        "dtm": str(mini / "rgealti"),
        "lidar": str(mini / "lidar"),
    }
    config = {"fetch": {"source": "folder", "folder": folder}}
    data = p2wss.fetch((653100, 6860700, 653250, 6860850), "EPSG:2154", folder=tmp_path, config=config)
    scene = p2wss.reconstruct(
        data.clouds, data.footprints, model="none", terrain=data.terrain, progress=False
    )
    assert len(scene) > 0 and {each.status for each in scene.values()} & {"ok"}


@pytest.mark.skipif(not DELFT.exists(), reason="no shared data")
def test_a_scene_and_its_file_have_the_same_measures(tmp_path: Path) -> None:
    cloud, vectors = DELFT / "ahn3.laz", DELFT / "footprints.gpkg"
    box = (84900, 447490, 84950, 447540)
    scene = p2wss.reconstruct(cloud, vectors, model="none", progress=False, bbox=box)
    assert 2 < len(scene) < 40
    (path,) = [each for each in scene.write(tmp_path, ["cityjsonseq"]) if each.name.endswith(".jsonl")]
    one, other = (p2wss.evaluate(each, vectors, cloud) for each in (scene, path))
    np.testing.assert_allclose(
        one["points_to_mesh_m"], other["points_to_mesh_m"], atol=5e-3
    )  # of random samples


def test_attributes_of_3dbag_name_the_cloud_of_a_building_too() -> None:
    config = {"reconstruct": {"attribute_names": "3dbag"}}
    with p2wss.reconstruct(
        gable_points(), footprints()[:1], config=config, model="none", progress=False
    ) as scene:
        (building,) = scene.values()
        assert building.attributes["b3_pw_bron"] == scene.table["b3_pw_bron"].iloc[0] == "cloud"


def test_a_scene_has_the_columns_that_its_files_have() -> None:
    given = footprints()[:1].assign(use="barn", floors=2)
    config = {"reconstruct": {"keep_columns": ["floors"]}}
    with p2wss.reconstruct(gable_points(), given, config=config, model="none", progress=False) as scene:
        columns = {"id", "use", "floors"}
        assert columns & {*scene.table} == columns & {*scene["a"].attributes} == {"floors"}
        assert "barn" not in scene.to_html()


def test_columns_of_footprints_that_have_names_of_ours_are_kept(caplog: pytest.LogCaptureFixture) -> None:
    """Such as the status of the Dutch register, or what an earlier run wrote."""
    given = footprints()[:1].assign(status="in use", building_id="x", centre_x_m=7, overlapping_ids="b c")
    for kept in ("all", "status"):
        config = {"reconstruct": {"id_field": "id", "keep_columns": [kept]}}
        with p2wss.reconstruct(gable_points(), given, config=config, model="none", progress=False) as scene:
            values = scene["a"].attributes
        own = {
            "input_status": "in use",
            "input_building_id": "x",
            "centre_x_m": 7,
            "input_overlapping_ids": "b c",
        }
        own = own if kept == "all" else {"input_status": "in use"}
        assert {**values, **own} == values and values["status"] == "ok"
        assert ("centre_x_m" in values) == (kept == "all")
    assert "overlap" not in caplog.text


def test_the_table_of_a_file_without_buildings(tmp_path: Path) -> None:
    path = tmp_path / "none.city.json"
    path.write_text(json.dumps({"type": "CityJSON", "version": "2.0", "CityObjects": {}, "vertices": []}))
    table = p2wss.read(path).table
    assert len(table) == 0 and table.index.name == "building_id"
