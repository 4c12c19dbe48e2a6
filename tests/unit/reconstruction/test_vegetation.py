"""Crowns of drawn trees: found with their sizes, as closed volumes, and written to the formats that have a place."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import geopandas as gpd
import numpy as np
import pytest
import shapely
import trimesh

import p2wss
from p2wss import cli
from p2wss.clouds.reading import Cloud
from p2wss.reconstruction.outputs import vegetation
from p2wss.reconstruction.outputs.vegetation import Plant, plants
from p2wss.reconstruction.points.cloud_index import CloudIndex

# x, y, height, height of the base, radius; one is at the border of what is read together
TREES = ((20.0, 20.0, 9.0, 3.0, 2.5), (28.0, 20.0, 7.0, 3.0, 2.5), (256.0, 40.0, 12.0, 4.0, 3.5))
WINDOW = (0.0, 0.0, 300.0, 60.0)
HOUSE = shapely.box(50, 20, 60, 26)


def points(crown_class: int) -> np.ndarray:
    """Points (n, 4) with classes: sloping ground, crowns over it, a gable and, of the class of crowns, its chimney."""
    draw = np.random.default_rng(0)
    x, y = draw.uniform((-20, -20), (320, 80), (700_000, 2)).T
    z, classes = 0.02 * x, np.full(len(x), 2)
    for tree_x, tree_y, height, base, radius in TREES:
        square = ((x - tree_x) ** 2 + (y - tree_y) ** 2) / radius**2
        inside = (square < 1) & (draw.uniform(size=len(x)) < 0.7)
        up = np.sqrt(1 - square[inside])
        depth = np.where(draw.uniform(size=len(up)) < 0.8, up, draw.uniform(-up, up))
        # leaves are no plane
        depth = np.minimum(depth + draw.normal(0, 0.1, len(up)), 1)
        z[inside] = 0.02 * tree_x + (height + base) / 2 + (height - base) / 2 * depth
        classes[inside] = crown_class
    roof = (x > 50) & (x < 60) & (y > 20) & (y < 26)
    z[roof], classes[roof] = 6 + np.minimum(y - 20, 26 - y)[roof], 6
    chimney = (np.abs(x - 55) < 0.5) & (np.abs(y - 23) < 0.5)
    z[chimney], classes[chimney] = 11, 1
    return np.column_stack([x, y, z, classes])


def found(crown_class: int, window: tuple[float, float, float, float], folder: Path) -> list[Plant]:
    x, y, z, classes = points(crown_class).T
    with CloudIndex(np.array([[-20.0, -20, 320, 80]]), folder) as index:
        index.append(Cloud(x, y, z, classes.astype(np.uint8), None))
        return plants(index, window, np.array([HOUSE], dtype=object))


def test_crowns_with_several_highest_points_are_the_same_whatever_the_order_of_points(tmp_path: Path) -> None:
    x, y, z, classes = points(5).T
    results = []
    for order in (slice(None), slice(None, None, -1)):
        columns = [values[order] for values in (x, y, np.round(z), classes.astype(np.uint8))]
        with CloudIndex(np.array([[-20.0, -20, 320, 80]]), tmp_path) as index:
            index.append(Cloud(*columns, None))
            results.append(plants(index, WINDOW, np.array([HOUSE], dtype=object)))
    assert [each.name for each in results[0]] == [each.name for each in results[1]]
    for one, other in zip(*results, strict=True):
        assert one.mesh.vertex_m.tobytes() == other.mesh.vertex_m.tobytes()


@pytest.mark.parametrize("crown_class", [5, 1])
def test_each_crown_is_one_closed_volume_of_its_size(crown_class: int, tmp_path: Path) -> None:
    result = found(crown_class, WINDOW, tmp_path)
    assert len(result) == len(TREES)
    for tree_x, tree_y, height, base, radius in TREES:
        (plant,) = (
            p
            for p in result
            if np.hypot(*(p.mesh.vertex_m[p.mesh.vertex_m[:, 2].argmax(), :2] - (tree_x, tree_y))) < 1
        )
        assert plant.height_m == pytest.approx(height, abs=0.5)
        assert base - 0.5 < plant.base_m < (height + base) / 2
        assert plant.width_m == pytest.approx(2 * radius, abs=1.2) and plant.num_points > 50
        assert plant.city_type == "SolitaryVegetationObject"
        assert plant.mesh.is_closed and trimesh.Trimesh(plant.mesh.vertex_m, plant.mesh.triangle).is_volume
        ellipsoid_m3 = 4 / 3 * np.pi * radius**2 * (height - base) / 2
        assert 0.3 * ellipsoid_m3 < plant.mesh.volume_m3 < 1.2 * ellipsoid_m3


def test_a_plant_does_not_depend_on_the_window(tmp_path: Path) -> None:
    whole = {plant.name: plant for plant in found(5, WINDOW, tmp_path)}
    (part,) = found(5, (240.0, 0.0, 280.0, 60.0), tmp_path)
    np.testing.assert_array_equal(part.mesh.vertex_m, whole[part.name].mesh.vertex_m)


def test_crowns_whose_tops_are_beside_each_other_have_names_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def halves(
        row: np.ndarray, column: np.ndarray, height_m: np.ndarray, shape: tuple[int, ...]
    ) -> np.ndarray:
        return np.broadcast_to(np.where(np.arange(shape[1]) < 2 * (16 + 20), 1, 2), shape)

    monkeypatch.setattr(vegetation, "_basins", halves)
    x, y = np.random.default_rng(0).uniform((10, 10), (30, 30), (4000, 2)).T
    z, classes = np.where(np.hypot(x - 20, y - 20) < 3, 9 - np.abs(x - 20), 0.0), np.where(x < 0, 5, 2)
    classes[z > 0] = 5
    with CloudIndex(np.array([[0.0, 0, 40, 40]]), tmp_path) as index:
        index.append(Cloud(x, y, z, classes.astype(np.uint8), None))
        names = [
            plant.name for plant in plants(index, (0.0, 0.0, 40.0, 40.0), np.array([HOUSE], dtype=object))
        ]
    assert len(set(names)) == len(names) == 2 and {name.split("_")[1] for name in names} == {"195", "200"}


def test_a_chimney_beside_a_misplaced_footprint_is_no_plant() -> None:
    """The cloud has no classes of plants, and the registration moves the footprint by more than the margin in which
    points are of the building."""
    draw = np.random.default_rng(0)
    x, y = draw.uniform((-20, -20), (40, 40), (36_000, 2)).T
    roof = (x > 0) & (x < 12) & (y > 0) & (y < 9)
    chimney = roof & (np.abs(x - 0.5) < 0.45) & (np.abs(y - 4.2) < 0.45)
    z = np.where(roof, 6 + 0.8 * np.minimum(y, 9 - y), 0) + draw.normal(0, 0.03, len(x))
    z[chimney] += draw.uniform(0, 1.5, chimney.sum())
    crown = (x - 25) ** 2 + (y - 20) ** 2 < 4
    z[crown] = draw.uniform(3, 8, crown.sum())
    cloud = np.column_stack([x, y, z, np.where(z < 0.3, 2, 1)])
    footprints = gpd.GeoDataFrame({"id": ["a"]}, geometry=[shapely.box(2.4, 0, 14.4, 9)], crs="EPSG:2154")
    config = {"reconstruct": {"vegetation": True}}
    with p2wss.reconstruct(cloud, footprints, model="none", progress=False, config=config) as scene:
        assert scene.table["shift_x_m"].item() == pytest.approx(-2.4, abs=0.1)
        places_m = np.array([plant.vertex_m[:, :2].mean(axis=0) for plant in scene.plants.values()])
    assert len(places_m) and (np.hypot(*(places_m - [25, 20]).T) < 2).all()


def test_where_there_are_no_points_nothing_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A window of 1,000 by 700 km with plants in one corner of it takes no longer than that corner."""
    num_read, near = 0, CloudIndex.near

    def counted(*args: Any, **options: Any) -> Cloud:
        nonlocal num_read
        num_read += 1
        return near(*args, **options)

    monkeypatch.setattr(CloudIndex, "near", counted)
    assert len(found(5, (*WINDOW[:2], 1e6, 7e5), tmp_path)) == len(TREES) and num_read < 30


def test_plants_are_in_the_files_that_have_a_place_for_them(tmp_path: Path) -> None:
    frame = gpd.GeoDataFrame({"id": ["house"], "mat_murs": ["40"]}, geometry=[HOUSE], crs=2154)
    config = {
        "reconstruct": {"vegetation": True, "terrain_margin_m": 40, "materials": {"vegetation": "plywood"}}
    }
    with p2wss.reconstruct(points(5), frame, config=config, model="none", progress=False) as scene:
        scene.write(tmp_path, ["cityjson", "cityjsonseq", "glb", "obj", "sionna", "report"], name="town")
    city = json.loads((tmp_path / "town.city.json").read_text())["CityObjects"]
    trees = {name: each for name, each in city.items() if each["type"] == "SolitaryVegetationObject"}
    assert len(trees) == 2 and set(city) == {*trees, "house"}
    for tree in trees.values():
        assert tree["attributes"]["height_m"] > tree["attributes"]["base_m"] > 0
        assert tree["attributes"]["width_m"] > 0 and tree["attributes"]["num_points"] > 50
        assert tree["geometry"][0]["type"] == "Solid" and "semantics" not in tree["geometry"][0]
    for name in ("town.city.json", "town.city.jsonl"):
        validity = p2wss.check(tmp_path / name)
        assert not validity.invalid
    again = p2wss.read(tmp_path / "town.city.json")
    assert list(again) == ["house"]
    again.write(tmp_path / "again", ["obj", "sionna"])
    document = json.loads((tmp_path / "again" / "town_sionna" / "scene.json").read_text())
    materials = {name: each["material"] for name, each in document["shapes"].items()}
    assert materials == {"house": "brick", "vegetation": "wood"}
    text = (tmp_path / "again" / "town.obj").read_text()
    assert text.count("usemtl wood") == 2 and all(f"o {name}\n" in text for name in trees)
    p2wss_view = ["view", str(tmp_path / "town.city.json"), "--out", str(tmp_path / "view.html")]
    assert cli.main(p2wss_view) == 0
    for page in ("town.html", "view.html"):
        text = (tmp_path / page).read_text(encoding="utf-8").split('id="viewer-data">')[1]
        data = json.loads(text.split("</script>")[0])
        (crowns,) = [each for each in data["around"] if each["key"] == "plants"]
        assert crowns["facts"] == f"{2 * 32} triangles" and len(data["buildings"]) == 1
        vertex_m = np.frombuffer(base64.b64decode(crowns["vertices"]), "<i4").reshape(-1, 3) / 1000
        middle_m = (vertex_m.min(axis=0) + vertex_m.max(axis=0)) / 2 - np.mean(
            data["buildings"][0]["bounds"], axis=0
        )
        # two crowns at x = 20 and 28, beside the house
        assert middle_m[:2] == pytest.approx((24 - 55, 20 - 23), abs=0.6)
        assert np.ptp(vertex_m[:, 0]) == pytest.approx(8 + 5, abs=1)
    glb = trimesh.load_scene(tmp_path / "town.glb")
    content = (tmp_path / "town.glb").read_bytes()
    nodes = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])["nodes"]
    extras = {node["name"]: node["extras"] for node in nodes}
    for name, tree in trees.items():
        assert glb.geometry[name].is_watertight
        assert extras[name]["height_m"] == tree["attributes"]["height_m"]
    text = (tmp_path / "town.obj").read_text()
    assert all(f"o {name}\n# height_m" in text for name in trees) and "usemtl plywood" in text
    document = json.loads((tmp_path / "town_sionna" / "scene.json").read_text())
    assert document["shapes"]["vegetation"]["material"] == "plywood"
    shapes = ElementTree.parse(tmp_path / "town_sionna" / "scene.xml").getroot().findall("shape")
    assert {shape.get("id") for shape in shapes} == {"mesh-house", "mesh-vegetation"}
    assert json.loads((tmp_path / "town.json").read_text())["vegetation"] == {"SolitaryVegetationObject": 2}
