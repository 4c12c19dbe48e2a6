"""Fixtures: the project in a folder of its own, and the finished reduced miniature."""

import pytest
from checkout import REDUCED, Project


@pytest.fixture
def project(tmp_path):
    return Project(tmp_path)


@pytest.fixture(scope="session")
def done(tmp_path_factory):
    """The reduced miniature after ``snakemake eval_report``; not to be changed."""
    project = Project(tmp_path_factory.mktemp("mini"))
    project.snakemake("eval_report", *REDUCED)
    return project
