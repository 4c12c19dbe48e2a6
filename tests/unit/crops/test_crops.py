"""Stage crops: rows with labels, splits that keep apart, and crops of real LiDAR."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyproj
import pytest
import shapely
from places import SHARED
from toy_scene import TILE, TILE_SIZE_M, house, houses, scans_inputs, table, terrain, write_scene

from p2wss.cli import main
from p2wss.clouds import reading as clouds
from p2wss.clouds.crops import crop_cloud, ground_height, roofs_around
from p2wss.clouds.reading import Cloud, read_clouds
from p2wss.config import Crops, Scans
from p2wss.config import Scenes as ScenesConfig
from p2wss.crops.rows import assign_splits, crop_real, crop_simulated
from p2wss.data import polygon_arrays
from p2wss.data.crs import check_crs
from p2wss.data.tiling import tile_name
from p2wss.footprints import cleaning
from p2wss.scans import scan as scans
from p2wss.storage import files
from p2wss.storage.las_crs import same_crs
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.crops import CROPS

DATA = SHARED / "data"
needs_data = pytest.mark.skipif(not DATA.exists(), reason="the shared real data is not here")


def cloud_of(scan):
    x, y, z = (scan.points.xyz_mm / 1000 + scan.origin_m).T
    classes = np.where(scan.points.building < 0, 2, 6).astype(np.uint8)
    cloud = Cloud(x, y, z, classes, pyproj.CRS(2154))
    return cloud, scan.points.building, scan.points.face


@pytest.fixture(scope="module")
def scanned():
    rows = houses()
    settings = Scans(preset="none", density_per_m2=10)
    return table(rows), cloud_of(scans.simulate(table(rows), terrain(), TILE, TILE_SIZE_M, settings))


def points_of(columns, row):
    return np.column_stack(
        [
            np.asarray(columns[name][row].as_py()) / 100 + columns[origin][row]
            for name, origin in (("x_cm", "origin_x_m"), ("y_cm", "origin_y_m"), ("z_cm", "origin_z_m"))
        ]
    )


def test_rows_hold_the_points_around_each_footprint(scanned):
    buildings, (cloud, owner, face) = scanned
    columns, num_excluded = crop_simulated(buildings, (cloud, owner, face), Crops())
    assert sum(num_excluded.values()) == 0
    ids = columns["building_id"].to_pylist()
    assert ids == [row["building_id"] for row in buildings.to_pylist() if row["in_tile"]]
    everything = shapely.points(cloud.x_m, cloud.y_m)
    for row in range(0, len(ids), 5):
        source = buildings["building_id"].to_pylist().index(ids[row])
        width, length = buildings["footprint_xy_m"][source].as_py()[4:6]
        x0, y0 = columns["origin_x_m"][row], columns["origin_y_m"][row]
        near = shapely.dwithin(shapely.box(x0, y0, x0 + width, y0 + length), everything, 1.0)
        point_m = points_of(columns, row)
        expected = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])[near]
        assert len(point_m) == columns["num_points"][row] == len(expected)
        order = [np.lexsort(np.round(a, 1).T) for a in (point_m, expected)]
        assert np.abs(np.sort(point_m, axis=0) - np.sort(expected, axis=0)).max() <= 0.0051
        assert len(order[0]) == len(order[1])
        kind = face[near & (owner == source)] & 3
        assert columns["num_roof_points"][row] == (kind == 2).sum()
        assert columns["num_wall_points"][row] == (kind == 1).sum()
        assert columns["visible_roof_share"][row] > 0.9
        # ground at the building: the label is the median along the footprint, the cloud's is that of the ring
        assert columns["ground_z_m"][row] == pytest.approx(
            columns["label_terrain_z_m"][row].as_py(), abs=0.25
        )
        assert columns["origin_z_m"][row] == round(np.median(expected[:, 2]))


def test_labels_are_those_of_the_building(scanned):
    buildings, scan = scanned
    columns, _ = crop_simulated(buildings, scan, Crops(min_points=1300))
    source = {row["building_id"]: row for row in buildings.to_pylist()}
    names = columns["building_id"].to_pylist()
    assert 0 < len(names) < sum(row["in_tile"] for row in source.values())
    assert (columns["num_points"] >= 1300).all()
    for row, name in enumerate(names):
        label = source[name]
        assert columns["angle_deg"][row].as_py() == label["angle_deg"]
        assert columns["eave_height_m"][row].as_py() == label["eave_height_m"]
        assert columns["label_terrain_z_m"][row].as_py() == label["terrain_z_m"]
        assert columns["footprint_xy_m"][row].as_py() == pytest.approx(label["footprint_xy_m"], abs=1e-8)
        assert columns["origin_x_m"][row] == label["origin_x_m"]


def test_excluded_buildings_are_counted():
    failed = house(652_510, 6_861_910, 9, 9, 5, 30.0, "FAILED") | {"status": "not-closed"}
    unseen = house(652_530, 6_861_930, 9, 9, 5, 30.0, "UNSEEN")
    huge = house(652_400, 6_861_700, 400, 500, 5, 30.0, "HUGE") | {"in_tile": True}
    cloud = Cloud(
        np.array([652_500.0]), np.array([6_861_905.0]), np.array([80.0]), np.full(1, 2, np.uint8), None
    )
    none = np.full(1, -1, np.int32)
    columns, num_excluded = crop_simulated(table([failed, unseen, huge]), (cloud, none, none), Crops())
    assert num_excluded == {"not-closed": 1, "too-few-points": 1, "too-large": 1}
    assert len(columns["num_points"]) == 0


def grid_cloud(height, x=(0, 40), y=(0, 40), step=0.5, classes=2):
    u, v = np.meshgrid(np.arange(*x, step), np.arange(*y, step))
    u, v = u.ravel() + 0.1, v.ravel() + 0.1
    return Cloud(u, v, height(u, v), np.full(len(u), classes, np.uint8), None)


def join(*clouds):
    names = ("x_m", "y_m", "z_m", "classification")
    return Cloud(*(np.concatenate([getattr(cloud, name) for cloud in clouds]) for name in names), None)


def ground_z_m_of(cloud, polygons):
    return ground_height(cloud, polygons)[0]


def test_ground_is_the_median_of_the_nearest_ground_points():
    box = shapely.box(10, 10, 20, 20)
    sloping = grid_cloud(lambda u, v: 100 + 0.1 * u)
    assert ground_z_m_of(sloping, polygon_arrays.to_polygons([box]))[0] == pytest.approx(101.5, abs=0.06)
    # ground inside the footprint (a class gone wrong) does not count
    inside = grid_cloud(lambda u, v: 0 * u + 130, (10, 20), (10, 20))
    assert ground_z_m_of(join(sloping, inside), polygon_arrays.to_polygons([box]))[0] < 102
    # none within 1 m: further away, as far as 64 m, then nothing
    for gap, expected in ((3, 50.0), (12, 50.0), (50, 50.0), (70, np.nan)):
        far = grid_cloud(lambda u, v: 0 * u + 50, (20 + gap, 24 + gap), (12, 18))
        ground_z_m = ground_z_m_of(far, polygon_arrays.to_polygons([box]))
        np.testing.assert_equal(ground_z_m, [expected])
    # a courtyard's ground counts
    ring = box.difference(shapely.box(13, 13, 17, 17))
    court = grid_cloud(lambda u, v: 0 * u + 99, (13, 17), (13, 17))
    assert ground_z_m_of(court, polygon_arrays.to_polygons([ring])).tolist() == [99]


def test_a_building_with_few_points_gets_those_on_the_roofs_around_it():
    boxes = [
        shapely.box(0, 0, 8, 8),
        shapely.box(8, 0, 16, 8),
        shapely.box(60, 0, 68, 8),
        shapely.box(90, 0, 98, 8),
    ]
    polygons = polygon_arrays.to_polygons(boxes)
    # few, many, few and far from others, none; the ground between them is no roof
    roofs = [
        grid_cloud(lambda u, v: 0 * u + 5, (low, low + 8), (0, 8), step, classes=6)
        for low, step in ((0, 4.0), (8, 0.5), (60, 4.0))
    ]
    cloud = join(*roofs, grid_cloud(lambda u, v: 0 * u, (17, 50), (0, 8), 4.0))
    around = roofs_around(cloud, polygons, crop_cloud(cloud, polygons))
    assert sorted(around) == [0, 2] and not len(around[2])
    assert len(around[0]) > 100 and (cloud.x_m[around[0]] > 8).all() and (cloud.x_m[around[0]] <= 20).all()
    assert (cloud.classification[around[0]] == 6).all()


@pytest.mark.parametrize("side_m", [10.0, 40.0])
def test_a_building_has_few_points_by_their_number_whatever_its_area(side_m: float) -> None:
    polygons = polygon_arrays.to_polygons(
        [shapely.box(0, 0, side_m, side_m), shapely.box(side_m, 0, 2 * side_m, 5)]
    )
    beside = grid_cloud(lambda u, v: 0 * u + 5, (side_m, side_m + 5), (0, 5), 0.5, classes=6)
    has_roofs_around = []
    for num_rows in (4, 5):
        step_m = side_m / 6
        own = grid_cloud(lambda u, v: 0 * u + 5, (0, num_rows * step_m), (0, side_m), step_m, classes=6)
        cloud = join(own, beside)
        has_roofs_around.append(0 in roofs_around(cloud, polygons, crop_cloud(cloud, polygons)))
    assert has_roofs_around == [True, False]


def test_ground_on_a_slope_lies_between_what_is_above_and_below():
    """Few points uphill and many downhill, 8 to 40 m away: the median of either ring is far off."""
    box = shapely.box(60, 60, 70, 70)

    def slope(u, v):
        return 0.3 * u

    uphill = grid_cloud(slope, (78, 80), (40, 90), 5.0)
    downhill = grid_cloud(slope, (30, 52), (40, 90), 2.0)
    polygons = polygon_arrays.to_polygons([box])
    assert ground_z_m_of(join(uphill, downhill), polygons)[0] == pytest.approx(0.3 * 65, abs=0.1)
    # the slope goes on where all are on one side, which is a guess, but not on level ground
    assert ground_z_m_of(downhill, polygons)[0] == pytest.approx(0.3 * 65, abs=0.5)
    level = replace(downhill, z_m=np.sin(downhill.x_m))
    assert np.isfinite(
        [ground_height(each, polygons)[1][0] for each in (join(uphill, downhill), downhill, level)]
    ).tolist() == [False, True, False]


def test_ground_of_a_hillside_between_roofs():
    """Ground is seen in every other square, without class; there are roofs on the rest, and a pit."""
    box = shapely.box(64, 64, 72, 72)
    slope = grid_cloud(lambda u, v: 100 + 0.2 * u - 0.1 * v, (24, 112), (24, 112), 2.0, classes=1)
    square = (slope.x_m // 8 + slope.y_m // 8) % 2
    is_pit = (slope.x_m // 8 == 7) & (slope.y_m // 8 == 8)
    slope.z_m[:] += np.where(is_pit, -4.0, np.where(square > 0, 9.0, 0.0))
    found = ground_z_m_of(slope, polygon_arrays.to_polygons([box]))[0]
    assert found == pytest.approx(100 + 0.2 * 68 - 0.1 * 68, abs=0.2)


def test_points_without_class_show_no_ground_where_none_around_has_class_ground():
    """Chimneys of the neighbours, as in a cloud cut out along footprints."""
    polygons = polygon_arrays.to_polygons([shapely.box(10, 10, 20, 20)])
    chimneys = grid_cloud(lambda u, v: 0 * u + 29, (25, 40), (10, 20), classes=1)
    assert [each.tolist() for each in ground_height(chimneys, polygons)] == [[29], [0]]
    seen = grid_cloud(lambda u, v: 0 * u + 20, (30, 31), (20, 21), classes=2)
    assert np.isnan(ground_height(join(chimneys, seen), polygons)[1]).all()


def test_strays_of_class_ground_on_roofs_are_no_ground():
    """Every tenth point of roofs has class ground, and the ground none; or it is not there, as in a cloud that was cut
    out along footprints."""
    polygons = polygon_arrays.to_polygons([shapely.box(10, 10, 20, 20)])
    roofs = grid_cloud(lambda u, v: 29 + 0.01 * (u * v % 7), (20.5, 28), (9, 40), classes=1)
    roofs.classification[::10] = 2
    street = join(
        grid_cloud(lambda u, v: 0 * u + 20, (0, 9), classes=1),
        grid_cloud(lambda u, v: 0 * u + 20, (9, 40), (0, 9), classes=1),
    )
    z_m, sd_m = ground_height(join(roofs, street), polygons)
    assert z_m[0] == pytest.approx(20, abs=0.5) and sd_m[0] > 1
    # a guess, on the roofs
    z_m, sd_m = ground_height(roofs, polygons)
    assert z_m[0] == pytest.approx(29, abs=0.1) and sd_m[0] >= 0
    # roofs say nothing about the ground below them
    street.classification[:] = 2
    roofs.classification[:] = 1
    z_m, sd_m = ground_height(join(roofs, street), polygons)
    assert z_m[0] == 20 and np.isnan(sd_m[0])


def test_ground_without_classes_is_low():
    box = shapely.box(10, 10, 20, 20)
    ground = grid_cloud(lambda u, v: 0 * u + 20, (8, 22), (8, 22), classes=0)
    roofs = grid_cloud(lambda u, v: 0 * u + 29, (8, 14), (8, 22), classes=1)
    assert ground_z_m_of(join(ground, roofs), polygon_arrays.to_polygons([box])).tolist() == [20]
    # ground elsewhere in the cloud, which another run of the same building may not read, changes nothing
    far = grid_cloud(lambda u, v: 0 * u + 50, (90, 94), (12, 18))
    assert ground_z_m_of(join(ground, roofs, far), polygon_arrays.to_polygons([box])).tolist() == [20]


def scattered(count, seed=0, extent_m=4000):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, extent_m, (2, count))
    w, h = rng.uniform(5, 25, (2, count))
    return shapely.box(x, y, x + w, y + h)


def test_splits_have_their_shares_of_the_area_and_keep_apart():
    shapes = scattered(8000)
    settings = Crops(guard_m=15)
    split = assign_splits(polygon_arrays.to_polygons(shapes), settings)
    share = {name: (split == name).mean() for name in ("train", "val", "test", "guard")}
    assert share["train"] == pytest.approx(0.8, abs=0.03)
    assert 0.06 < share["val"] < 0.12 and 0.06 < share["test"] < 0.12
    for held_out in ("val", "test"):
        mine, others = shapes[split == held_out], shapes[(split != held_out) & (split != "guard")]
        assert len(shapely.STRtree(others).query(mine, predicate="dwithin", distance=15)[0]) == 0
    # the guard is no larger than it must be
    free = assign_splits(polygon_arrays.to_polygons(shapes), Crops(guard_m=0.0))
    assert (free == "guard").sum() < (split == "guard").sum()
    moved = split != free
    assert set(split[moved]) <= {"guard"}


def test_splits_do_not_depend_on_the_tile():
    shapes = scattered(3000, extent_m=2000)
    whole = assign_splits(polygon_arrays.to_polygons(shapes), Crops())
    middle = shapely.get_x(shapely.centroid(shapes))
    for low, high in ((0, 1000), (1000, 2000)):
        with_margin = (middle > low - 60) & (middle < high + 60)
        part = assign_splits(polygon_arrays.to_polygons(shapes[with_margin]), Crops())
        in_tile = ((middle > low) & (middle < high))[with_margin]
        assert (part[in_tile] == whole[with_margin][in_tile]).all()
    other_seed = assign_splits(polygon_arrays.to_polygons(shapes), Crops(seed=1))
    assert (other_seed != whole).mean() > 0.1
    assert assign_splits(polygon_arrays.to_polygons([]), Crops()).tolist() == []


def test_a_whole_region_can_be_held_out():
    split = assign_splits(polygon_arrays.to_polygons(scattered(50)), Crops(split="val"))
    assert split.tolist() == ["val"] * 50


def test_command_line_and_manifest(tmp_path, capsys):
    scene_files = write_scene(tmp_path)
    buildings = str(scene_files[2])
    scan, shard = str(tmp_path / "scan.laz"), str(tmp_path / "shards" / "a.parquet")
    survey = ["--out-survey", str(tmp_path / "scan.json")]
    crop = ["crops", "simulated", "--buildings", buildings, "--scan", scan, "--out", shard]
    config = '{"scans": {"preset": "paper"}, "crops": {"block_size_m": 20}}'
    assert main(["scans", *scans_inputs(*scene_files), "--out", scan, *survey, "--config", config]) == 0
    assert main([*crop, "--config", config]) == 0
    first = Path(shard).read_bytes()
    assert main([*crop, "--config", config]) == 0
    assert Path(shard).read_bytes() == first
    rows = files.read_table(shard, CROPS)
    assert len(rows) > 10 and files.read_metadata(shard)["tile"] == TILE
    manifest = tmp_path / "out" / "manifest.json"
    assert main(["crops", "manifest", "--out", str(manifest), "--simulated", shard, "--real", shard]) == 0
    content = json.loads(manifest.read_text())
    assert [s["dataset"] for s in content["shards"]] == ["simulated", "real"]
    assert content["shards"][0]["path"] == "../shards/a.parquet"
    assert content["shards"][0]["sha256"] == files.sha256(shard)
    assert sum(content["shards"][0]["splits"].values()) == len(rows)
    assert content["num_rows"] == 2 * len(rows)

    labelled, sparse = str(tmp_path / "labelled.parquet"), str(tmp_path / "sparse.parquet")
    columns = {name: rows[name].to_pylist() for name in rows.column_names}
    for name in ("x_cm", "y_cm", "z_cm", "classification"):
        columns[name][0] = columns[name][0][:7]
    files.write_table(sparse, columns, CROPS, {"num_excluded": {"too-large": 2}})
    assert main(["crops", "labels", "--crops", sparse, "--split", "val", "--out", labelled]) == 0
    fitted = files.read_table(labelled, CROPS)
    assert sum(files.read_metadata(labelled)["num_excluded"].values()) == 2 + 1
    rows = rows.slice(1)  # the roof of seven points is a guess
    assert set(fitted["split"].to_pylist()) == {"val"} and fitted["x_cm"] == rows["x_cm"]
    true_m, fitted_m = (
        np.array(table["eave_height_m"]) + np.array(table["label_terrain_z_m"]) for table in (rows, fitted)
    )
    assert np.median(np.abs(fitted_m - true_m)) < 0.2
    assert list(map(len, fitted["angle_deg"])) == list(map(len, rows["angle_deg"]))

    capsys.readouterr()
    wide_guard = '{"crops": {"guard_m": 100}}'
    assert main([*crop, "--config", wide_guard]) == 2
    broken = tmp_path / "broken.laz"
    broken.write_bytes(Path(scan).read_bytes()[:20_000])
    for bad in (broken, tmp_path / "missing.laz", Path(scene_files[0])):
        assert main(["crops", "simulated", "--buildings", buildings, "--scan", str(bad), "--out", shard]) == 2
        assert str(bad) in capsys.readouterr().err
    assert Path(shard).read_bytes() == first


def write_las(path, x, y, z, classes, crs=2154, flags=None):
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.01] * 3, [np.floor(x.min()), np.floor(y.min()), 0]
    if crs is not None:
        header.add_crs(pyproj.CRS(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z, las.classification = x, y, z, classes
    if flags is not None:
        las.withheld = flags
    las.write(path)


def test_clouds_are_read_without_noise_and_by_window(tmp_path):
    x, y = np.array([1.0, 2, 3, 4, 5]), np.array([1.0, 1, 1, 9, 1])
    classes, withheld = np.array([2, 7, 6, 2, 18], np.uint8), np.array([0, 0, 1, 0, 0])
    write_las(tmp_path / "a.laz", x, y, x * 10, classes, flags=withheld)
    write_las(tmp_path / "b.las", x[:1] + 0.5, y[:1], x[:1], classes[:1])
    cloud = read_clouds([tmp_path / "a.laz", tmp_path / "b.las"])
    assert cloud.x_m.tolist() == [1, 4, 1.5] and cloud.z_m.tolist() == [10, 40, 1]
    assert cloud.crs is not None and cloud.crs.to_epsg() == 2154
    assert read_clouds([tmp_path / "a.laz"], (0, 0, 10, 5)).x_m.tolist() == [1]
    assert len(read_clouds([])) == 0


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_broken_cloud_is_an_error_of_one_line(tmp_path, suffix):
    rng = np.random.default_rng(0)
    x, y, z = rng.uniform(0, 100, (3, 60_000))
    path = tmp_path / f"cloud.{suffix}"
    write_las(path, x, y, z, np.full(len(x), 2, np.uint8))
    whole = path.read_bytes()
    for length in (len(whole) // 2, len(whole) - 100, 300, 50, 0):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError) as error:
            read_clouds([path])
        assert str(path) in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(InputError, match="no such file"):
        read_clouds([tmp_path / "none.laz"])
    path.write_text("not a point cloud at all, but long enough to hold a header " * 20)
    with pytest.raises(InputError, match="not a readable"):
        read_clouds([path])


def test_clouds_of_different_crs(tmp_path):
    one = np.ones(1)
    write_las(tmp_path / "a.las", one, one, one, one.astype(np.uint8))
    write_las(tmp_path / "b.las", one, one, one, one.astype(np.uint8), crs=28992)
    write_las(tmp_path / "c.las", one, one, one, one.astype(np.uint8), crs=None)
    with pytest.raises(InputError, match=r"b\.las: is in .*Amersfoort.*a\.las.*Lambert"):
        read_clouds([tmp_path / "a.las", tmp_path / "b.las"])
    assert read_clouds([tmp_path / "c.las"]).crs is None
    assert read_clouds([tmp_path / "c.las", tmp_path / "a.las"]).crs.to_epsg() == 2154
    check_crs(None, "EPSG:2154", "c.las")
    with pytest.raises(InputError, match="footprints"):
        check_crs(pyproj.CRS(28992), "EPSG:2154", "b.las", "the footprints are")
    assert same_crs(pyproj.CRS("EPSG:2154+5720"), pyproj.CRS(2154))
    assert not same_crs(pyproj.CRS("EPSG:2154+5720"), pyproj.CRS(32631))


def lidar_columns(footprint_file, clouds, tile, size_m):
    frame = cleaning.clean_footprints(cleaning.read_footprints(footprint_file), ScenesConfig())
    return crop_real(frame, clouds, tile, size_m, Crops())


@needs_data
def test_real_lidar_of_delft():
    folder = DATA / "delft_ahn3"
    frame = gpd.read_file(folder / "footprints.gpkg")
    x_min, _, _, y_max = frame.total_bounds
    corner = np.floor(x_min / 1000) * 1000, np.ceil(y_max / 1000) * 1000
    tile = tile_name(*corner, 1000)
    columns, num_excluded = lidar_columns(folder / "footprints.gpkg", [folder / "ahn3.laz"], tile, 1000)
    assert len(columns["num_points"]) + sum(num_excluded.values()) == len(frame)
    assert len(columns["num_points"]) >= 70
    assert np.isfinite(columns["ground_z_m"]).all() and np.abs(columns["ground_z_m"]).max() < 5
    assert set(columns["split"]) == {"none"} and columns["angle_deg"].null_count == len(columns["num_points"])
    assert np.median(columns["visible_roof_share"]) > 0.9
    ok = columns["num_roof_points"] > 100
    assert ok.sum() > 30


@needs_data
def test_real_lidar_of_bresse_where_the_classifier_missed_a_building():
    folder = DATA / "bresse_ign"
    columns, num_excluded = lidar_columns(
        folder / "footprints.gpkg", [folder / "lidar.laz"], "0870_6618", 1000
    )
    assert num_excluded["too-few-points"] == 34
    missed = columns["building_id"].tolist().index("BRESSE0008")
    assert columns["num_points"][missed] == 2567
    # none of its points has class 6
    assert columns["num_roof_points"][missed] > 1000
    assert (columns["visible_roof_share"] > 0.8).all()
    assert np.abs(columns["ground_z_m"] - 182).max() < 6


@needs_data
def test_a_copc_window_equals_the_window_of_the_whole_file():
    copc = DATA / "lidarhd_crops" / "77050_627755_LA93_IGN69.copc.laz"
    plain = DATA / "lidarhd_crops" / "77050_627755_LA93_IGN69.laz"
    whole = read_clouds([plain])
    x, y = np.median(whole.x_m), np.median(whole.y_m)
    bounds = (x - 10, y - 7, x + 3, y + 12)
    a, b = read_clouds([copc], bounds), read_clouds([plain], bounds)
    assert 0 < len(a) == len(b) < len(whole)
    key = [np.lexsort((c.z_m, c.y_m, c.x_m)) for c in (a, b)]
    np.testing.assert_array_equal(a.x_m[key[0]], b.x_m[key[1]])
    np.testing.assert_array_equal(np.sort(a.classification), np.sort(b.classification))
    assert a.crs.to_epsg() == 2154


@needs_data
@pytest.mark.parametrize("half_size_m", [12, 40])
def test_chunks_of_a_copc_window_hold_each_point_once(monkeypatch, half_size_m):
    copc = DATA / "lidarhd_crops" / "77050_627755_LA93_IGN69.copc.laz"
    whole = read_clouds([copc])
    x, y = np.round(np.median(whole.x_m)), np.round(np.median(whole.y_m))
    bounds = (x - half_size_m, y - half_size_m, x + half_size_m, y + half_size_m)
    window = read_clouds([copc], bounds)
    monkeypatch.setattr(clouds, "_CHUNK_POINTS", 1000)
    monkeypatch.setattr(clouds, "_MAX_WINDOW_POINTS", 1000)
    chunks = list(clouds.read_in_chunks([copc], bounds))
    assert len(chunks) >= 4 and len(window) > 4000 and {chunk.crs.to_epsg() for chunk in chunks} == {2154}
    names = ("x_m", "y_m", "z_m", "classification", "day")
    columns = {name: np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in names}
    together = np.array([columns[name] for name in names], float)
    expected = np.array([getattr(window, name) for name in names], float)
    np.testing.assert_array_equal(together[:, np.lexsort(together)], expected[:, np.lexsort(expected)])


@needs_data
def test_truncated_real_copc(tmp_path):
    copc = tmp_path / "cut.copc.laz"
    shutil.copy(DATA / "lidarhd_crops" / "77050_627755_LA93_IGN69.copc.laz", copc)
    copc.chmod(0o644)
    whole = copc.read_bytes()
    copc.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cut"):
        read_clouds([copc], (0, 0, 1e7, 1e7))
