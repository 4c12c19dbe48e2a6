"""The 3D view of the report: its data, and that a real browser draws, turns and switches buildings."""

from __future__ import annotations

import base64
import io
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from all_cases import all_test_cases
from drawn_towns.planes import mesh_of
from matplotlib.image import imread

import p2wss
from p2wss.config import Config, Eval, Reconstruct
from p2wss.eval import measure, tables
from p2wss.eval.viewer import MAX_POINTS, choices, viewer
from p2wss.formats.viewer import OUTLINES, Layer, Place, Shown, environment, scene_page
from p2wss.reconstruction.product import constant, lod1
from p2wss.storage.schemas.measures import MEASURES

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
NAMES = {"point2wss": "Ours", "lod1": "LoD1 <flat>"}
TITLES = {"simulated": "Simulated", "real": "LiDAR"}


@pytest.fixture(scope="module")
def view(hamlet: Path) -> dict[str, Any]:
    """Ours: hip roofs of 35 degrees with eaves at 5 m; the last building has no mesh."""
    test_cases = all_test_cases(hamlet)
    buildings = [case.building for case in test_cases]
    config = Reconstruct()
    ours = constant(buildings, np.full(len(test_cases), 5.0), 35.0, config, "point2wss")
    ours[-1] = replace(ours[-1], mesh=None, status="no height")
    by_key = {
        name: {case.key: row for case, row in zip(test_cases, rows, strict=True)}
        for name, rows in {"point2wss": ours, "lod1": lod1(buildings, config)}.items()
    }
    table = pa.Table.from_pylist(
        list(measure.measure(test_cases, by_key, Config(eval=Eval(num_samples=64)))), MEASURES
    )
    runs = [tables.Run(name, "ok") for name in by_key]
    chosen = choices(tables.ranked(tables.frame_of(table, runs), runs), TITLES, 20)
    view = viewer(chosen, {case.key: case for case in test_cases}, by_key, NAMES, "point2wss")
    assert view is not None
    return view


def numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def test_the_page_stores_the_buildings_and_meshes(view: dict[str, Any], hamlet: Path) -> None:
    assert "<" not in view["data"] and "</script" not in view["library"] + view["script"]
    data = json.loads(view["data"])
    assert [method["key"] for method in data["methods"]] == ["point2wss", "lod1"]
    by_id = {building["id"]: building for building in data["buildings"]}
    test_cases = all_test_cases(hamlet)
    assert set(by_id) == {case.building.building_id for case in test_cases} and len(by_id) == len(test_cases)
    without_mesh = test_cases[-1].building.building_id
    assert "point2wss" not in by_id[without_mesh]["meshes"]
    assert by_id[without_mesh]["title"].startswith("no mesh")
    # the worst of a data set comes first, and a building without a mesh is the worst
    assert next(b["id"] for b in data["buildings"] if b["group"] == "LiDAR: worst") == without_mesh
    for case in test_cases[:-1]:
        stored = by_id[case.building.building_id]
        point_m = numbers(stored["points"], "<i2").reshape(-1, 3) / 100 + stored["place"]
        expected = case.building.point_m
        assert len(point_m) <= MAX_POINTS and point_m == pytest.approx(expected, abs=0.0051)
        mesh = stored["meshes"]["point2wss"]
        vertex_m = numbers(mesh["vertices"], "<i4").reshape(-1, 3) / 1000
        triangle = numbers(mesh["triangles"], "<u4").reshape(-1, 3)
        assert vertex_m[:, 2].min() == 0 and triangle.max() == len(vertex_m) - 1
        assert len(numbers(mesh["kinds"], "u1")) == len(triangle)
        assert len(numbers(stored["distances"], "u1")) == len(point_m)
        low, high = np.array(stored["bounds"])
        assert (point_m >= low - 0.01).all() and (vertex_m <= high + 0.01).all()


def test_no_building_is_shown_twice() -> None:
    for count in range(0, 70, 3):
        rows = pd.DataFrame(
            {
                "dataset": "real",
                "tile": "t",
                "building_id": list(map(str, range(count))),
                "points_to_mesh_m": 0.1,
            }
        )
        views = choices(rows, TITLES, 20)
        assert len({view.key for view in views}) == len(views)
        assert len(views) == count if count <= 20 else 20 < len(views) <= 30
    assert viewer([], {}, {}, NAMES, "point2wss") is None


class Page:
    """The view in a browser, with its messages and requests."""

    def __init__(self, page: Any, path: Path) -> None:
        self.page = page
        self.messages: list[str] = []
        page.on("console", lambda message: self.messages.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: self.messages.append(f"error: {error}"))
        page.on("request", lambda request: self.messages.append(f"request: {request.url}"))
        page.goto(path.as_uri())
        assert self.messages == [f"request: {path.as_uri()}"]
        self.messages.clear()
        page.locator("#viewer").scroll_into_view_if_needed()

    @property
    def building(self) -> str:
        return self.page.locator("#viewer canvas").get_attribute("data-building")

    def pixels(self) -> np.ndarray:
        """The picture on the canvas, (rows, columns, 3), once it is drawn."""
        self.page.evaluate("new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))")
        picture = imread(io.BytesIO(self.page.locator("#viewer canvas").screenshot()))[..., :3]
        return picture[12:-12, 12:-12]  # without the round corners


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of pixels that differ."""
    return float((np.abs(before - after).max(axis=2) > 0.02).mean())


def drawn(pixels: np.ndarray) -> float:
    """Share of pixels that are not the background."""
    return changed(pixels, np.broadcast_to(pixels[8, 8], pixels.shape))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    # containers have neither a GPU nor the right to a sandbox
    options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as running:
        started = running.chromium.launch(executable_path=CHROMIUM, args=options)
        yield started
        started.close()


@pytest.fixture(scope="module")
def path(view: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    head = (
        '<!doctype html><meta charset="utf-8"><meta name="viewport" content="width=device-width"><h1>Top</h1>'
    )
    path = tmp_path_factory.mktemp("page") / "report.html"
    templates = environment("p2wss.formats")
    parts = [
        templates.get_template(name).render(viewer=view)
        for name in ("viewer.html.j2", "viewer_scripts.html.j2")
    ]
    path.write_text(head + "".join(parts))
    return path


def test_it_draws_turns_switches_and_toggles(browser: Any, path: Path) -> None:
    view = Page(browser.new_page(viewport={"width": 1000, "height": 800}), path)
    # the worst simulated building has both meshes
    first, name = view.pixels(), view.building
    assert view.page.locator("#viewer .ours").inner_text() == "the mesh of Ours"
    assert drawn(first) > 0.05

    box = view.page.locator("#viewer canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    view.page.mouse.move(x, y)
    view.page.mouse.down()
    view.page.mouse.move(x + 150, y + 20, steps=5)
    view.page.mouse.up()
    turned = view.pixels()
    assert changed(first, turned) > 0.02 and drawn(turned) > 0.05
    view.page.mouse.wheel(0, 400)
    assert drawn(view.pixels()) < 0.95 * drawn(turned)
    view.page.locator("#viewer .reset").click()
    assert changed(first, view.pixels()) < 0.002

    boxes = view.page.locator("#viewer input")
    assert [boxes.nth(i).is_checked() for i in range(3)] == [True, True, False]
    assert view.page.locator("#viewer label").nth(2).inner_text() == "LoD1 <flat>"
    boxes.nth(0).uncheck()
    without_points = view.pixels()
    assert changed(first, without_points) > 0.01 and drawn(without_points) > 0.05
    boxes.nth(1).uncheck()
    assert drawn(view.pixels()) == 0
    boxes.nth(2).check()
    assert drawn(view.pixels()) > 0.05 and changed(without_points, view.pixels()) > 0.02

    view.page.locator("#viewer .next").click()
    assert view.building != name
    # the choice of layers is kept from building to building
    assert [boxes.nth(i).is_checked() for i in range(3)] == [False, False, True]
    view.page.locator("#viewer .previous").click()
    assert view.building == name
    without_mesh = view.page.locator("#viewer option", has_text="no mesh").first.get_attribute("value")
    view.page.locator("#viewer select").select_option(without_mesh)
    assert "Ours: no mesh" in view.page.locator("#viewer .facts").inner_text()
    assert boxes.nth(1).is_disabled() and drawn(view.pixels()) > 0.05
    view.page.emulate_media(media="print")
    assert not view.page.locator("#viewer").is_visible()
    assert view.messages == []


def test_on_a_phone_a_finger_turns_it(browser: Any, path: Path) -> None:
    context = browser.new_context(
        viewport={"width": 390, "height": 844}, device_scale_factor=2, has_touch=True, is_mobile=True
    )
    view = Page(context.new_page(), path)
    assert view.page.evaluate("document.documentElement.scrollWidth") == 390
    canvas = view.page.locator("#viewer canvas").bounding_box()
    # the page can be scrolled beside the canvas
    assert canvas["width"] > 300 and canvas["height"] < 0.7 * 844
    before = view.pixels()
    assert drawn(before) > 0.05
    wire = context.new_cdp_session(view.page)
    x, y = canvas["x"] + 195, canvas["y"] + canvas["height"] / 2
    for kind, shift in (("touchStart", 0), ("touchMove", 40), ("touchMove", 90), ("touchEnd", None)):
        points = [] if shift is None else [{"x": x + shift, "y": y}]
        wire.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    assert changed(before, view.pixels()) > 0.02
    assert view.messages == []


def test_without_webgl_it_says_so(browser: Any, path: Path) -> None:
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(path.as_uri())
    assert page.locator("#viewer .sorry").is_visible() and not page.locator("#viewer canvas").is_visible()


HOSTILE = "</script><script>document.title='owned'</script>"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four houses in a row: fitting, far from its points, flat, without a mesh."""
    house = p2wss.roof([[0, 0], [10, 0], [10, 8], [0, 8]], 5, [45, 90, 45, 90])
    mesh = mesh_of(house.vertices, np.asarray(house.faces))
    states = [
        (HOSTILE, {"status": "ok", "residual_m": 0.07, "note": float("nan"), "bag": 2**53 + 1}),
        ("far", {"status": "ok", "residual_m": 0.6, "not_representable": True}),
        (
            "level",
            {
                "status": "flat",
                "residual_m": 0.1,
                "reason": "too-few-points",
                "roof_z_max_m": 8.5,
                "ground_z_m": 0,
            },
        ),
        ("gone", {"status": "none", "residual_m": None, "reason": "no-points", "ground_z_m": 3.0, "bag": 7}),
    ]
    buildings = []
    for number, (name, facts) in enumerate(states):
        at = np.array([14.0 * number, 0, 0])
        meshes = {} if name == "gone" else {"m": mesh.translated(at)}
        buildings.append(Shown(name, meshes, house.vertices + at, np.zeros(len(house.vertices)), facts))
    path = tmp_path_factory.mktemp("scene") / "scene.html"
    layers, crowns = [Layer("m", "Meshes", "#c8603a", True)], [mesh.translated(np.array([14.0, 0, 3]))]
    path.write_text(scene_page("street", ["4 buildings"], buildings, layers, place=Place(crowns)))
    return path


def test_the_page_of_a_scene_has_every_building_the_worst_first(scene: Path) -> None:
    text = scene.read_text(encoding="utf-8")
    assert text.count("<script") == 3 and "document.title='owned'</script>" not in text
    data = json.loads(text.split('id="viewer-data">')[1].split("</script>")[0])
    assert data["together"] and [each["id"] for each in data["buildings"]] == [
        "far",
        "level",
        HOSTILE,
        "gone",
    ]
    assert [each["state"] for each in data["buildings"]] == ["flagged", "flat", "ok", "none"]
    # open ground has not the material of the roof
    assert (
        data["surfaces"] == ["ground", "wall", "roof", "roof", "outer_floor"]
        and "data.surfaces[kind]" in text
    )
    assert data["buildings"][2]["attributes"]["note"] is None and data["buildings"][3]["meshes"] == {}
    # scripts have numbers of 53 bits
    assert [each["attributes"].get("bag") for each in data["buildings"]] == [
        None,
        None,
        "9007199254740993",
        7,
    ]
    # stated, or of the mesh; one without has none to be coloured by
    assert [each["height"] for each in data["buildings"]] == [pytest.approx(9), 8.5, pytest.approx(9), None]


def test_crowns_can_be_hidden_and_a_click_goes_through_them(browser: Any, scene: Path) -> None:
    view = Page(browser.new_page(viewport={"width": 1200, "height": 1000}), scene)
    view.page.locator(".buildings tbody tr").nth(0).click()
    view.page.locator("#viewer canvas").click(position={"x": 3, "y": 3})
    view.page.locator("#viewer canvas").click()
    assert view.building == "far"
    before, box = view.pixels(), view.page.locator("#viewer input[name=plants]")
    assert (
        box.is_checked()
        and view.page.locator("#viewer label:has([name=plants])").inner_text() == "Vegetation"
    )
    box.uncheck()
    assert changed(before, view.pixels()) > 0.02 and view.messages == []


def test_buildings_without_attributes_are_drawn_and_not_while_the_picture_turns(
    browser: Any, tmp_path: Path
) -> None:
    house = p2wss.roof([[0, 0], [10, 0], [10, 8], [0, 8]], 5, [45, 90, 45, 90])
    mesh = mesh_of(house.vertices, np.asarray(house.faces))
    points, path = np.zeros((0, 3)), tmp_path / "scene.html"
    place = Place(others=[mesh.translated(np.array([14.0, 0, 0]))])
    shown = [
        Shown("a", {"m": mesh}, points, np.zeros(0)),
        Shown("b", {"m": mesh.translated(np.array([28.0, 0, 0]))}, points, np.zeros(0)),
    ]
    path.write_text(scene_page("street", [], shown, [Layer("m", "Meshes", "#c8603a", True)], place=place))
    view = Page(browser.new_page(viewport={"width": 1200, "height": 1000}), path)
    view.page.locator("#viewer canvas").click()
    assert view.building == ""
    # the browser of the tests has no graphics card
    before, box = view.pixels(), view.page.locator("#viewer canvas").bounding_box()
    view.page.mouse.move(box["x"] + 5, box["y"] + 5)
    view.page.mouse.down()
    view.page.mouse.move(box["x"] + 6, box["y"] + 5)
    turning = view.pixels()
    view.page.mouse.up()
    others = view.page.locator("#viewer input[name=others]")
    assert changed(before, turning) > changed(before, view.pixels()) + 0.005 and others.is_checked()
    others.uncheck()
    assert changed(before, view.pixels()) > 0.02 and view.messages == []


def test_a_click_on_a_building_or_its_row_shows_its_attributes(browser: Any, scene: Path) -> None:
    view = Page(browser.new_page(viewport={"width": 1200, "height": 1000}), scene)
    first, panel = view.pixels(), view.page.locator(".attributes")
    assert drawn(first) > 0.03 and view.page.title() == "Buildings of street"
    rows = view.page.locator(".buildings tbody tr")
    assert [rows.nth(i).locator("td").first.inner_text() for i in range(4)] == [
        "far",
        "level",
        HOSTILE,
        "gone",
    ]
    for kind in ("residual", "state"):
        view.page.select_option("select.paint", kind)
        assert changed(first, view.pixels()) > 0.02
    rows.nth(0).click()
    assert "residual\n0.600 m\nnot representable\nyes" in panel.inner_text() and view.building == "far"
    # the chosen one is in the middle of the picture now
    rows.nth(2).click()
    assert view.building == HOSTILE
    canvas = view.page.locator("#viewer canvas")
    canvas.click(position={"x": 3, "y": 3})
    assert view.building == ""
    rows.nth(0).click()
    canvas.click(position={"x": 3, "y": 3})
    assert view.building == ""
    canvas.click()
    assert view.building == "far"
    canvas.click(position={"x": 3, "y": 3})
    assert view.building == "" and panel.inner_text() == ""
    view.page.locator(".buildings th").nth(1).click()
    view.page.locator(".buildings th").nth(1).click()
    assert rows.nth(0).locator("td").first.inner_text() != "gone"
    assert view.messages == []


def street(num_houses: int, **facts: Any) -> str:
    """The page of houses in a row, with a point above each and ground; the last has an outline alone."""
    house = p2wss.roof([[0, 0], [10, 0], [10, 8], [0, 8]], 5, [45, 90, 45, 90])
    mesh = mesh_of(house.vertices, np.asarray(house.faces))
    flat = mesh_of(np.array([[0, 0, 0.3], [10, 0, 0.3], [10, 8, 0.3]]), np.array([[0, 1, 2]]))
    buildings = []
    for number in range(num_houses):
        at = np.array([14.0 * number, 0, 0])
        meshes = {"m": mesh} if number < num_houses - 1 else {OUTLINES.key: flat}
        row = {
            "area": 97.50324100028197,
            "status": "ok",
            "residual_m": 0.1,
            "volume_m3": 520.123 + number,
        } | facts
        meshes = {key: each.translated(at) for key, each in meshes.items()}
        buildings.append(Shown(f"house {number}", meshes, (at + np.array([5, 4, 12]))[None], np.ones(1), row))
    ground = mesh_of(np.array([[-9.0, -9, 0], [99, -9, 0], [0, 50, 0]]), np.array([[0, 1, 2]]))
    layers = [Layer("m", "Meshes", "#c8603a", True), OUTLINES]
    place = Place(ground=ground, crs="RGF93 v1 / Lambert-93", meanings={"no-points": "there is none"})
    return scene_page("street", ["some"], buildings, layers, place=place)


def open_street(browser: Any, folder: Path, num_houses: int = 4, scheme: str = "light", **facts: Any) -> Page:
    path = folder / "street.html"
    path.write_text(street(num_houses, **facts))
    return Page(browser.new_page(viewport={"width": 1400, "height": 900}, color_scheme=scheme), path)


def test_points_are_off_among_many_buildings_and_what_can_be_hidden_is_in_sight(
    browser: Any, tmp_path: Path
) -> None:
    for num_houses, has_points in ((100, True), (101, False)):
        view = open_street(browser, tmp_path, num_houses)
        box = view.page.locator("#viewer input[name=points]")
        assert box.is_checked() == has_points and box.bounding_box()["y"] < 900
        assert view.messages == []


def test_ground_outlines_scale_north_and_crs_are_shown(browser: Any, tmp_path: Path) -> None:
    view = open_street(browser, tmp_path)
    before = view.pixels()
    for name in (OUTLINES.key, "ground"):
        box = view.page.locator(f"#viewer input[name={name}]")
        assert box.is_checked()
        box.uncheck()
        after = view.pixels()
        assert changed(before, after) > 0.005
        before = after
    assert "RGF93 v1 / Lambert-93" in view.page.locator("#viewer .facts").inner_text()
    bar = view.page.locator("#viewer .scale i")
    wide, text = bar.bounding_box()["width"], view.page.locator("#viewer .scale").inner_text().strip()
    assert text == "5 m" and 30 < wide <= 125
    # turned, north points elsewhere; nearer by 15 %, the same length is longer
    north = view.page.locator("#viewer .north")
    first = north.get_attribute("style")
    view.page.locator("#viewer canvas").focus()
    for key in ("ArrowLeft", "ArrowLeft", "ArrowUp", "+"):
        view.page.keyboard.press(key)
    assert north.get_attribute("style") != first
    assert bar.bounding_box()["width"] == pytest.approx(wide / 0.85, abs=2)
    view.page.keyboard.press("Home")
    assert north.get_attribute("style") == first and view.messages == []


def test_a_building_is_named_found_and_told_in_words_with_units(browser: Any, tmp_path: Path) -> None:
    view = open_street(browser, tmp_path, reason="no-points")
    canvas, panel = view.page.locator("#viewer canvas"), view.page.locator(".attributes")
    view.page.locator("#viewer .search").fill("house 2")
    rows = view.page.locator(".buildings tbody tr")
    assert [rows.nth(i).is_visible() for i in range(4)] == [False, False, True, False]
    view.page.keyboard.press("Enter")
    assert view.building == "house 2"
    told = panel.inner_text()
    assert "volume\n522.1 m³" in told and "no points: there is none" in told
    # the input's columns come after the results
    assert told.index("residual") < told.index("From the footprints") < told.index("area\n97.50")
    canvas.hover()
    tip = view.page.locator("#viewer .tip")
    tip.wait_for(state="visible")
    assert tip.inner_text() == "house 2"
    canvas.press("Escape")
    assert view.building == "" and view.messages == []


def test_colours_are_offered_for_what_is_known(browser: Any, tmp_path: Path) -> None:
    view = open_street(browser, tmp_path, roof_type="several-slopes", MAT_TOITS="10")
    options = view.page.locator("select.paint option")
    offered = [options.nth(i).inner_text() for i in range(options.count())]
    assert offered == [
        *("walls and roofs", "what to check", "distance to the points", "height", "type of roof", "material")
    ]
    first = view.pixels()
    for name in offered[1:]:
        view.page.select_option("select.paint", label=name)
        assert changed(first, view.pixels()) > 0.01 and view.page.locator("#viewer .legend label").count() > 0
    assert view.page.locator("#viewer .legend").inner_text() == "tile (4)"


def test_a_picture_is_saved_and_the_page_is_dark_at_night(browser: Any, tmp_path: Path) -> None:
    view = open_street(browser, tmp_path)
    with view.page.expect_download() as download:
        view.page.locator("#viewer .save").click()
    download.value.save_as(tmp_path / "picture.png")
    assert download.value.suggested_filename == "Buildings of street.png"
    assert drawn(imread(tmp_path / "picture.png")[..., :3]) > 0.05
    night = open_street(browser, tmp_path, scheme="dark")
    for pixels, is_dark in ((view.pixels(), False), (night.pixels(), True)):
        assert (pixels[8, 8].mean() < 0.5) == is_dark
    color = night.page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert max(map(int, color[4:-1].split(","))) < 80
