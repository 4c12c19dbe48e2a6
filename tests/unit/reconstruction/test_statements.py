"""The control houses from files that state their CRS and units in many ways: right, or refused in one line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import control_houses as houses
import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pyproj
import pytest
import rasterio
import shapely
from places import SHARED

import p2wss
from p2wss.config import as_config
from p2wss.reconstruction.inputs import check_inputs
from p2wss.reconstruction.points import plausibility
from p2wss.storage.messages import InputError

CASES = SHARED / "data" / "cases"
needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason="no shared/data/cases")
UTM, FOOT = "EPSG:26910", houses.FOOT_M


def built(cloud: Any, footprints: Any, **options: Any) -> dict[str, tuple[float, float]]:
    """Volume and eave height of each building that has a mesh."""
    options.setdefault("config", {"reconstruct": {"registration": "never"}})
    with p2wss.reconstruct(cloud, footprints, progress=False, model="none", **options) as scene:
        return {
            name: (float(each.mesh.volume), each.attributes["eave_height_m"])
            for name, each in scene.items()
            if each.solid is not None
        }


def assert_right(result: dict[str, tuple[float, float]]) -> None:
    assert set(result) == {"gable", "flat"}
    for name, (volume_m3, eave_m) in result.items():
        assert volume_m3 == pytest.approx(houses.VOLUME_M3[name], rel=0.015)
        assert eave_m == pytest.approx({"gable": houses.EAVE_M, "flat": houses.FLAT_M}[name], abs=0.1)


@needs_cases
@pytest.mark.parametrize(
    ("cloud", "footprints"),
    [
        ("vertical_units_geokeys/utm_metres_z_usft.laz", "vertical_units_geokeys/f26910.gpkg"),
        ("vertical_units_geokeys/wkt_horizontal_geokeys_z_usft.laz", "vertical_units_geokeys/f26910.gpkg"),
        ("web_mercator_cloud/webmerc.laz", "web_mercator_cloud/f2154.gpkg"),
    ],
)
def test_reported_clouds(cloud: str, footprints: str) -> None:
    assert_right(built(CASES / cloud, CASES / footprints))


@needs_cases
def test_a_reported_cloud_that_states_another_crs() -> None:
    folder = CASES / "cloud_states_wrong_crs"
    files = folder / "utm_but_says_4326.laz", folder / "f26910.gpkg"
    with pytest.raises(InputError, match="in degrees, but its bounds are not; state its CRS with crs="):
        built(*files)
    assert_right(built(*files, crs=UTM))


@needs_cases
@pytest.mark.parametrize("name", ["undeclared_-9999", "int16_scale_0.01", "heights_ft_band_unit"])
def test_reported_terrains(name: str, tmp_path: Path) -> None:
    folder = CASES / "terrain"
    files = folder / "c.laz", folder / "f.gpkg"
    with p2wss.reconstruct(*files, terrain=folder / f"{name}.tif", progress=False) as scene:
        scene.write(tmp_path, ["ply"])
    import trimesh

    block = trimesh.load_mesh(tmp_path / "c.ply")
    low, high = block.bounds[:, 2]
    # the terrain is level; its block reaches 2 m below the ground, and the ridge is 8.36 m above it
    assert 10 < high - low < 11.5


@needs_cases
def test_a_reported_outline_and_its_parts() -> None:
    folder = CASES / "outline_and_parts"
    result = built(folder / "c.laz", folder / "parts.geojson")
    assert set(result) == {"way/2", "way/3", "way/9"}
    assert sum(volume for volume, _ in result.values()) == pytest.approx(1241, rel=0.015)


@needs_cases
@pytest.mark.parametrize("name", ["f.geoparquet", "F2.PARQUET", "first_layer_points.gpkg"])
def test_reported_files_of_footprints(name: str) -> None:
    assert_right(built(CASES / "footprint_files" / "c.laz", CASES / "footprint_files" / name))


@needs_cases
def test_reported_ids_of_relations_and_ways() -> None:
    folder = CASES / "footprint_files"
    assert set(built(folder / "c.laz", folder / "osm_multipolygons.gpkg")) == {"5001", "77"}


@needs_cases
def test_a_reported_empty_shell_is_not_valid() -> None:
    validity = p2wss.check(CASES / "check_empty_shell" / "no_shell_faces.city.json")
    assert list(validity.invalid.values()) == [["301 the shell has fewer than four faces"]]


def test_layers_endings_and_ids_of_ways(tmp_path: Path) -> None:
    frame = houses.footprints(osm_id=[None, "77"], osm_way_id=["5001", None]).drop(columns="id")
    points = frame.set_geometry(frame.geometry.centroid)
    points.to_file(tmp_path / "f.gpkg", layer="addresses")
    frame.to_file(tmp_path / "f.gpkg", layer="buildings")
    cloud = houses.write_cloud(tmp_path / "c.laz")
    assert set(built(cloud, tmp_path / "f.gpkg")) == {"5001", "77"}
    frame.to_parquet(tmp_path / "F.GEOPARQUET")
    (tmp_path / "F.GEOPARQUET").rename(tmp_path / "f.data")
    assert set(built(cloud, tmp_path / "f.data")) == {"5001", "77"}


def test_a_layer_by_name(tmp_path: Path) -> None:
    path, cloud = tmp_path / "f.gpkg", houses.write_cloud(tmp_path / "c.laz")
    houses.footprints().iloc[:1].to_file(path, layer="old")
    houses.footprints().to_file(path, layer="new")
    config = {"reconstruct": {"footprint_layer": "new", "registration": "never"}}
    assert_right(built(cloud, path, config=config))
    config["reconstruct"]["footprint_layer"] = "newest"
    with pytest.raises(InputError, match=r"f\.gpkg: has no layer newest; its layers are old, new"):
        built(cloud, path, config=config)


def test_levels_of_a_part_serve_where_points_do_not_decide(tmp_path: Path) -> None:
    frame = houses.footprints().rename(columns={"id": "osm_way_id"}).assign(osm_id=None, building=None)
    frame["other_tags"] = '"building:part"=>"yes","building:levels"=>"2"'
    frame.to_file(tmp_path / "f.gpkg")
    cloud = laspy.read(houses.write_cloud(tmp_path / "c.laz"))
    local = cloud.xyz[:, :2] - houses.PLACES["EPSG:2154"]
    cloud.points = cloud.points[~shapely.contains_xy(houses.FLAT.buffer(1), *local.T)]
    cloud.write(tmp_path / "c.laz")
    config = {"reconstruct": {"registration": "never"}}
    with p2wss.reconstruct(tmp_path / "c.laz", tmp_path / "f.gpkg", progress=False, config=config) as scene:
        assert scene["gable"].status == "ok"
        assert scene["flat"].reason == "height-from-attribute"
        assert scene["flat"].mesh.volume == pytest.approx(10 * 10 * 6.0, rel=0.01)


def test_solids_without_faces_or_shells_are_not_valid(tmp_path: Path) -> None:
    start = (
        '{"type": "CityJSON", "version": "2.0", "transform": {"scale": [1, 1, 1], "translate": [0, 0, 0]},'
    )
    for boundaries in ("[[]]", "[]"):
        geometry = f'[{{"type": "Solid", "lod": "2", "boundaries": {boundaries}}}]'
        objects = f'{{"a": {{"type": "Building", "geometry": {geometry}}}}}'
        (tmp_path / "a.json").write_text(f'{start} "CityObjects": {objects}, "vertices": []}}')
        assert list(p2wss.check(tmp_path / "a.json").invalid) == ["a (LoD 2)"]


@needs_cases
def test_a_reported_footprint_that_is_too_small() -> None:
    folder = CASES / "footprint_files"
    with pytest.raises(InputError, match="none of its 1 footprints can be built: too-small: 1"):
        built(folder / "c.laz", folder / "only_tiny.gpkg")


def test_points_around_but_none_on_the_footprints(tmp_path: Path) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz")
    beside = houses.footprints()
    beside.geometry = [shapely.affinity.translate(shape, 60, 0) for shape in beside.geometry]
    with pytest.raises(InputError, match="points around the 2 footprints of footprints, but none on them"):
        built(cloud, beside)


def test_degrees_without_an_extent_in_the_header(tmp_path: Path) -> None:
    path = houses.write_cloud(tmp_path / "c.las", crs="EPSG:4326")
    content = bytearray(path.read_bytes())
    content[179:227] = bytes(48)  # maxima and minima
    path.write_bytes(content)
    assert_right(built(path, houses.footprints()))


@pytest.mark.parametrize("factor", [FOOT, 1 / FOOT, 0.01, 100])
def test_terrain_in_another_unit_is_named(tmp_path: Path, factor: float) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz")
    values = (houses.heights_m() / factor).astype(np.float32)
    terrain = houses.write_terrain(tmp_path / "t.tif", values)
    if abs(factor - 0.01) < 1e-9:  # 10 km: no ground at all
        with pytest.raises(InputError, match="has no height at any of the 2 footprints"):
            built(cloud, houses.footprints(), terrain=terrain)
        return
    with pytest.raises(
        InputError, match=r"t\.tif: its heights are .* from the ground of the points"
    ) as error:
        built(cloud, houses.footprints(), terrain=terrain)
    text = str(error.value)
    assert "\n" not in text
    if factor == FOOT:
        assert "as if they were in ft; state reconstruct.terrain_unit ft" in text
    # the remedies work
    for unit in re.findall(r"reconstruct\.terrain_unit (\S+)", text):
        config = {"reconstruct": {"terrain_unit": unit.strip(","), "registration": "never"}}
        assert_right(built(cloud, houses.footprints(), terrain=terrain, config=config))


def test_terrain_of_another_height_system_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz")
    terrain = houses.write_terrain(tmp_path / "t.tif", (houses.heights_m() + 46).astype(np.float32))
    with pytest.raises(InputError, match=r"\+46\.0 m from the ground .* same height system"):
        built(cloud, houses.footprints(), terrain=terrain)
    # near ones are of another datum, or of another year
    for gap_m in (0.6, 1.4):
        near = houses.write_terrain(tmp_path / "n.tif", (houses.heights_m() + gap_m).astype(np.float32))
        with caplog.at_level("INFO"):
            built(cloud, houses.footprints(), terrain=near)
        is_noted = "note: " + f"{near}: its heights are +1.4 m from the ground of the points" in caplog.text
        assert is_noted == (gap_m > 1)


@pytest.mark.parametrize(("offset_m", "factor", "is_of_ellipsoid"), [(43, 1, True), (0, 100, False)])
def test_a_terrain_above_the_ellipsoid_at_the_sea_is_not_of_another_unit_alone(
    offset_m: float, factor: float, is_of_ellipsoid: bool
) -> None:
    """Its heights by a hundred are as near to ground of 0 to 2 m as centimetres would be."""
    ground_m = np.linspace(0, 2, 9)
    unknown = np.full(9, np.nan)
    sample = plausibility.Sample(
        ground_m, unknown, unknown, unknown, ground_m * factor + offset_m, unknown, unknown, np.zeros(2)
    )
    with pytest.raises(InputError, match=r"as if they were in cm; .*state --terrain-unit cm") as error:
        plausibility.check_terrain(sample, "dtm.tif")
    assert ("as the ellipsoid is from the sea, or" in str(error.value)) == is_of_ellipsoid


def test_slender_parts_that_points_show_are_no_houses_in_feet() -> None:
    unknown, num = np.full(5, np.nan), np.full(5, 100.0)
    sample = plausibility.Sample(
        unknown, np.full(5, 18.0), np.full(5, 8.0), unknown, unknown, num, unknown, np.zeros(2)
    )
    assert "state --height-unit ft" in plausibility.odd_houses(sample, 1.0, "")
    assert not plausibility.odd_houses(sample, 1.0, "", are_mapped=False)


def test_unstated_feet_are_named_where_footprints_state_heights(tmp_path: Path) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", UTM, height_unit_m=FOOT)
    known = houses.footprints(UTM, height=[8.36, 6.0])
    with pytest.raises(InputError, match=r"as if heights were in ft; state reconstruct\.height_unit ft"):
        built(cloud, known)
    for unit, is_right in (("ft", True), ("m", False)):
        config = {"reconstruct": {"height_unit": unit, "registration": "never"}}
        result = built(cloud, known, config=config)
        assert (abs(result["flat"][1] - 6) < 0.1) == is_right


def test_heights_of_footprints_in_feet_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", UTM)
    built(cloud, houses.footprints(UTM, height=[8.36, 6.0]))
    assert "as if in feet" not in caplog.text
    built(cloud, houses.footprints(UTM, height=[8.36 / FOOT, 6.0 / FOOT]))
    assert "times those of points, as if in feet; where a building has no points" in caplog.text


def test_unstated_feet_are_doubted_where_houses_are_slender(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", UTM, height_unit_m=FOOT)
    built(cloud, houses.footprints(UTM))
    assert "times as high as wide, as if heights were in ft; state reconstruct.height_unit ft" in caplog.text
    caplog.clear()
    built(houses.write_cloud(tmp_path / "d.laz", UTM), houses.footprints(UTM))
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


def test_stated_feet_are_doubted_where_houses_are_low(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", UTM, stated=houses.header(keys={3072: 26910, 4099: 9002}))
    built(cloud, houses.footprints(UTM))
    assert "houses are 1.96 m high, as if heights were in m; state reconstruct.height_unit m" in caplog.text


def test_heights_stated_alone_count_of_points_in_memory_too(tmp_path: Path) -> None:
    """As of their file, without a CRS: feet were taken for metres."""
    stated = houses.header(keys={4099: 9003})
    path = houses.write_cloud(tmp_path / "c.laz", UTM, height_unit_m=houses.SURVEY_FOOT_M, stated=stated)
    of_file, of_points = (built(cloud, houses.footprints(UTM)) for cloud in (path, laspy.read(path)))
    assert_right(of_points)
    assert of_file == of_points


@pytest.mark.parametrize(("unit_m", "height_m"), [(1e9, "0.00"), (-1.0, "-6.")])
def test_points_without_heights_and_depths_are_doubted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, unit_m: float, height_m: str
) -> None:
    built(houses.write_cloud(tmp_path / "c.laz", height_unit_m=unit_m), houses.footprints())
    assert f"houses are {height_m}" in caplog.text and "are z of the points heights" in caplog.text


@pytest.mark.parametrize(
    ("true_m", "stated", "words"),
    [
        (
            1.0,
            "cm",
            "houses are 0.06 m high, as if heights were in m; state reconstruct.height_unit m instead of cm",
        ),
        (
            0.01,
            "m",
            "times as high as wide, as if heights were in cm; state reconstruct.height_unit cm instead of m",
        ),
        (
            0.01,
            "",
            "as if heights were in cm; state reconstruct.height_unit cm, or reconstruct.height_unit m if",
        ),
        (0.01, "cm", ""),
        (1.0, "m", ""),
        (1.0, "ft", ""),
    ],
)
def test_a_unit_that_makes_odd_houses_is_doubted_even_if_the_user_states_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, true_m: float, stated: str, words: str
) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", UTM, height_unit_m=true_m)
    built(cloud, houses.footprints(UTM), config={"reconstruct": {"height_unit": stated}})
    told = [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]
    assert words in "".join(told) and len(told) == bool(words)


def test_a_terrain_of_stated_unit_that_is_far_from_the_points_is_doubted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz")
    terrain = houses.write_terrain(tmp_path / "t.tif", (houses.heights_m() + 46).astype(np.float32))
    config = {"reconstruct": {"terrain_unit": "m", "registration": "never"}}
    assert_right(built(cloud, houses.footprints(), terrain=terrain, config=config))
    assert "its heights are +46.0 m from the ground of the points" in caplog.text


def test_of_roofs_alone_the_terrain_is_the_ground(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Houses 30 m above it, too: lower ones of no height would tell that it is in another unit."""
    xyz, classes = houses.points()
    x, y = houses.PLACES["EPSG:2154"]
    roofs = np.column_stack([np.add(xyz, [x, y, 0]), classes])[classes == 6]
    for floor_m in (0.0, 30.0):
        terrain = houses.write_terrain(tmp_path / "t.tif", (houses.heights_m() - floor_m).astype(np.float32))
        with p2wss.reconstruct(roofs, houses.footprints(), terrain=terrain, progress=False) as scene:
            volume_m3 = [each.mesh.volume for each in scene.values()]
        assert volume_m3 == pytest.approx(
            [houses.VOLUME_M3["gable"] + 96 * floor_m, 600 + 100 * floor_m], rel=0.03
        )
    assert "no ground is seen" not in caplog.text
    with p2wss.reconstruct(roofs, houses.footprints(), progress=False) as scene:
        assert {each.attributes["ground_source"] for each in scene.values()} == {"own-points"}
    assert (
        "no ground is seen around 2 of 2 buildings" in caplog.text and "; terrain= states it" in caplog.text
    )
    # nor by points without class on the roof beside, where class ground is far away
    caplog.clear()
    roofs[::10, 3] = 1
    roofs[roofs[:, 0] < np.mean(houses.footprints().total_bounds[::2]), 2] += 10
    corner = [*houses.footprints().total_bounds[:2] - 40, roofs[:, 2].min() - 5, 2]
    with p2wss.reconstruct(np.vstack([roofs, corner]), houses.footprints(), progress=False) as scene:
        assert "unclassified-points" in {each.attributes["ground_source"] for each in scene.values()}
    assert "no ground is seen around" in caplog.text


@pytest.mark.parametrize("ground", [1, 2])
def test_without_class_building_a_footprint_on_ground_is_flagged_if_that_has_a_class(ground: int) -> None:
    """A copy of the houses 20 m to the north, where there are none."""
    xyz, classes = houses.points()
    cloud = np.column_stack([np.add(xyz, [*houses.PLACES["EPSG:2154"], 0]), classes])
    cloud[:, 3] = np.where(cloud[:, 3] == 2, ground, 1)
    here = houses.footprints().to_crs(2154)
    there = here.assign(geometry=here.geometry.translate(0, 20), id=here["id"] + " gone")
    with p2wss.reconstruct(cloud, pd.concat([here, there]), progress=False, model="none") as scene:
        flags = {name: each.attributes["footprint_flags"] for name, each in scene.items()}
    is_gone = {name: flag == "no-building" for name, flag in flags.items()}
    assert is_gone == {name: ground == 2 and name.endswith("gone") for name in flags} and len(flags) == 4


@pytest.mark.parametrize("kind", ["file", "table", "country", "world", "none"])
@pytest.mark.parametrize("crs", ["EPSG:2154", "EPSG:3857"])
def test_of_the_terrain_of_a_country_the_part_around_the_footprints_is_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str, crs: str
) -> None:
    """Read whole, its 1.6 billion cells would take 6.4 GB. Footprints of the country are cut by the cloud."""
    cloud, footprints = houses.write_cloud(tmp_path / "c.laz", crs=crs), houses.footprints()
    if kind == "country":
        far = footprints.set_geometry(footprints.translate(15_000, 15_000)).assign(id=["a", "b"])
        footprints = pd.concat([footprints, far])
    given = footprints
    if kind == "world":
        poles = {
            "id": ["a", "b"],
            "geometry": [shapely.box(-180, -90, -179, -89), shapely.box(179, 89, 180, 90)],
        }
        given = pd.concat([footprints.to_crs(4326), gpd.GeoDataFrame(poles, crs=4326)])
    path = tmp_path / "f.gpkg"
    given.to_file(path)
    x, y = houses.PLACES["EPSG:2154"]
    profile = {"width": 40_000, "height": 40_000, "count": 1, "dtype": "float32", "crs": "EPSG:2154"}
    corner = rasterio.transform.from_origin(x - 20_000, y + 20_000, 1, 1)
    with rasterio.open(
        tmp_path / "t.tif", "w", transform=corner, tiled=True, SPARSE_OK=True, nodata=-9999, **profile
    ) as raster:
        heights_m = np.tile(houses.GROUND_M + 0.01 * np.arange(600, dtype=np.float32), (600, 1))
        raster.write(heights_m, 1, window=((19_700, 20_300), (19_700, 20_300)))
    given = {"table": footprints, "none": None}.get(kind, path)
    config = as_config(None)
    with caplog.at_level("INFO"):
        inputs = check_inputs(cloud, given, config, terrain=tmp_path / "t.tif")
    assert re.search(r"of its 40000 x 40000 cells, the \d+ x \d+ around the place of the run", caplog.text)
    assert inputs.terrain is not None and inputs.terrain[0].height_m.size < 600**2
    at_x, at_y = np.add([[-20.5, -4.0, 27.5], [-14.0, 8.0, 20.5]], [[x], [y]])
    if crs != "EPSG:2154":
        at_x, at_y = pyproj.Transformer.from_crs("EPSG:2154", inputs.crs, always_xy=True).transform(
            at_x, at_y
        )
    expected_m = houses.GROUND_M + 0.01 * (np.array([-20.5, -4.0, 27.5]) + 299.5)
    np.testing.assert_allclose(inputs.terrain[0].interpolated(at_x, at_y), expected_m, atol=1e-2)
    with rasterio.open(tmp_path / "t.tif", "r+") as raster:
        raster.transform = rasterio.transform.from_origin(x + 20_000, y + 20_000, 1, 1)
    with pytest.raises(InputError, match=r"t\.tif: .* has no cell at the place of the run: is that its CRS"):
        check_inputs(cloud, given, config, terrain=tmp_path / "t.tif")


def test_a_cloud_and_a_terrain_in_mercator(tmp_path: Path) -> None:
    cloud = houses.write_cloud(tmp_path / "c.laz", crs="EPSG:3857")
    here = houses.write_terrain(tmp_path / "t.tif", houses.heights_m().astype(np.float32))
    assert_right(built(cloud, houses.footprints(crs="EPSG:4326"), terrain=here))


@pytest.mark.parametrize(
    "wkt",
    [
        'LOCAL_CS["unknown",UNIT["metre",1]]',
        'ENGCRS["Undefined",EDATUM["a"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]',
        pyproj.CRS.from_epsg(5709).to_wkt(),
    ],
)
def test_a_crs_that_is_no_place_counts_as_none(
    wkt: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    footprints = houses.footprints()
    cloud = houses.write_cloud(tmp_path / "c.laz", stated=houses.header(wkt))
    assert_right(built(cloud, footprints))
    is_height = wkt.startswith("VERTCRS")  # which is used, of heights
    assert ("is not used: it is neither projected nor in degrees" in caplog.text) != is_height
    assert_right(built(cloud, footprints.set_crs(wkt, allow_override=True), crs=footprints.crs))
    footprints.to_crs(4326).set_crs(None, allow_override=True).to_file(tmp_path / "f.gpkg")
    with pytest.raises(InputError, match=r"too-small.*look like degrees"):
        built(cloud, tmp_path / "f.gpkg", crs=footprints.crs)


def test_footprints_that_state_no_crs_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cloud, path = houses.write_cloud(tmp_path / "c.laz"), houses.write_footprints(tmp_path / "f.shp")
    for is_told in (False, True):
        with caplog.at_level("INFO"):
            assert_right(built(cloud, path))
        assert ("f.shp does not state its CRS; assuming RGF93 v1 / Lambert-93" in caplog.text) == is_told
        path.with_suffix(".prj").unlink(missing_ok=True)


def test_points_that_do_not_count_are_named_where_none_is_left(tmp_path: Path) -> None:
    cloud = laspy.read(houses.write_cloud(tmp_path / "c.laz"))
    cloud.withheld = np.ones(len(cloud.x), np.uint8)
    cloud.write(tmp_path / "c.laz")
    with pytest.raises(InputError, match="withheld points and ignored classes do not count"):
        built(tmp_path / "c.laz", houses.footprints())


def test_settings_of_footprints_have_their_names_in_python(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("roofs", "others"):
        houses.footprints().assign(id="a").to_file(tmp_path / "f.gpkg", layer=name)
    with caplog.at_level("INFO"):
        built(houses.write_cloud(tmp_path / "c.laz"), tmp_path / "f.gpkg")
    assert "reconstruct.footprint_layer reads another: others" in caplog.text
    assert "(reconstruct.id_field selects another column)" in caplog.text


@pytest.mark.parametrize("other", ["EPSG:32631", "EPSG:4326"])
@pytest.mark.parametrize("is_stated", [True, False])
def test_a_file_far_from_the_first_that_states_no_crs_is_named(
    other: str, is_stated: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = houses.write_cloud(tmp_path / "1.laz", stated=None if is_stated else houses.header())
    second = houses.write_cloud(tmp_path / "2.laz", crs=other, stated=houses.header())
    beside = houses.write_cloud(tmp_path / "3.laz", stated=houses.header())
    assert_right(built([first, beside], houses.footprints()))
    assert "states no CRS" not in caplog.text
    assert_right(built([first, beside, second], houses.footprints()))
    assert f"{second}: states no CRS, and would be more than 100 km from {first}" in caplog.text


@pytest.mark.parametrize(("kind", "words"), [("f4", "y is in whole steps of 0.5"), ("f8", "")])
def test_coordinates_of_a_file_that_were_float32_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str, words: str
) -> None:
    path = houses.write_cloud(tmp_path / "c.laz", spacing_m=0.4)
    points = laspy.read(path)
    points.x, points.y = np.array(points.x, kind), np.array(points.y, kind)
    points.write(path)
    built(path, houses.footprints())
    told = [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]
    assert words in "".join(told) and len(told) == bool(words)


@pytest.mark.parametrize("slope", [0.0, 0.01])
def test_heights_above_the_ground_are_told(
    slope: float, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As of a cloud that was normalised: its hills are gone. A place near the sea has ground that varies."""
    path = houses.write_cloud(tmp_path / "c.laz")
    las = laspy.read(path)
    z = np.array(las.z) - houses.GROUND_M
    las.z = np.where(las.classification == 2, 0.0, z) + slope * (np.array(las.x) - np.mean(las.x))
    las.write(path)
    gable, flat = houses.footprints().geometry
    halves = [shapely.intersection(flat, shapely.affinity.translate(flat, x)) for x in (-5, 5)]
    built(path, gpd.GeoDataFrame({"id": list("abc")}, geometry=[gable, *halves], crs=2154))
    assert ("the ground is at zero everywhere" in caplog.text) == (slope == 0)


@pytest.mark.parametrize("shift_m", [0.0, 0.5])
def test_ground_in_two_layers_is_told(
    shift_m: float, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As of flights that were not adjusted, or of files in two height systems: roofs were between them."""
    path = houses.write_cloud(tmp_path / "1.laz", spacing_m=0.4)
    las = laspy.read(path)
    las.x, las.z = np.array(las.x) + 0.2, np.array(las.z) + shift_m
    las.write(tmp_path / "2.laz")
    built([path, tmp_path / "2.laz"], houses.footprints())
    assert ("the ground is in two layers, about 0.45 m apart" in caplog.text) == bool(shift_m)


def test_of_several_files_the_place_of_each_is_looked_at(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = houses.write_cloud(tmp_path / "1.laz")
    las = laspy.read(first)
    x, y = np.array(las.x), np.array(las.y)
    las.header.offsets = [las.header.offsets[k] for k in (1, 0, 2)]
    las.x, las.y = y, x
    for name in ("2.laz", "3.laz"):
        las.write(tmp_path / name)
    assert_right(built([first, tmp_path / "2.laz", tmp_path / "3.laz"], houses.footprints()))
    assert caplog.text.count("would be inside if x and y were swapped") == 1
    assert f"2.laz, {tmp_path / '3.laz'}: is outside of the area" in caplog.text


@pytest.mark.parametrize(
    ("heights", "length_m", "is_other"),
    [(6360, houses.SURVEY_FOOT_M, True), (5773, 1.0, True), (5703, 1.0, False)],
)
def test_files_that_state_different_heights(
    heights: int, length_m: float, is_other: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    paths, middle = [tmp_path / "west.laz", tmp_path / "east.laz"], houses.PLACES[UTM][0] + 10
    for path, vertical, unit_m in zip(paths, (5703, heights), (1.0, length_m), strict=True):
        stated = houses.header(pyproj.CRS(f"{UTM}+{vertical}").to_wkt())
        cloud = laspy.read(houses.write_cloud(path, UTM, height_unit_m=unit_m, stated=stated))
        inside = (cloud.x < middle) == (path == paths[0])
        laspy.LasData(cloud.header, cloud.points[inside]).write(path)
    options = {"config": {"reconstruct": {"registration": "never", "height_unit": "m"}}}
    for clouds in (paths, paths[::-1]):
        caplog.clear()
        if length_m == 1.0:
            assert_right(built(clouds, houses.footprints(UTM)))
            assert ("none is converted" in caplog.text) == is_other
            continue
        with pytest.raises(InputError, match=r"convert one of them, or state reconstruct\.height_unit"):
            built(clouds, houses.footprints(UTM))
        assert len(built(clouds, houses.footprints(UTM), **options)) == 2
