"""The paper's structure in small: two regions, two draws of one, real clouds for the dvae and others for the test."""

import json

import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from checkout import Project, rules_to_run

DATASET = ["-c2", "--configfile", "tests/mini/dataset.yaml"]
TOWN, MINI, LIDAR = "0652500_6861500", "0653000_6861500", "0653250_6861000"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The data set after ``snakemake``; not to be changed."""
    project = Project(tmp_path_factory.mktemp("dataset"))
    project.snakemake(*DATASET)
    return project


@pytest.fixture(scope="module")
def results(finished):
    return finished.folder / "results/dataset"


def test_the_manifest_lists_every_draw_and_chooses_as_many_as_were_asked_for(results):
    manifest = json.loads((results / "crops/manifest.json").read_text())
    assert [(shard["dataset"], shard["tile"]) for shard in manifest["shards"]] == [
        ("simulated", f"town/1/{TOWN}"),
        ("simulated", f"town/2/{TOWN}"),
        ("simulated", f"mini/{MINI}"),
        ("real", f"mini/{LIDAR}"),
    ]
    counts = {
        (dataset, purpose): chosen["num_buildings"]
        for dataset, purposes in manifest["selection"]["ranges"].items()
        for purpose, chosen in purposes.items()
    }
    assert counts == {
        ("simulated", "train"): 48,
        ("simulated", "val"): 6,
        ("simulated", "test"): 6,
        ("real", "test"): 10,
        ("real", "dvae"): 15,
    }


def test_draws_share_footprints_and_splits_and_differ_in_roofs(results):
    first, second = (
        pq.read_table(results / f"crops/simulated/town/{draw}/{TOWN}.parquet") for draw in (1, 2)
    )
    columns = ["building_id", "split", "angle_deg"]
    rows = [
        {row["building_id"]: row for row in table.select(columns).to_pylist()} for table in (first, second)
    ]
    both = rows[0].keys() & rows[1].keys()
    assert len(both) > 50
    assert all(rows[0][name]["split"] == rows[1][name]["split"] for name in both)
    assert sum(rows[0][name]["angle_deg"] != rows[1][name]["angle_deg"] for name in both) > 0.9 * len(both)
    assert set(pc.unique(second["tile"]).to_pylist()) == {f"town/2/{TOWN}"}


def test_the_evaluation_is_of_the_chosen_buildings_with_their_places(results):
    (path,) = results.glob("eval/parts/*/point2wss.parquet")
    table = pq.read_table(path, columns=["dataset", "tile", "building_id"])
    assert table["dataset"].to_pylist().count("simulated") == 6
    assert table["dataset"].to_pylist().count("real") == 10
    assert set(table["tile"].to_pylist()) <= {f"town/1/{TOWN}", f"town/2/{TOWN}", f"mini/{LIDAR}"}
    tiles = [pq.read_table(file, columns=["tile"]) for file in results.glob("eval/parts/*/measures.parquet")]
    assert any(f"mini/{LIDAR}" in table["tile"].to_pylist() for table in tiles)
    assert (results / f"reconstruct/mini/{LIDAR}.city.jsonl").exists()
    assert (results / "model/model.safetensors").exists()


def test_the_model_was_trained_by_two_processes(finished, results):
    log = (finished.folder / "logs/dataset/model/train.log").read_text()
    assert log.count("step 10:") == 1, "the first process reports"
    lines = (results / "model/metrics.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(lines[-2])["step"] == 10 and list(json.loads(lines[-1])) == ["checksum"]
    run = finished.dry_run("-f", "results/dataset/model/model.safetensors", *DATASET)
    assert "torchrun --standalone --nproc-per-node 2 -m p2wss.cli model" in run.stdout + run.stderr


def test_the_number_of_processes_trains_nothing_again(finished):
    run = finished.dry_run("eval_report", *DATASET, "--config", "model={compute: {num_gpus: 4}}")
    assert rules_to_run(run) == {}


def test_the_report_is_of_the_data_set_and_shows_each_draw(results):
    page = (results / "eval/report.html").read_text()
    assert "Point2WSS on dataset" in page and "Drawn LiDAR" in page
    assert f"Tile town/1/{TOWN}, by" in page and f"Tile town/2/{TOWN}, by" in page
    assert "was also trained on these clouds" not in page, "the dvae saw others"


def test_a_second_run_has_nothing_to_do(finished):
    run = finished.dry_run(*DATASET)
    assert rules_to_run(run) == {} and "Nothing to be done" in run.stdout + run.stderr


def test_one_scan_of_one_draw_can_be_redone(finished):
    run = finished.dry_run("-f", f"results/dataset/scans/town/2/{TOWN}.laz", *DATASET)
    assert rules_to_run(run) == {"cast_scan": 1}


def test_another_seed_of_the_choice_casts_no_scan_again(finished):
    run = finished.dry_run("eval_report", *DATASET, "--config", "dataset={seed: 1}")
    jobs = rules_to_run(run)
    assert {"crops", "model", "eval_report"} <= set(jobs) and "cast_scan" not in jobs
