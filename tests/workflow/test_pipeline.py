"""The whole pipeline for real, on the reduced miniature (minutes)."""

import csv
import json
import os
import shutil
import zipfile

import pyarrow.parquet as pq
import pytest
import yaml
from checkout import ODD_NAME, REDUCED, TILE, Project, rules_to_run

NOTHING = "Nothing to be done"
SCANS_AND_WHAT_FOLLOWS = {
    "cast_scan",
    "crop_simulated",
    "crops",
    "dvae",
    "model",
    "eval_reconstruct",
    "measure",
    "medians",
    "eval_report",
}


@pytest.fixture
def again(done, tmp_path):
    """A copy of the finished project whose code can be edited; times and Snakemake's records are kept."""
    copy = object.__new__(Project)
    copy.folder = tmp_path / "copy"
    shutil.copytree(done.folder, copy.folder, copy_function=shutil.copy2)
    return copy


def planned(project: Project, *arguments: str) -> dict[str, int]:
    run = project.dry_run(*(arguments or ("all",)), *REDUCED)
    jobs = rules_to_run(run)
    assert jobs or NOTHING in run.stdout + run.stderr
    return jobs


def test_the_report_and_its_tables_are_there(done):
    folder = done.folder / "results/mini/eval"
    page = (folder / "report.html").read_text()
    assert "LiDAR of " in page and "LiDAR HD" not in page
    assert "was also trained on these clouds of LiDAR of" in page
    assert 'src="http' not in page and 'href="http' not in page, "one self-contained file"
    for name in ("table1", "table2", "table2_more", "groups", "worst"):
        rows = list(csv.reader((folder / f"{name}.csv").open()))
        assert len(rows) > 3 and len({len(row) for row in rows}) == 1
        assert (folder / f"{name}.tex").read_text().count(r"\\") == len(rows)


def test_snakemakes_own_report_has_page_and_tables(done, tmp_path):
    archive = tmp_path / "report.zip"
    done.snakemake("eval_report", "--report", str(archive), *REDUCED)
    with zipfile.ZipFile(archive) as content:
        names = [name.rsplit("/", 1)[-1] for name in content.namelist()]
        assert {"report.html", "table1.csv", "table2.csv", "table2_more.csv", "worst.csv"} <= set(names)
        text = "".join(content.read(name).decode(errors="ignore") for name in content.namelist())
    assert "as in Table 1 of the paper" in text, "the captions"


def test_every_building_has_a_row_and_every_mesh_is_closed(done):
    results = done.folder / "results/mini"
    manifest = json.loads((results / "crops/manifest.json").read_text())
    expected = set()
    for shard in manifest["shards"]:
        table = pq.read_table(results / "crops" / shard["path"], columns=["building_id", "split"])
        expected |= {row["building_id"] for row in table.to_pylist() if row["split"] in ("test", "none")}
    predictions = pq.read_table(results / "eval/parts/0000/point2wss.parquet").to_pylist()
    assert {row["building_id"] for row in predictions} == expected
    with_mesh = [row for row in predictions if row["triangle"]]
    assert len(with_mesh) >= 0.98 * len(predictions)
    for row in with_mesh:
        triangle = [tuple(row["triangle"][i : i + 3]) for i in range(0, len(row["triangle"]), 3)]
        edges = [(t[i], t[(i + 1) % 3]) for t in triangle for i in range(3)]
        assert len(set(edges)) == len(edges), row["building_id"]
        assert {(b, a) for a, b in edges} == set(edges), row["building_id"]


def test_a_second_run_has_nothing_to_do(done):
    assert planned(done) == {}


def test_docstrings_and_comments_rerun_nothing(again):
    again.edit("src/p2wss/scans/scan.py", '"""', '"""Another text. ')
    again.edit("src/p2wss/data/polygon_arrays.py", '"""', '"""Another text. ')
    again.edit("src/p2wss/data/manifest.py", "import os", "# a comment\nimport os")
    assert planned(again) == {}


def test_code_reruns_its_stage_and_what_follows(again):
    with (again.folder / "src/p2wss/scans/scan.py").open("a") as file:
        file.write("\n_A_NEW_CONSTANT = 1\n")
    assert set(planned(again)) - {"all"} == SCANS_AND_WHAT_FOLLOWS


def test_a_value_of_the_config_reruns_what_reads_it(again):
    again.edit("tests/mini/reduced.yaml", "num_resamples: 100", "num_resamples: 101")
    jobs = set(planned(again))
    assert "eval_report" in jobs and not {"model", "cast_scan"} & jobs


def test_a_replaced_input_reruns_what_was_made_of_it(again):
    """The user's own files: a newer one, and an older one of another size."""
    inputs = again.folder / ODD_NAME
    footprints = next((inputs / "bdtopo").glob("*.gpkg"))
    footprints.write_bytes(footprints.read_bytes() + b" ")
    jobs = planned(again)
    assert jobs["fetch_footprints"] == 1 and "fetch_dtm" not in jobs and "fetch_lidar" not in jobs

    cloud = next((inputs / "lidar").glob("*.laz"))
    cloud.write_bytes(cloud.read_bytes() + b" ")
    os.utime(cloud, (0, 0))
    assert planned(again)["fetch_lidar"] == 1

    grid = next((inputs / "rgealti").glob("*0653_6861*"))
    grid.write_text(grid.read_text() + " ")
    # a neighbour, into which the margin of the tile reaches
    assert planned(again)["fetch_dtm"] == 1


def test_weights_in_a_folder_with_an_odd_name_are_used(again):
    weights = f"{ODD_NAME}/point2wss.safetensors"
    shutil.copy(again.folder / "models/point2wss.safetensors", again.folder / weights)
    target = "results/mini/eval/parts/0000/point2wss.parquet"
    (again.folder / "weights.yaml").write_text(yaml.safe_dump({"model": {"weights": weights}}))
    again.snakemake(target, *REDUCED, "weights.yaml")
    assert (again.folder / target).stat().st_mtime > (again.folder / weights).stat().st_mtime
    assert not (again.folder / "executed").exists()


def test_one_stage_can_be_redone_by_name(done):
    jobs = planned(done, "all", "-R", "cast_scan")
    assert set(jobs) - {"all"} == SCANS_AND_WHAT_FOLLOWS
    assert set(planned(done, "-f", f"results/mini/scans/{TILE}.laz")) == {"cast_scan"}


def test_the_scan_is_the_same_with_other_threads(done, tmp_path):
    results = done.folder / "results/mini"
    config = json.dumps({"scans": {"density_per_m2": 5.0}})
    scene = ["--scene", results / f"scenes/{TILE}.parquet", "--dtm", results / f"scenes/{TILE}.tif"]
    done.p2wss(
        "scans", *scene, "--buildings", results / f"buildings/{TILE}.parquet", "--out", tmp_path / "s.laz",
        "--out-survey", tmp_path / "s.json",
        "--threads", 2, "--config", config,
    )  # fmt: skip
    import laspy
    import numpy as np

    first, second = laspy.read(results / f"scans/{TILE}.laz"), laspy.read(tmp_path / "s.laz")
    for dimension in ("X", "Y", "Z", "building_id", "face_id", "gps_time"):
        assert np.array_equal(first[dimension], second[dimension]), dimension
