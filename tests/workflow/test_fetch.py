"""Fetch and prepare in the workflow: what is rerun when, and from what."""

import re

import laspy
import numpy as np
import yaml
from checkout import rules_to_run

CLOUD = "LHD_FXX_0653_6861_PTS_LAMB93_IGN69.laz"


def configure(project, **fetch):
    (project.folder / "mine.yaml").write_text(yaml.safe_dump({"fetch": fetch}))
    return ["--configfile", "mine.yaml"]


def test_settings_of_pdal_download_nothing_again(project):
    project.snakemake("-c1", "fetch", *configure(project, prepare={"mode": "auto"}))
    prepared = project.folder / "results/mini/fetch/lidar/0653_6861.laz"
    assert prepared.samefile(project.folder / "resources/ign/mini/lidar/0653_6861.laz")
    changed = rules_to_run(project.dry_run("fetch", *configure(project, prepare={"mode": "never"})))
    assert set(changed) == {"prepare_lidar", "fetch"}


def test_an_unclassified_cloud_without_pdal_stops_with_one_line(project):
    folder = project.folder / "clouds"
    folder.mkdir()
    cloud = laspy.read(project.folder / "tests/mini/lidar" / CLOUD)
    cloud.points = cloud.points[np.arange(len(cloud)) % 50 == 0]
    cloud.classification = np.zeros(len(cloud), np.uint8)
    cloud.write(folder / CLOUD)
    settings = configure(
        project, folder={"lidar": "clouds"}, prepare={"pdal_command": "no-such-program --verbose"}
    )
    run = project.snakemake("-c1", "results/mini/fetch/lidar/0653_6861.laz", *settings, check=False)
    assert run.returncode != 0
    line, again = [text for text in run.stderr.splitlines() if "p2wss: error:" in text]
    assert "no ground points (class 2)" in line and "envs/pdal.yaml" in line
    # once more after the command with its settings
    assert re.fullmatch(r"logs/\S+\.log: (.*)", again)[1] == line and again in run.stderr.splitlines()[-8:]
    assert not (project.folder / "results/mini/fetch/lidar/0653_6861.laz").exists()
