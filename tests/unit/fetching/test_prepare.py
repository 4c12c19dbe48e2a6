"""Preparation of real clouds: cropping, the use of PDAL, and the results of an installed PDAL."""

from __future__ import annotations

import json

import laspy
import numpy as np
import pytest
from places import ROOT
from scipy.spatial import cKDTree

from p2wss.config import Prepare
from p2wss.fetching.prepare import Window, for_version, pipeline, prepare, read_stages
from p2wss.storage import integrity
from p2wss.storage.messages import InputError

STAGES = ROOT / "config" / "pdal" / "prepare.json"
BRESSE = ROOT.parent / "shared" / "data" / "bresse_ign" / "lidar.laz"
MINI = ROOT / "tests" / "mini" / "lidar" / "LHD_FXX_0653_6861_PTS_LAMB93_IGN69.laz"
TILE = (652000.0, 6861000.0, 653000.0, 6862000.0)
AROUND = (651900.0, 6860900.0, 653100.0, 6862100.0)
EAST = (653000.0, 6861000.0, 654000.0, 6862000.0)
L93 = "EPSG:2154"


def config(**settings) -> Prepare:
    return Prepare(pdal_stages=str(STAGES), **settings)


def scatter(number: int, bounds: tuple[float, ...], seed: int = 0) -> np.ndarray:
    x_min, y_min, x_max, y_max = bounds
    return np.round(
        np.random.default_rng(seed).uniform((x_min, y_min, 40), (x_max, y_max, 60), (number, 3)), 3
    )


def rows(points: np.ndarray) -> list[tuple[int, ...]]:
    return sorted(map(tuple, np.round(np.asarray(points) * 1000).astype(np.int64).tolist()))


def test_a_classified_tile_is_linked_unchanged(write_points, tmp_path):
    cloud = write_points("0652_6862.laz", scatter(1000, TILE), 2)
    integrity.append(cloud)  # as the stage fetch does
    integrity.fill(cloud)
    out = tmp_path / "out" / "0652_6862.laz"
    facts = prepare(out, [cloud], Window(AROUND, [], L93, L93), config(pdal_command="no-such-program"))
    assert (facts["by"], facts["num_points"], facts["num_ground_points"]) == ("laspy", 1000, 1000)
    assert out.samefile(cloud), "no second copy of some hundred megabytes"


def test_points_of_a_neighbouring_tile_are_not_written(write_points, tmp_path):
    """A file that extends beyond its tile: points in the margin are written, except those of the neighbour."""
    points = scatter(5000, (651500, 6861000, 653500, 6862000))
    cloud = write_points("0652_6862.laz", points, 2)
    neighbour = write_points("0653_6862.laz", scatter(100, EAST), 2)
    out = tmp_path / "out.laz"
    facts = prepare(out, [cloud, neighbour], Window(AROUND, [EAST], L93, L93), config(mode="never"))
    assert facts["num_ground_points"] == facts["num_points"] < len(points)
    x = points[:, 0]
    assert rows(laspy.read(out).xyz) == rows(points[(x >= 651900) & (x < 653000)])


def test_an_unclassified_cloud_without_pdal_is_an_error_with_instructions(write_points, tmp_path):
    cloud = write_points("0652_6862.laz", scatter(100, TILE), np.arange(100) % 2 * 5)
    out = tmp_path / "out.laz"
    message = r"no ground points \(class 2\) among the classes \[0, 5\].*no-such-program.*envs/pdal\.yaml"
    with pytest.raises(InputError, match=message):
        prepare(out, [cloud], Window(AROUND, [], L93, L93), config(pdal_command="no-such-program"))
    assert not out.exists()
    prepare(out, [cloud], Window(AROUND, [], L93, L93), config(pdal_command="no-such-program", mode="never"))
    assert out.exists()


def test_missing_pdal_is_only_a_warning_for_a_classified_cloud(write_points, tmp_path, caplog):
    cloud = write_points("0652_6862.laz", scatter(100, TILE), 2)
    settings = config(pdal_command="no-such-program", mode="pdal")
    assert prepare(tmp_path / "out.laz", [cloud], Window(AROUND, [], L93, L93), settings)["by"] == "laspy"
    assert "install it with conda (envs/pdal.yaml" in caplog.text


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("echo 'PDAL: readers.las: no good' >&2; exit 1", "PDAL failed: PDAL: readers.las: no good"),
        ("exit 0", "PDAL wrote no file"),
        ("sleep 5", "PDAL took longer than fetch.prepare.pdal_timeout_s 0.5"),
    ],
)
def test_a_failure_of_pdal_leaves_no_files(write_points, tmp_path, script, message):
    cloud = write_points("in/0652_6862.laz", scatter(100, TILE), 1)
    program = tmp_path / "pdal"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    (tmp_path / "out").mkdir()
    settings = config(pdal_command=str(program), pdal_timeout_s=0.5)
    with pytest.raises(InputError, match=message):
        prepare(tmp_path / "out" / "out.laz", [cloud], Window(AROUND, [], L93, L93), settings)
    assert list((tmp_path / "out").iterdir()) == []


def test_pipeline_reads_crops_merges_and_writes():
    names = ["a.laz", "b.laz"]
    steps = pipeline(names, "out.laz", Window(AROUND, [EAST], L93, "EPSG:2949"), 6, read_stages(STAGES))[
        "pipeline"
    ]
    kinds = [step["type"] for step in steps]
    assert kinds[:7] == [
        "readers.las",
        "filters.reprojection",
        "filters.crop",
        "filters.crop",
        "readers.las",
        "filters.reprojection",
        "filters.crop",
    ]
    assert kinds.index("filters.merge") == 7 and kinds[-1] == "writers.las" and "filters.smrf" in kinds
    assert steps[7]["inputs"] == [steps[3]["tag"], steps[6]["tag"]]
    assert steps[3]["outside"] and steps[-2]["outside"]
    assert steps[6]["bounds"] == "([653000.000, 653100.000], [6861000.000, 6862000.000])"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "expected a list"),
        ("[{}]", "expected a list"),
        ("[", "not JSON"),
        ('[{"type": "writers.las"}]', "only filters are allowed"),
    ],
)
def test_invalid_stages(tmp_path, text, message):
    (tmp_path / "s.json").write_text(text)
    with pytest.raises(InputError, match=message):
        read_stages(tmp_path / "s.json")


def test_flags_are_rewritten_for_an_older_pdal():
    stages = read_stages(STAGES)
    assert for_version('{"name": "Withheld"}', stages) == stages
    (first, *others) = for_version('{"name": "ClassFlags"}', stages)
    assert first["limits"] == "ClassFlags[0:3],ClassFlags[8:11]" and others == stages[1:]
    (first, *others) = for_version('{"name": "Classification"}', stages)
    assert first["limits"] == "Classification[0:127]" and others == stages[1:]


# --- with a real PDAL ---


@pytest.mark.skipif(not BRESSE.exists(), reason="no shared/data/bresse_ign")
def test_real_pdal_finds_the_ground_of_real_lidar(pdal_command, tmp_path):
    """IGN's LiDAR without its classes: PDAL's ground agrees with IGN's and contains no roofs."""
    cloud = laspy.read(BRESSE)
    ign_classes = np.asarray(cloud.classification).copy()
    cloud.classification = np.ones(len(ign_classes), np.uint8)
    cloud.write(tmp_path / "0870_6618.laz")
    out = tmp_path / "out" / "0870_6618.laz"
    around = (869900.0, 6616900.0, 871100.0, 6618100.0)
    facts = prepare(
        out, [tmp_path / "0870_6618.laz"], Window(around, [], L93, L93), config(pdal_command=pdal_command)
    )
    assert facts["by"] == "pdal" and "no ground points" in facts["reason"]

    result = laspy.read(out)
    classes = np.asarray(result.classification)
    assert facts["num_ground_points"] == (classes == 2).sum() and result.header.parse_crs().to_epsg() == 2154
    before = dict(zip(map(tuple, rows_in_order(cloud)), ign_classes.tolist(), strict=True))
    expected_classes = np.array([before[tuple(row)] for row in rows_in_order(result)])
    assert len(result) > 0.97 * len(cloud)
    assert (classes[expected_classes == 2] == 2).mean() > 0.98
    assert (classes[expected_classes == 6] == 2).mean() < 0.01
    # points that IGN left unclassified and PDAL calls ground lie on IGN's ground
    tree = cKDTree(np.c_[cloud.x, cloud.y][ign_classes == 2])
    new = (classes == 2) & (expected_classes != 2)
    _, nearest = tree.query(np.c_[result.x, result.y][new])
    above = np.abs(np.asarray(result.z)[new] - np.asarray(cloud.z)[ign_classes == 2][nearest])
    assert np.percentile(above, 95) < 0.3
    heights = np.asarray(result["HeightAboveGround"])
    assert np.percentile(heights[expected_classes == 6], 5) > 1.5
    assert np.median(np.abs(heights[expected_classes == 2])) < 0.1

    written = json.loads(out.with_suffix(".pdal.json").read_text())["pipeline"]
    assert written[0]["filename"] == str(tmp_path / "0870_6618.laz") and written[-1]["filename"] == str(out)
    assert sorted(path.name for path in out.parent.iterdir()) == ["0870_6618.laz", "0870_6618.pdal.json"]


def test_real_pdal_finds_the_ground_of_the_miniature(pdal_command, tmp_path):
    """The classes of the stand-in cloud are exact, because it was simulated with them."""
    cloud = laspy.read(MINI)
    keep = (cloud.x < 653150) & (cloud.y > 6860850)
    cloud.points = cloud.points[keep]
    true_classes = np.asarray(cloud.classification).copy()
    cloud.classification = np.zeros(len(true_classes), np.uint8)
    cloud.write(tmp_path / "0653_6861.laz")
    out = tmp_path / "out.laz"
    around = (652900.0, 6859900.0, 654100.0, 6861100.0)
    prepare(
        out, [tmp_path / "0653_6861.laz"], Window(around, [], L93, L93), config(pdal_command=pdal_command)
    )
    result = laspy.read(out)
    before = dict(zip(map(tuple, rows_in_order(cloud)), true_classes.tolist(), strict=True))
    expected_classes = np.array([before[tuple(row)] for row in rows_in_order(result)])
    classes = np.asarray(result.classification)
    assert (classes[expected_classes == 2] == 2).mean() > 0.95
    assert (classes[expected_classes == 6] == 2).mean() < 0.02


def test_real_pdal_merges_drops_noise_and_keeps_classified_ground(pdal_command, write_points, tmp_path):
    points = scatter(3000, (652800, 6861400, 653300, 6861600))
    classes = np.random.default_rng(1).choice([1, 2, 6, 7, 18], len(points))
    withheld = np.random.default_rng(2).random(len(points)) < 0.1
    cloud = write_points("0652_6862.laz", points, classes, withheld=withheld)
    neighbour_points = scatter(2000, (653000, 6861400, 653300, 6861600), seed=3)
    neighbour = write_points("0653_6862.laz", neighbour_points, 2)
    out = tmp_path / "out.laz"
    settings = config(pdal_command=pdal_command, mode="pdal")
    facts = prepare(out, [cloud, neighbour], Window(AROUND, [EAST], L93, L93), settings)
    expected = (points[:, 0] < 653000) & ~withheld & ~np.isin(classes, [7, 18])
    result = laspy.read(out)
    assert rows(result.xyz) == rows(points[expected])
    assert facts["num_ground_points"] == (expected & (classes == 2)).sum(), "no further ground points"
    stages = json.loads(out.with_suffix(".pdal.json").read_text())["pipeline"]
    assert "filters.smrf" not in [stage["type"] for stage in stages]


def test_real_pdal_on_a_cloud_of_an_old_format(pdal_command, tmp_path):
    """A LAS 1.2 file without CRS, classes and numbers of returns, and with some withheld points."""
    rng = np.random.default_rng(0)
    points = scatter(4000, (652400, 6861400, 652460, 6861460))
    points[:, 2] = np.round(50 + 0.02 * (points[:, 0] - 652400), 3)
    roof = (abs(points[:, 0] - 652430) < 8) & (abs(points[:, 1] - 6861430) < 8)
    points[roof, 2] += 6
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [0.001] * 3, [652000, 6861000, 0]
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.withheld = rng.random(len(points)) < 0.1
    cloud.write(tmp_path / "0652_6862.laz")
    out = tmp_path / "out.laz"
    prepare(
        out, [tmp_path / "0652_6862.laz"], Window(AROUND, [], L93, L93), config(pdal_command=pdal_command)
    )
    result = laspy.read(out)
    assert len(result) >= 0.98 * (np.asarray(cloud.withheld) == 0).sum()
    assert len(result) <= (np.asarray(cloud.withheld) == 0).sum()
    on_roof = np.asarray(result.z) > 54
    classes = np.asarray(result.classification)
    assert (classes[on_roof] == 1).all() and (classes[~on_roof] == 2).mean() > 0.98
    assert (result.header.version.minor, result.header.parse_crs().to_epsg()) == (4, 2154)


def test_real_pdal_reprojects(pdal_command, write_points, tmp_path):
    """A cloud in UTM 31N: its points agree with pyproj within a millimetre."""
    import pyproj

    points = scatter(500, (652400, 6861400, 652600, 6861600))
    to_utm = pyproj.Transformer.from_crs(L93, "EPSG:32631", always_xy=True)
    x, y = to_utm.transform(points[:, 0], points[:, 1])
    moved = np.c_[x, y, points[:, 2]]
    cloud = write_points("0652_6862.laz", moved, 2, crs="EPSG:32631")
    out = tmp_path / "out.laz"
    prepare(out, [cloud], Window(AROUND, [], L93, "EPSG:32631"), config(pdal_command=pdal_command))
    result = laspy.read(out)
    distance, _ = cKDTree(points).query(result.xyz)
    assert len(result) == len(points) and distance.max() < 0.003
    assert result.header.parse_crs().to_epsg() == 2154


def rows_in_order(cloud: laspy.LasData) -> list[list[int]]:
    return np.round(np.c_[cloud.x, cloud.y, cloud.z, cloud.gps_time * 1e3] * 100).astype(np.int64).tolist()


def test_other_classes_can_be_ground(write_points, tmp_path):
    cloud = write_points("0652_6862.laz", scatter(100, TILE), np.arange(100) % 2 * 8)
    settings = config(pdal_command="no-such-program")
    facts = prepare(tmp_path / "out.laz", [cloud], Window(AROUND, [], L93, L93), settings, ground=(8, 11))
    assert facts["by"] == "laspy" and facts["num_ground_points"] == 50
    with pytest.raises(InputError, match=r"no ground points \(class 11\)"):
        prepare(tmp_path / "2.laz", [cloud], Window(AROUND, [], L93, L93), settings, ground=(11,))
    with pytest.raises(
        InputError, match=r"PDAL marks the ground by class 2: add it to region\.classes\.ground"
    ):
        prepare(
            tmp_path / "2.laz",
            [cloud],
            Window(AROUND, [], L93, L93),
            config(pdal_command="true"),
            ground=(11,),
        )
