"""Fixtures: the project in a folder of its own, and the finished reduced miniature."""

import pytest
from checkout import REDUCED, Project


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
    """The reduced miniature after ``snakemake eval_report``; tests share it and change nothing in it."""
    project = Project(tmp_path_factory.mktemp("mini"))
    project.snakemake("eval_report", *REDUCED)
    return project
