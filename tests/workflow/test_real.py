"""Real footprints and real LiDAR, where they are at hand: ../shared/data beside the checkout."""

import csv
import json
import re
import shutil
import subprocess
import sys

import geopandas as gpd
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from checkout import ROOT, rules_to_run

from p2wss.skeleton import Status

DATA = ROOT.parent / "shared" / "data"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="no real data beside the checkout")

# reasons that blame a footprint's courtyards, which the bar of rejected buildings leaves aside
COURTYARD_REASONS = {Status.COURTYARD_OUTSIDE.reason}


def test_real_footprints_from_fetch_to_crops(project):
    """Two tiles of BD TOPO: at most 2 % of the buildings are rejected, outside courtyards."""
    tiles = ["0664_6361", "0664_6360"]
    config = {
        "region": {
            "name": "olemps",
            "vintage": "olemps",
            "bounds_m": [664000, 6359000, 665000, 6361000],
            "tiles": tiles,
            "lidar_tiles": [],
        },
        "fetch": {
            "folder": {
                "footprints": str(DATA / "olemps_bdtopo/BATIMENT.shp"),
                "footprints_layer": "",
                "dtm": str(DATA / "olemps_bdtopo/dtm"),
            }
        },
        "scans": {"density_per_m2": 2.0, "density_bounds_per_m2": [1.0, 30.0]},
    }
    (project.folder / "olemps.yaml").write_text(yaml.safe_dump(config))
    project.snakemake("crops", "-c2", "--configfile", "olemps.yaml")

    counts: dict[str, int] = {}
    for tile in tiles:
        table = pq.read_table(project.folder / f"results/olemps/buildings/{tile}.parquet")
        for row in table.select(["in_tile", "status"]).to_pylist():
            if row["in_tile"]:
                counts[row["status"]] = counts.get(row["status"], 0) + 1
    print(f"\nOlemps, {sum(counts.values())} buildings:", json.dumps(counts))
    assert sum(counts.values()) >= 1341
    rejected = sum(n for reason, n in counts.items() if reason != "ok" and reason not in COURTYARD_REASONS)
    assert rejected <= 0.02 * sum(counts.values())
    logs = "".join(path.read_text() for path in (project.folder / "logs/olemps/buildings").glob("*.log"))
    assert len(re.findall(r"\d+ buildings ok, \d+ excluded", logs)) == len(tiles)
    manifest = json.loads((project.folder / "results/olemps/crops/manifest.json").read_text())
    assert manifest["num_rows"] >= 0.9 * counts["ok"]


def test_real_lidar_becomes_closed_buildings(done, tmp_path):
    """All 74 buildings of Delft, each a closed solid, as the miniature's (reduced) model predicts them."""
    delft = DATA / "delft_ahn3"
    run = done.p2wss(
        "reconstruct",
        delft / "ahn3.laz",
        delft / "footprints.gpkg",
        tmp_path,
        "--model",
        done.folder / "results/mini/model/model.safetensors",
    )
    print("\n" + run.stderr)
    table = gpd.read_file(tmp_path / "ahn3.gpkg")
    assert len(table) == 74 and (table["status"] == "ok").all() and table.crs.to_epsg() == 28992
    header, *features = map(json.loads, (tmp_path / "ahn3.city.jsonl").open())
    assert header["version"] == "2.0" and len(features) == 74
    assert {name for f in features for name in f["CityObjects"]} >= set(table["building_id"].astype(str))
    for feature in features:
        for city_object in feature["CityObjects"].values():
            for solid in city_object.get("geometry", []):
                assert solid["type"] == "Solid" and _is_closed(solid["boundaries"][0])


@pytest.mark.slow
def test_table_2_of_a_real_data_set_with_recorded_roofer(done, project):
    """Delft through the workflow with weights from elsewhere: all variants, and Roofer as recorded."""
    model = done.folder / "results/mini/model/model.safetensors"
    shutil.copy(model, project.folder / "weights.safetensors")
    shutil.copytree(ROOT / "tests/real", project.folder / "tests/real")
    make = [sys.executable, "tests/real/make.py", str(DATA), "resources/real"]
    subprocess.run(make, cwd=project.folder, check=True)
    config = yaml.safe_load((project.folder / "tests/real/delft.yaml").read_text())
    config["model"] = {"weights": "weights.safetensors"}
    config["eval"] |= {"num_worst": 1, "num_resamples": 100}
    (project.folder / "delft.yaml").write_text(yaml.safe_dump(config))
    target = ["eval_report", "-c2", "--configfile", "delft.yaml"]
    project.snakemake(*target)
    folder = project.folder / "results/delft/eval"
    header, *rows = csv.reader((folder / "table2.csv").open())
    mean = dict(zip(header, rows[0], strict=True))
    # the judge of the real data gives Roofer 0.914
    assert abs(float(mean["Delft AHN3 / Roofer (recorded)"]) - 0.914) < 0.012
    assert float(mean["Delft AHN3 / Fit alone"]) < 0.95 < 1.5 * float(mean["Delft AHN3 / Point2WSS"])
    more = {row[0]: row[1:] for row in csv.reader((folder / "table2_more.csv").open())}
    at = [i for i, title in enumerate(more["Measure"]) if title.startswith("Delft")]
    assert {more["Buildings"][i] for i in at} == {"74"} and {more["Without a mesh"][i] for i in at} == {"0"}
    assert {more["Manifold (%)"][i] for i in at} == {"100.0000"}
    assert "Roofer (recorded)" in (folder / "report.html").read_text()
    assert rules_to_run(project.dry_run(*target)) == {}
    # a Roofer that appears is run instead
    program = project.folder / "roofer"
    program.write_text("#!/bin/sh\necho roofer 9.9\n")
    program.chmod(0o755)
    config["eval"]["roofer_command"] = str(program)
    (project.folder / "delft.yaml").write_text(yaml.safe_dump(config))
    jobs = rules_to_run(project.dry_run(*target))
    assert jobs["eval_reconstruct"] == 1


def test_footprints_of_another_country_are_one_clear_line(done, tmp_path):
    run = done.p2wss(
        "reconstruct",
        DATA / "bresse_ign/lidar.laz",
        DATA / "delft_ahn3/footprints.gpkg",
        tmp_path / "out",
        "--model",
        done.folder / "results/mini/model/model.safetensors",
        check=False,
    )
    assert run.returncode == 2 and not (tmp_path / "out").exists()
    (line,) = [text for text in run.stderr.splitlines() if text.startswith("p2wss: error:")]
    assert "footprints.gpkg" in line and "lidar.laz: no point near any of the 74 footprints" in line


def _is_closed(shell: list[list[list[int]]]) -> bool:
    """Every directed edge of a shell's rings has its opposite exactly once."""
    edges = [(a, b) for face in shell for ring in face for a, b in zip(ring, np.roll(ring, -1), strict=True)]
    return len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)
