"""The demo, and buildings of any file on a page."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import p2wss
from p2wss import cli
from p2wss.reconstruction.outputs import page


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "p2wss-demo"
    assert cli.main(["demo", str(folder)]) == 0
    return folder


def buildings(page: Path) -> list[dict[str, Any]]:
    text = page.read_text(encoding="utf-8").split('id="viewer-data">')[1].split("</script>")[0]
    return json.loads(text)["buildings"]  # type: ignore[no-any-return]


def test_the_demo_reconstructs_a_small_town(demo: Path) -> None:
    summary = json.loads((demo / "out/lidar.json").read_text())["buildings"]
    assert 20 <= summary["total"] <= 40 and summary["status"]["ok"] >= summary["total"] - 1
    shown = buildings(demo / "out/lidar.html")
    assert len(shown) == summary["total"]
    assert all(each["meshes"] and each["attributes"]["num_points"] > 50 for each in shown)
    residual_m = [each["residual"] for each in shown]
    assert residual_m == sorted(residual_m, reverse=True) and residual_m[0] < 0.25


def test_the_page_of_a_run_is_shown_as_it_is(demo: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        assert cli.main(["view", str(demo / "out")]) == 0
    assert "lidar.html" in caplog.text and not (demo / "out/view.html").exists()


def test_a_page_of_an_earlier_run_is_not_shown_for_the_buildings_of_this_one(
    demo: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "out"
    shutil.copytree(demo / "out", folder)
    document = json.loads((folder / "lidar.city.json").read_text())
    first = min(document["CityObjects"])
    document["CityObjects"] = {first: document["CityObjects"][first]}
    (folder / "lidar.city.json").write_text(json.dumps(document))
    with caplog.at_level("INFO"):
        assert cli.main(["view", str(folder)]) == 0
    assert "view.html" in caplog.text and [each["id"] for each in buildings(folder / "view.html")] == [first]


def test_files_of_any_program_are_compared_on_a_page(demo: Path, tmp_path: Path) -> None:
    ours = demo / "out/lidar.city.json"
    document = json.loads(ours.read_text())
    for city_object in document["CityObjects"].values():
        city_object["attributes"] = {"status": "Pand in gebruik", "reason": 3}  # of 3DBAG
    other, page = tmp_path / "other.city.json", tmp_path / "page.html"
    other.write_text(json.dumps(document))
    assert cli.main(["view", str(other), str(ours), str(demo / "lidar.laz"), "--out", str(page)]) == 0
    by_id = {each["id"]: each for each in buildings(demo / "out/lidar.html")}
    for each in buildings(page):
        assert set(each["meshes"]) == {"other.city.json", "lidar.city.json"}
        # measured on other points of the same building
        assert each["attributes"]["residual_m"] == pytest.approx(by_id[each["id"]]["residual"], abs=0.05)


def test_of_citygml_it_is_said_how_to_convert_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.gml"
    path.write_text('\ufeff<?xml version="1.0"?>\n<core:CityModel/>', encoding="utf-8")
    for command in ("view", "check"):
        assert cli.main([command, str(path)]) == 2
        assert "citygml-tools to-cityjson" in capsys.readouterr().err


def test_of_many_buildings_the_others_are_shapes(demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count = len(buildings(demo / "out/lidar.html"))
    scene = p2wss.read(demo / "out/lidar.city.json")
    text, shapes = [], []
    for num_others in (count - 5, 1):
        monkeypatch.setattr(page, "MAX_BUILDINGS", 5)
        monkeypatch.setattr(page, "MAX_OTHERS", num_others)
        text.append(page.page_of_scenes("town", {"town": scene}, None))
        data = json.loads(text[-1].split('id="viewer-data">')[1].split("</script>")[0])
        assert len(data["buildings"]) == 5
        shapes += [each for each in data["around"] if each["key"] == "others"]
    assert "the others are grey" in text[0] and f"{count - 6} are left out" in text[1]
    assert len(shapes[0]["triangles"]) > 10 * len(shapes[1]["triangles"]) > 0


def test_what_is_no_cityjson_is_named(demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["view", str(demo / "lidar.laz")]) == 2
    assert "no CityJSON file" in capsys.readouterr().err


def test_two_runs_in_a_folder_are_compared(
    demo: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("town", "town.v2"):
        for ending in (".html", ".city.json"):
            shutil.copy(demo / f"out/lidar{ending}", tmp_path / f"{name}{ending}")
    assert p2wss.read(tmp_path / "town.v2.city.json").name == "town.v2"
    with caplog.at_level("INFO"):
        assert cli.main(["view", str(tmp_path)]) == 0
    assert "view.html" in caplog.text
    assert set(buildings(tmp_path / "view.html")[0]["meshes"]) == {"town.city.json", "town.v2.city.json"}
