"""Stage scans: from the files of a scene to a LAZ file whose points are tagged with what they hit."""

import json
import resource
import signal

import laspy
import numpy as np
import pyproj
import pytest
import trimesh
from toy_scene import TILE, TILE_SIZE_M, ground_m, house, houses, scans_inputs, table, terrain, write_scene

import p2wss
from p2wss.cli import main
from p2wss.config import Scans
from p2wss.data.terrain import Terrain
from p2wss.scans import scan as scans
from p2wss.storage.messages import InputError

SETTINGS = Scans(preset="none", density_per_m2=10)


@pytest.fixture(scope="module")
def scan():
    return scans.simulate(table(houses()), terrain(), TILE, TILE_SIZE_M, SETTINGS)


def test_every_point_lies_on_what_it_is_tagged_with(scan):
    rows = houses()
    x, y, z = (scan.points.xyz_mm / 1000 + scan.origin_m).T
    ground = scan.points.building < 0
    # the terrain is sampled every metre, so its triangles are a little below or above the formula
    np.testing.assert_allclose(z[ground], ground_m(x[ground], y[ground]), atol=0.002)
    checked = {1: 0, 2: 0}
    for number, row in enumerate(rows):
        on_house = scan.points.building == number
        kind, edge = scan.points.face[on_house] & 3, (scan.points.face[on_house] >> 2) - 1
        u, v, w = (
            x[on_house] - row["origin_x_m"],
            y[on_house] - row["origin_y_m"],
            z[on_house] - row["terrain_z_m"],
        )
        width, length = row["footprint_xy_m"][4], row["footprint_xy_m"][5]
        # distance inwards from each edge: south, east, north, west
        inwards = np.stack([v, width - u, length - v, u])[edge, np.arange(len(u))]
        roof = row["eave_height_m"] + inwards * np.tan(np.radians(row["angle_deg"][1]))
        np.testing.assert_allclose(w[kind == 2], roof[kind == 2], atol=0.003)
        np.testing.assert_allclose(inwards[kind == 1], 0, atol=0.002)
        assert set(edge[kind == 2]) <= {1, 3}
        for k in checked:
            checked[k] += int((kind == k).sum())
    assert min(checked.values()) > 1000


def test_density_extent_and_counts(scan):
    facts = scan.facts
    assert facts["points_per_m2"] == pytest.approx(10, rel=0.05)
    assert facts["num_points"] == facts["pulses"]["recorded"] == len(scan.points.pulse)
    kinds = facts["num_ground_points"], facts["num_wall_points"], facts["num_roof_points"]
    assert sum(kinds) == facts["num_points"] and min(kinds) > 0
    low, high = (scan.points.xyz_mm[:, :2] / 1000 + scan.origin_m[:2] for _ in range(2))
    assert low.min(axis=0)[0] <= 652_500 - 4.9 and high.max(axis=0)[0] >= 652_600 + 4.9
    json.dumps(facts)


def test_buildings_of_the_margin_occlude_the_ground_behind_them():
    tower = house(652_602, 6_861_930, 20, 40, 35, 30.0, "TOWER")
    assert not tower["in_tile"]
    dtm = terrain()
    settings = Scans(preset="paper", density_per_m2=10)
    counts = []
    for rows in ([], [tower]):
        scan = scans.simulate(table(rows), dtm, TILE, TILE_SIZE_M, settings)
        x, y = (scan.points.xyz_mm[:, :2] / 1000 + scan.origin_m[:2]).T
        counts.append(((x > 652_592) & (x < 652_600) & (y > 6_861_940) & (y < 6_861_960)).sum())
    # its 35 m hide up to 12.7 m of ground from the strips on its other side
    assert counts[1] < 0.8 * counts[0]


def test_a_building_that_extends_beyond_its_tile_is_scanned_whole():
    long = house(652_560, 6_861_950, 75, 10, 6, 30.0, "LONG")
    assert long["in_tile"]
    scan = scans.simulate(table([long]), terrain(margin_m=80.0), TILE, TILE_SIZE_M, SETTINGS)
    assert (scan.points.xyz_mm[:, 0] / 1000 + scan.origin_m[0]).max() > 652_635 + 4.9


def test_no_ground_where_the_terrain_has_no_data():
    dtm = terrain()
    rows = houses()
    inner = next(row for row in rows if row["in_tile"])
    height = dtm.height_m.copy()
    column = int(inner["origin_x_m"] - dtm.x_min_m)
    line = int(dtm.y_max_m - inner["origin_y_m"])
    height[line - 3 : line + 3, column - 3 : column + 3] = np.nan
    scan = scans.simulate(
        table(rows), Terrain(height, dtm.x_min_m, dtm.y_max_m, 1.0), TILE, TILE_SIZE_M, SETTINGS
    )
    assert scan.facts["buildings_on_nodata"] == [inner["building_id"]]
    x, y = (
        scan.points.xyz_mm[:, 0] / 1000 + scan.origin_m[0],
        scan.points.xyz_mm[:, 1] / 1000 + scan.origin_m[1],
    )
    hole = (abs(x - inner["origin_x_m"]) < 2) & (abs(y - inner["origin_y_m"]) < 2)
    assert (scan.points.building[hole] >= 0).all() and hole.any()


def test_terrain_that_cannot_be_used():
    dtm = terrain()
    elsewhere = Terrain(dtm.height_m, dtm.x_min_m + 5000, dtm.y_max_m, 1.0)
    with pytest.raises(InputError, match="no data"):
        scans.simulate(table(houses()), elsewhere, TILE, TILE_SIZE_M, SETTINGS)
    peak = dtm.height_m.copy()
    peak[70, 70] += 900
    with pytest.raises(InputError, match=r"scans\.altitude_m"):
        scans.simulate(
            table(houses()), Terrain(peak, dtm.x_min_m, dtm.y_max_m, 1.0), TILE, TILE_SIZE_M, SETTINGS
        )


def test_the_flight_of_the_paper_is_at_its_own_altitude():
    low = Scans(preset="paper", altitude_m=(50, 60), density_per_m2=1)
    assert len(scans.simulate(table(houses()), terrain(), TILE, TILE_SIZE_M, low).points.pulse)
    peak = terrain()
    peak.height_m[70, 70] += 950
    high = low.model_copy(update={"altitude_m": (2000, 3000)})
    with pytest.raises(InputError, match=r"another scans\.preset"):
        scans.simulate(table(houses()), peak, TILE, TILE_SIZE_M, high)


def test_the_file_has_every_column(scan, tmp_path):
    path = tmp_path / "scan.laz"
    scans.write_scan(path, scan, pyproj.CRS(2154))
    las = laspy.read(path)
    assert (las.header.version, las.header.point_format.id) == ("1.4", 6)
    assert las.header.parse_crs().to_epsg() == 2154
    xyz = scan.points.xyz_mm / 1000 + scan.origin_m
    np.testing.assert_allclose(np.column_stack([las.x, las.y, las.z]), xyz, atol=1e-9)
    np.testing.assert_array_equal(las.building_id, scan.points.building)
    np.testing.assert_array_equal(las.face_id, scan.points.face)
    np.testing.assert_array_equal(las.classification, np.where(scan.points.building < 0, 2, 6))
    np.testing.assert_array_equal(las.point_source_id, scan.points.strip + 1)
    np.testing.assert_array_equal(las.scan_angle, scan.points.scan_angle)
    np.testing.assert_array_equal(las.intensity, scan.points.intensity)
    assert set(las.return_number) == set(las.number_of_returns) == {1}
    for number in np.unique(las.point_source_id):
        assert (np.diff(las.gps_time[las.point_source_id == number]) > 0).all()
    again = tmp_path / "again.laz"
    scans.write_scan(again, scan, pyproj.CRS(2154))
    assert again.read_bytes() == path.read_bytes()


def test_command_line(tmp_path):
    inputs = scans_inputs(*write_scene(tmp_path))
    config = '{"scans": {"density_per_m2": 6}}'
    for threads, name in (("1", "a"), ("2", "b")):
        out = ["--out", str(tmp_path / f"{name}.laz"), "--out-survey", str(tmp_path / f"{name}.json")]
        out += ["--picture", str(tmp_path / f"{name}.png")]
        assert main(["scans", *inputs, *out, "--threads", threads, "--config", config]) == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    first, second = laspy.read(tmp_path / "a.laz"), laspy.read(tmp_path / "b.laz")
    np.testing.assert_array_equal(first.points.array, second.points.array)
    survey = json.loads((tmp_path / "a.json").read_text())
    # where a strip is follows from the file alone: its points are seen at their angles
    strips = {each["point_source_id"]: each for each in survey["survey"]["strips"]}
    assert set(np.unique(first.point_source_id)) <= set(strips) and 0 not in strips
    for number in np.unique(first.point_source_id):
        strip, points = strips[number], first[first.point_source_id == number]
        forward = np.radians(strip["heading_deg"])
        x_m, y_m = np.add(strip["start_xy_m"], survey["origin_m"][:2])
        right_m = (np.asarray(points.x) - x_m) * np.cos(forward) - (np.asarray(points.y) - y_m) * np.sin(
            forward
        )
        down_m = survey["survey"]["altitude_m"] + survey["origin_m"][2] - np.asarray(points.z)
        assert np.degrees(np.arctan2(right_m, down_m)) == pytest.approx(points.scan_angle * 0.006, abs=0.2)
    assert survey["tile"] == TILE and survey["num_points"] == len(first.points)
    assert json.loads(survey["config"])["scans"]["density_per_m2"] == 6


def test_meshes_have_their_numbers():
    """Also behind a building without a mesh, as in a scene."""
    roof = p2wss.roof([[0, 0], [10, 0], [10, 6], [0, 6]], 5, [45, 90, 45, 90])
    survey = p2wss.scan(
        [trimesh.Trimesh(), roof, trimesh.Trimesh(), roof.copy().apply_translation([20, 0, 0])]
    )
    assert set(np.unique(survey.building_id)) == {-1, 1, 3}
    assert np.asarray(survey.x)[survey.building_id == 3].min() > 19
    assert set(np.unique(survey.face_id)) == {-1, 1, 2}
    # the seed of the config counts unless another is given
    first, second, third = (
        p2wss.scan(roof, config={"scans": {"seed": of_config}}, seed=seed).xyz
        for of_config, seed in ((1, None), (2, None), (2, 1))
    )
    assert np.array_equal(first, third) and not np.array_equal(first, second)


def test_files_of_different_tiles(tmp_path, capsys):
    folder = tmp_path / "other"
    folder.mkdir()
    scene, dtm, _ = write_scene(tmp_path, rows=[])
    _, _, other = write_scene(folder, rows=[], tile="0653000_6862000")
    out = ["--out", str(tmp_path / "c.laz"), "--out-survey", str(tmp_path / "c.json")]
    assert main(["scans", *scans_inputs(scene, dtm, other), *out]) == 2
    assert str(other) in capsys.readouterr().err and not (tmp_path / "c.laz").exists()


@pytest.mark.parametrize("threads", [1, 2])
def test_a_full_disk_leaves_what_was_there(scan, tmp_path, threads):
    path = tmp_path / "scan.laz"
    path.write_text("what was there")
    before = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[0][1]))
    try:
        with pytest.raises(InputError, match=r"scan\.laz: not written"):
            scans.write_scan(path, scan, pyproj.CRS(2154), threads)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before[0])
        signal.signal(signal.SIGXFSZ, before[1])
    assert path.read_text() == "what was there"
    assert [p.name for p in tmp_path.iterdir()] == ["scan.laz"]
