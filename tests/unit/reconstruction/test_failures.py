"""Nothing ends a run: errors planted at each station concern one building, block or file, and all else is the same."""

from __future__ import annotations

import importlib
import json
import os
import re
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import geopandas as gpd
import laspy
import numpy as np
import pyproj
import pytest
import shapely

from p2wss import cli
from p2wss.reconstruction.running.failures import Failures, note, surviving
from p2wss.storage.messages import InputError

# before the fixture that makes all tests strict
MET = Failures.met
EAST, NORTH = 652_000.0, 6_861_000.0
# three in a row, and three alone, of which the first is the victim
BOXES = [(0, 0), (8, 0), (16, 0), (40, 0), (60, 0), (80, 0)]
IDS = ["row1", "row2", "row3", "victim", "alone1", "alone2"]
VICTIM = (EAST + 40, EAST + 48)


@pytest.fixture(autouse=True)
def met(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Failures, "met", MET)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """cloud.laz and footprints.gpkg."""
    folder, draw = tmp_path_factory.mktemp("town"), np.random.default_rng(0)
    boxes = [shapely.box(x, y, x + 8, y + 10) for x, y in BOXES]
    x, y = draw.uniform(-5, 95, 12_000), draw.uniform(-5, 15, 12_000)
    inside = shapely.contains_xy(shapely.union_all(boxes), x, y)
    z = np.where(inside, 5 + 0.8 * np.minimum(y, 10 - y), 0) + 0.02 * draw.standard_normal(len(x))
    # three trees
    tree = (np.abs(y - 13) < 1.5) & (x % 30 < 3)
    z[tree] = 7 - np.hypot(x[tree] % 30 - 1.5, y[tree] - 13)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.01), np.array([EAST, NORTH, 0])
    header.add_crs(pyproj.CRS.from_epsg(2154))
    las = laspy.LasData(header)
    las.x, las.y, las.z = x + EAST, y + NORTH, z
    las.classification = np.select([inside, tree], [6, 5], 2).astype(np.uint8)
    las.write(folder / "cloud.laz")
    shapes = [shapely.affinity.translate(box, EAST, NORTH) for box in boxes]
    gpd.GeoDataFrame({"id": IDS}, geometry=shapes, crs=2154).to_file(folder / "footprints.gpkg")
    return folder


def run(town: Path, out: Path, *options: str) -> int:
    files = [str(town / name) for name in ("cloud.laz", "footprints.gpkg")]
    return cli.main(["reconstruct", *files, str(out), "--format", "cityjsonseq,obj", *options])


def rows_of(out: Path) -> dict[str, str]:
    """The line of each building."""
    lines = (out / "cloud.city.jsonl").read_text().splitlines()
    return {json.loads(line)["id"]: line for line in lines[1:]}


def status_of(row: str) -> tuple[str, str]:
    attributes = next(iter(json.loads(row)["CityObjects"].values()))["attributes"]
    return attributes["status"], attributes["reason"]


def alike(row: str) -> str:
    """A row without the deviation of its shift, to which the blocks around contribute."""
    return re.sub(r'"shift_sd_m":[^,]*,', "", row)


def content(out: Path) -> Any:
    return json.loads((out / "cloud.json").read_text())


@pytest.fixture(scope="module")
def plain(town: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("plain")
    assert run(town, out) == 0
    assert not list(out.glob("*.log")) and content(out)["errors"] == []
    assert {status_of(row)[0] for row in rows_of(out).values()} == {"ok"}
    return rows_of(out)


def is_there(x_m: np.ndarray) -> bool:
    """Whether some of these are the victim's."""
    return bool(((x_m >= VICTIM[0] - 0.1) & (x_m <= VICTIM[1] + 0.1)).any())


Plant = Callable[[str, Callable[..., bool], Callable[[], object]], None]


@pytest.fixture
def plant(monkeypatch: pytest.MonkeyPatch) -> Plant:
    """Have a function, by its module and name, do something at the victim."""

    def planted(name: str, is_victim: Callable[..., bool], does: Callable[[], object]) -> None:
        module = importlib.import_module(f"p2wss.{name.rpartition('.')[0]}")
        function = getattr(module, name.rpartition(".")[2])

        def replaced(*arguments: Any, **options: Any) -> Any:
            if is_victim(*arguments):
                does()
            return function(*arguments, **options)

        monkeypatch.setattr(module, name.rpartition(".")[2], replaced)

    return planted


def fails(error: type[BaseException] = ZeroDivisionError) -> Callable[[], object]:
    def does() -> object:
        raise error("planted")

    return does


def of_buildings(*arguments: Any) -> bool:
    return any(building.building_id == "victim" for building in next(a for a in arguments[::-1] if a))


BY_BUILDINGS: dict[str, Callable[..., bool]] = {
    "reconstruction.pipeline.crop_cloud": lambda cloud, polygons, buffer_m: is_there(polygons.xy_m[:, 0]),
    "reconstruction.pipeline.roofs_around": lambda cloud, polygons, crops: is_there(polygons.xy_m[:, 0]),
    "reconstruction.pipeline.ground_of": lambda cloud, crops, polygons, dtm: is_there(polygons.xy_m[:, 0]),
    "reconstruction.pipeline._dates": lambda cloud, point: is_there(cloud.x_m[point][:1]),
    "reconstruction.pipeline.with_own_classes": lambda building: building.building_id == "victim",
    "reconstruction.product.with_supposed_roofs": of_buildings,
    "fit.fitting.fit": lambda buildings, *more: of_buildings(buildings),
    "fit.fitting.prepare": lambda task: task.building.building_id == "victim",
    "reconstruction.product._as_valid_solid": lambda row: row.building_id == "victim" and row.status == "ok",
    "reconstruction.result.measure": lambda mesh: is_there(mesh.vertex_m[:, 0]),
    "reconstruction.pipeline.result_of": lambda row, *more: row.building.building_id == "victim",
    "reconstruction.pipeline.attributes": lambda result: result.reconstruction.building_id == "victim",
}
# where these fail, a flat roof would, too
WITHOUT_ROOF = ("crop_cloud", "roofs_around", "ground_of", "_dates", "measure", "result_of", "attributes")


@pytest.mark.parametrize("name", BY_BUILDINGS)
def test_an_error_at_any_station_is_that_of_one_building(
    name: str,
    plant: Plant,
    town: Path,
    plain: dict[str, str],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    if name.endswith(".attributes"):
        of_result = BY_BUILDINGS[name]
        plant(name, lambda result, **more: of_result(result), fails())
    else:
        plant(name, BY_BUILDINGS[name], fails())
    assert run(town, tmp_path) == 0
    rows = rows_of(tmp_path)
    assert sorted(rows) == sorted(IDS)
    roof = "none" if name.endswith(WITHOUT_ROOF) else "flat"
    assert status_of(rows.pop("victim")) == (roof, "internal-error")
    assert {each: alike(row) for each, row in rows.items()} == {each: alike(plain[each]) for each in rows}
    about = [line for line in caplog.messages if line.startswith("warning: victim: internal error")]
    assert len(about) == 1 and "ZeroDivisionError: planted" in about[0] and ".errors.log" in about[0]
    assert content(tmp_path)["buildings"]["reasons"] == {"internal-error": 1}
    assert str(tmp_path / "cloud.errors.log") in caplog.text
    trace = (tmp_path / "cloud.errors.log").read_text()
    assert trace.startswith("victim\nTraceback") and "in replaced" in trace
    assert content(tmp_path)["errors"] == ["victim"] and "cloud.errors.log" in content(tmp_path)["sha256"]


def test_without_a_flat_roof_either_there_is_none(
    plant: Plant, town: Path, plain: dict[str, str], tmp_path: Path
) -> None:
    plant("fit.fitting.fit", BY_BUILDINGS["fit.fitting.fit"], fails())
    plant(
        "reconstruction.product.with_fallback",
        lambda rows, *more: not all(row.has_mesh for row in rows),
        fails(),
    )
    assert run(town, tmp_path) == 0
    assert status_of(rows_of(tmp_path)["victim"]) == ("none", "internal-error")


def recurses() -> None:
    recurses()


def wants_memory() -> None:
    size = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + 2**28, resource.RLIM_INFINITY))
    np.ones(2**30)


@pytest.mark.parametrize("threads", ["1", "2"])
@pytest.mark.parametrize(
    ("does", "last"),
    [
        (fails(shapely.errors.GEOSException), "shapely.errors.GEOSException: planted"),
        (recurses, "RecursionError: maximum recursion depth exceeded"),
        (wants_memory, "numpy._core._exceptions._ArrayMemoryError: Unable to allocate 8.00 GiB"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "its process was killed by SIGKILL"),
        (lambda: os.kill(os.getpid(), signal.SIGSEGV), "its process was killed by SIGSEGV"),
        (os.abort, "its process was killed by SIGABRT"),
    ],
    ids=["GEOS", "recursion", "memory", "killed", "segmentation fault", "abort"],
)
def test_no_kind_of_error_ends_a_run(
    does: Callable[[], object],
    last: str,
    threads: str,
    plant: Plant,
    town: Path,
    plain: dict[str, str],
    tmp_path: Path,
) -> None:
    plant("fit.fitting.prepare", BY_BUILDINGS["fit.fitting.prepare"], does)
    assert run(town, tmp_path, "--threads", threads) == 0
    rows = rows_of(tmp_path)
    assert status_of(rows.pop("victim")) == ("flat", "internal-error")
    assert {each: alike(row) for each, row in rows.items()} == {each: alike(plain[each]) for each in rows}
    trace = (tmp_path / "cloud.errors.log").read_text()
    assert trace.splitlines()[-1].startswith(last)


def test_too_many_failures_and_strict(
    plant: Plant, town: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    plant("fit.fitting.prepare", BY_BUILDINGS["fit.fitting.prepare"], fails())
    assert run(town, tmp_path, "--max-failed-fraction", "0.16") == 1
    assert "error: a file is missing, or more buildings failed" in caplog.text
    assert len(rows_of(tmp_path)) == len(IDS)
    for threads in ("1", "2"):
        with pytest.raises(ZeroDivisionError, match="planted"):
            run(town, tmp_path / "strict", "--strict", "--threads", threads)
    assert not (tmp_path / "strict").exists()


def test_a_killed_process_is_an_error_if_strict(plant: Plant, town: Path, tmp_path: Path) -> None:
    is_victim = BY_BUILDINGS["fit.fitting.prepare"]
    plant("fit.fitting.prepare", is_victim, lambda: os.kill(os.getpid(), signal.SIGKILL))
    with pytest.raises(ChildProcessError, match="SIGKILL"):
        run(town, tmp_path, "--strict")


OF_BLOCKS: dict[str, tuple[Callable[..., bool], str, tuple[str, ...]]] = {
    "footprints.cleaning.clean_coverage": (
        lambda shapes, config: is_there(shapely.bounds(shapes)[:, 0]),
        "cleaning of victim",
        (),
    ),
    "reconstruction.registration.register.search_shift": (
        lambda edge, xy_m, weight: is_there(edge[:, 0]),
        "registration of the block of victim",
        (),
    ),
    "reconstruction.registration.register.solve_shift": (
        lambda edge, *more: is_there(edge[:, 0]),
        "registration of the block of victim",
        (),
    ),
    "reconstruction.skin._skin": (
        lambda names, *more: "row1" in names,
        "skin of the block of row1",
        ("--skin",),
    ),
    "reconstruction.skin.block_skins.skins": (lambda *more: True, "skins", ("--skin",)),
    "reconstruction.skin.block_skins.wedges": (
        lambda skin: "victim" in skin.building_ids,
        "wedges of the skin of victim",
        ("--wedges",),
    ),
    "reconstruction.outputs.vegetation._plants": (
        lambda *more: True,
        f"vegetation around {EAST - EAST % 256:.0f} {NORTH - NORTH % 256:.0f}",
        ("--vegetation",),
    ),
    "reconstruction.pipeline.party_wall_areas_m2": (lambda *more: True, "areas of party walls", ()),
}


@pytest.mark.parametrize("name", OF_BLOCKS)
def test_an_error_at_a_block_leaves_what_was_there(
    name: str, plant: Plant, town: Path, plain: dict[str, str], tmp_path: Path
) -> None:
    is_victim, what, options = OF_BLOCKS[name]
    plant(name, is_victim, fails())
    assert run(town, tmp_path, *options) == 0
    rows = {each: row for each, row in rows_of(tmp_path).items() if each in IDS}
    assert {status_of(row)[0] for row in rows.values()} == {"ok"}
    if "party" not in what:
        same = [each for each in IDS if each != "victim"]
        assert [alike(rows[each]) for each in same] == [alike(plain[each]) for each in same]
    assert what in content(tmp_path)["errors"]
    assert "ZeroDivisionError: planted" in (tmp_path / "cloud.errors.log").read_text()
    groups = [line for line in (tmp_path / "cloud.obj").read_text().splitlines() if line.startswith("o ")]
    assert len(groups) == (4 if "--skin" in options and "skin" not in what else 6)


def test_a_registration_that_fails_as_a_whole(plant: Plant, town: Path, tmp_path: Path) -> None:
    plant("reconstruction.area.register", lambda *more: True, fails())
    assert run(town, tmp_path) == 0
    assert {status_of(row)[0] for row in rows_of(tmp_path).values()} == {"ok"}
    assert content(tmp_path)["errors"] == sorted(f"registration of {each}" for each in IDS)


def test_a_footprint_that_cannot_even_be_split(
    plant: Plant, town: Path, plain: dict[str, str], tmp_path: Path
) -> None:
    is_victim = lambda features, *more: is_there(shapely.bounds(features.geometry)[:, 0])  # noqa: E731
    plant("footprints.cleaning.split_parts", is_victim, fails())
    plant("reconstruction.area.repaired", lambda shapes: is_there(shapely.bounds(shapes)[:, 0]), fails())
    assert run(town, tmp_path) == 0
    rows = rows_of(tmp_path)
    assert status_of(rows.pop("victim")) == ("none", "internal-error")
    assert {each: alike(row) for each, row in rows.items()} == {each: alike(plain[each]) for each in rows}


def test_a_file_that_cannot_be_made_is_missing(
    plant: Plant, town: Path, plain: dict[str, str], tmp_path: Path
) -> None:
    plant("reconstruction.outputs.exports.page_of_run", lambda *more: True, fails())
    assert run(town, tmp_path, "--format", "cityjsonseq,report,gpkg") == 1
    files = content(tmp_path)["files"]
    assert files == ["cloud.city.jsonl", "cloud.gpkg", "cloud.errors.log"]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*files, "cloud.json"])
    assert rows_of(tmp_path) == plain


@pytest.mark.parametrize("error", [KeyboardInterrupt, InputError, SystemExit])
def test_what_is_no_internal_error_is_raised(error: type[BaseException]) -> None:
    with Failures().met(), pytest.raises(error):
        surviving(lambda parts: fails(error)(), [1], lambda *more: [])


def test_halves_until_one_fails() -> None:
    def function(parts: list[int]) -> Iterator[int]:
        for part in parts:
            yield part // (part - 3)

    def instead(part: int, trace: str) -> list[int]:
        note(f"part {part}", trace, "nothing")
        return [-1]

    failures = Failures()
    with failures.met():
        assert surviving(function, list(range(6)), instead) == [0, -1, -2, -1, 4, 2]
        assert surviving(function, [], instead) == []
    assert list(failures.traces) == ["part 3"] and failures.text.startswith("part 3\nTraceback")
    for strict in (Failures(strict=True).met(), Failures().met()):
        with strict:
            pass
        with pytest.raises(ZeroDivisionError):
            surviving(function, [3], instead)
