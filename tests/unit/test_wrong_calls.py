"""Wrong calls of the public functions: each works, or ends in one line in words of Python."""

from __future__ import annotations

import gc
import inspect
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
import trimesh
from places import ROOT
from test_api import footprints, gable_points

import p2wss

HOUSE, SQUARE = shapely.box(0, 0, 10, 6), [[0, 0], [10, 0], [10, 6], [0, 6]]
MINI = ROOT / "tests" / "mini"


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    """Each public function and arguments with which it works."""
    folder = tmp_path_factory.mktemp("town")
    cloud, plans = gable_points(), footprints()[:1]
    run = {"cloud": cloud, "footprints": plans, "crs": "EPSG:2154", "model": "none", "progress": False}
    scene = p2wss.reconstruct(**run)
    scene.write(folder, ["cityjson"], name="town")
    city = folder / "town.city.json"
    files = {"footprints": str(MINI / "bdtopo" / "BDTOPO_mini.gpkg"), "dtm": str(MINI / "rgealti")}
    source = {"fetch": {"source": "folder", "folder": files | {"lidar": str(MINI / "lidar")}}}
    place = {"bbox": (653100, 6860700, 653110, 6860710), "crs": "EPSG:2154", "folder": folder}
    return {
        "reconstruct": (p2wss.reconstruct, run),
        "outlines": (p2wss.outlines, {"cloud": cloud, "crs": "EPSG:2154"}),
        "evaluate": (p2wss.evaluate, {"buildings": city, "footprints": plans, "clouds": cloud}),
        "read": (p2wss.read, {"path": city}),
        "check": (p2wss.check, {"path": city}),
        "fetch": (p2wss.fetch, place | {"config": source}),
        "roof": (p2wss.roof, {"footprint": SQUARE, "eave_height_m": 5, "angle_deg": 45}),
        "scan": (p2wss.scan, {"meshes": [p2wss.roof(SQUARE, 5, 45)]}),
        "write": (scene.write, {"folder": folder / "out", "formats": ["glb"]}),
    }


ODD: dict[str, Any] = {
    "None": None,
    "5": 5,
    "0": 0,
    "-1": -1,
    "2.5": 2.5,
    "NaN": float("nan"),
    "True": True,
    "text": "b12",
    "digit": "2",
    "no text": "",
    "bytes": b"a",
    "path": Path("gone/b.xyz"),
    "folder": Path("."),
    "vectors": MINI / "bdtopo" / "BDTOPO_mini.gpkg",
    "page": ROOT / "README.md",
    "empty": [],
    "numbers": [0, 0, 1],
    "box": (0, 0, 9, 9),
    "pairs": [[0, 0], [10, 0]],
    "mapping": {"a": 1},
    "NaNs": np.full((5, 3), np.nan),
    "array": np.zeros((5, 2)),
    "words": np.array([["a", "b", "c"]]),
    "polygon": HOUSE,
    "polygons": [HOUSE],
    "series": gpd.GeoSeries([HOUSE]),
    "frame": gpd.GeoDataFrame({"a": [1]}),
    "table": pd.DataFrame({"x": [1.0], "y": ["b"]}),
    "points": gpd.GeoDataFrame(geometry=[shapely.Point(0, 0)], crs=2154),
    "mesh": trimesh.creation.box(),
    "object": object(),
}
# what a service is asked for, and what decides how long a survey takes
NOT_TRIED = {"fetch": {"config"}, "scan": {"config"}}


def with_intensities() -> np.ndarray:
    points = gable_points()
    points[:, 3] = np.arange(len(points)) % 200
    return points


@pytest.mark.parametrize(
    "name", ["reconstruct", "outlines", "evaluate", "read", "check", "fetch", "roof", "scan", "write"]
)
def test_a_wrong_argument_works_or_ends_in_one_line(
    name: str,
    calls: dict[str, tuple[Callable[..., Any], dict[str, Any]]],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    function, right = calls[name]
    raw, num_refused = [], 0
    for parameter in inspect.signature(function).parameters.keys() - NOT_TRIED.get(name, set()):
        for kind, value in ODD.items():
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    function(**right | {parameter: value})
            except p2wss.InputError as error:
                num_refused += 1
                if "\n" in str(error) or " --" in str(error):
                    raw.append(f"{parameter}={kind}: {error}")
            except Exception as error:
                raw.append(f"{parameter}={kind}: {type(error).__name__}: {error}")
    assert not raw, "\n".join(raw)
    assert num_refused > 20


def test_what_people_have_works() -> None:
    cloud, house = gable_points(), shapely.box(0, 0, 10, 6)
    options: dict[str, Any] = {"crs": "EPSG:2154", "model": "none", "progress": False}
    volumes = set()
    for plans in (gpd.GeoSeries([house], crs=2154), [house], house, np.array([house]), footprints()[:1]):
        scene = p2wss.reconstruct(cloud, plans, **options)
        volumes |= {building.mesh.volume for building in scene.values()}
    # fill values beside the points
    masked = np.ma.masked_less(
        np.vstack([cloud, np.full((200, 4), -9999.0), [[5.0, 3.0, -9999.0, 6.0]] * 200]), -9
    )
    # as pdal.Pipeline.arrays[0]
    structured = np.rec.fromarrays(cloud.T[[3, 0, 1, 2]], names="Classification,X,Y,Z")
    for points in (cloud.tolist(), pd.DataFrame(cloud), masked, np.asarray(structured)):
        (building,) = p2wss.reconstruct(points, [house], **options | {"crs": 2154}).values()
        volumes.add(building.mesh.volume)
    assert len(volumes) == 1
    named = footprints()[:1].set_index("id")
    assert list(p2wss.reconstruct(cloud, named, **options)) == ["a"] and list(named.columns) == ["geometry"]
    assert list(p2wss.reconstruct(cloud, footprints(), ids="a", bbox=np.array([0, 0, 9, 9]), **options)) == [
        "a"
    ]
    survey = p2wss.scan(scene.to_trimesh(), crs=scene.crs)
    assert (survey.classification == 6).any() and survey.header.parse_crs() == scene.crs


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (
            {"cloud": "a.gpkg", "footprints": "b.laz"},
            "a.gpkg: is a vector file, no point cloud; the order is",
        ),
        (
            {"cloud": footprints(), "footprints": gable_points()},
            "the footprints are a ndarray; .* after the cloud",
        ),
        ({"cloud": footprints()}, "the cloud is a GeoDataFrame; .* before the footprints"),
        ({"cloud": np.full((5, 3), np.nan)}, "not finite"),
        ({"cloud": gable_points() * [1, 1, 1, 0.05]}, "classes that are not whole"),
        ({"cloud": with_intensities()}, "has more than 32 values, as intensities have"),
        (
            {"cloud": pd.DataFrame({"x": [1.0, 2], "Y": ["1", "n/a"], "z": [1, 2]})},
            "the cloud's column Y is not of numbers: could not convert string to float: 'n/a'",
        ),
        (
            {"cloud": np.zeros(5, [("X", "i4"), ("Y", "i4"), ("Z", "i4")])},
            "X, Y and Z are whole numbers, as in LAS before scale and offset",
        ),
        ({"ids": "b12"}, "has no building b12"),
        ({"ids": []}, r"ids: state ids of buildings, not \[\]"),
        ({"bbox": (0, 0, 1)}, r"bbox: state four numbers: x_min, y_min, x_max, y_max, not \(0, 0, 1\)"),
        ({"threads": "2"}, "threads: state a whole number, at least 1, not '2'"),
        ({"threads": 0}, "at least 1"),
        ({"footprints": footprints().set_crs(None, allow_override=True)}, "state it with crs=, such as"),
        ({"config": {"recon": {}}}, "recon: unknown key .did you mean reconstruct"),
    ],
)
def test_what_is_said_of_a_wrong_argument(wrong: dict[str, Any], text: str) -> None:
    with pytest.raises(p2wss.InputError, match=text):
        p2wss.reconstruct(**{"cloud": gable_points(), "footprints": footprints()} | wrong)


def test_what_is_said_of_wrong_roofs_places_and_formats(tmp_path: Path) -> None:
    with pytest.raises(p2wss.InputError, match="footprint: not one polygon: "):
        p2wss.roof([[0, 0], [10, 0]], 5, 45)
    with pytest.raises(p2wss.InputError, match=r"48.853, .*: degrees \(longitude, latitude\) outside France"):
        p2wss.fetch((48.853, 2.350, 48.856, 2.354), folder=tmp_path)  # and no request is sent
    scene = p2wss.reconstruct(gable_points(), footprints()[:1], model="none", progress=False)
    assert {path.suffix for path in scene.write(tmp_path, formats="glb")} == {".glb", ".json"}
    with pytest.raises(p2wss.InputError, match=r"\(did you mean obj\?\)"):
        scene.write(tmp_path, formats="OBJ")
    (tmp_path / "taken").touch()
    with pytest.raises(p2wss.InputError, match=r"taken/out: not written: .*taken is a file; name a folder"):
        scene.write(tmp_path / "taken" / "out")
    with pytest.raises(p2wss.InputError, match="has no building b12"):
        scene.plot(ids="b12")
    for function in (p2wss.read, p2wss.check):
        with pytest.raises(p2wss.InputError, match=f"{tmp_path}: is a folder; name a file in it"):
            function(tmp_path)


def test_a_scene_that_nobody_closes_closes_its_file() -> None:
    scene = p2wss.reconstruct(gable_points(), footprints()[:1], model="none", progress=False)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        del scene
        gc.collect()
    assert [str(each.message) for each in caught if each.category is ResourceWarning] == []


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [each for each in sys.modules if each.startswith(("embreex", "p2wss.scans."))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(p2wss.InputError, match=r"needs embreex; type: pip install 'p2wss\[scan\]'"):
        p2wss.scan([p2wss.roof(SQUARE, 5, 45)])


@pytest.mark.parametrize(("far_m", "is_told"), [(6_862_000, True), (1000, False)])
def test_coordinates_that_were_float32_are_told(
    far_m: float, is_told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    cloud, house = gable_points() + np.array([0, far_m, 0, 0]), shapely.box(0, far_m, 10, far_m + 6)
    cloud[:, 0] += np.random.default_rng(3).uniform(
        -0.1, 0.1, len(cloud)
    )  # those of a raster are as coarse by nature
    options: dict[str, Any] = {"crs": "EPSG:2154", "model": "none", "progress": False}
    p2wss.reconstruct(cloud, [house], **options)
    assert "float32" not in caplog.text
    short = pd.DataFrame(cloud, columns=["x", "y", "z", "classification"]).astype({"x": "f4", "y": "f4"})
    p2wss.reconstruct(short, [house], **options)
    assert ("y is in whole steps of 0.5, as float32" in caplog.text) == is_told
