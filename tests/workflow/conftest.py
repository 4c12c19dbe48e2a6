"""Fixtures: the project in a folder of its own, and the finished reduced miniature."""

import shutil

import pytest
import yaml
from checkout import ODD_NAME, REDUCED, SMALL_TILES, Project


@pytest.fixture
def project(tmp_path):
    """A checkout of the test's own."""
    return Project(tmp_path)


@pytest.fixture(scope="session")
def fresh(tmp_path_factory):
    """A checkout in which nothing has been run; tests share it and change nothing in it."""
    return Project(tmp_path_factory.mktemp("fresh"))


@pytest.fixture(scope="session")
def done(tmp_path_factory):
    """Small tiles of the reduced miniature after all stages, from a folder with a name that a shell would take apart;
    tests share it and change nothing in it."""
    project = Project(tmp_path_factory.mktemp("mini"))
    inputs = project.folder / ODD_NAME
    for name in ("bdtopo", "rgealti", "lidar"):
        shutil.copytree(project.folder / "tests/mini" / name, inputs / name)
    config = project.folder / "tests/mini/reduced.yaml"
    settings = yaml.safe_load(config.read_text()) | SMALL_TILES
    settings["fetch"] = {
        "folder": {
            "footprints": f"{ODD_NAME}/bdtopo",
            "dtm": f"{ODD_NAME}/rgealti",
            "lidar": f"{ODD_NAME}/lidar",
        }
    }
    config.write_text(yaml.safe_dump(settings, allow_unicode=True))
    project.snakemake(*REDUCED)
    assert not (project.folder / "executed").exists(), "a command in the name of a folder was run"
    return project
