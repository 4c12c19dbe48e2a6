"""Results in object storage: a local S3 server (moto) on the loopback, and the plan of the profile for Kubernetes."""

import socket
import subprocess
import sys
import time
from contextlib import closing

import pytest
from checkout import Project, rules_to_run

pytest.importorskip("moto", reason="no moto[server]: make engines")
pytest.importorskip("snakemake_storage_plugin_s3", reason="no snakemake-storage-plugin-s3: make engines")
boto3 = pytest.importorskip("boto3")

# one tile, found by the checkpoint, and no real LiDAR
REGION = ["--config", "region={tiles: [], lidar_tiles: [], bounds_m: [653000, 6861000, 654000, 6862000]}"]
ACCOUNT = {
    "SNAKEMAKE_STORAGE_S3_ACCESS_KEY": "test",
    "SNAKEMAKE_STORAGE_S3_SECRET_KEY": "test",
    "SNAKEMAKE_STORAGE_S3_REGION": "us-east-1",
}


@pytest.fixture(scope="module")
def s3(tmp_path_factory):
    """A client of a server with an empty bucket ``p2wss``; Snakemake finds it through environment variables."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    log = tmp_path_factory.mktemp("s3") / "server.log"
    with log.open("w") as stream, pytest.MonkeyPatch.context() as patch:
        server = subprocess.Popen(
            [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)],
            stdout=stream,
            stderr=subprocess.STDOUT,
        )
        try:
            for name, value in {**ACCOUNT, "SNAKEMAKE_STORAGE_S3_ENDPOINT_URL": url}.items():
                patch.setenv(name, value)
            client = boto3.client(
                "s3",
                endpoint_url=url,
                region_name="us-east-1",
                aws_access_key_id="a",
                aws_secret_access_key="b",
            )
            _wait_for(port, log)
            client.create_bucket(Bucket="p2wss")
            yield client
        finally:
            server.terminate()
            server.wait(10)


def _wait_for(port: int, log) -> None:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        with closing(socket.socket()) as client:
            if client.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.2)
    pytest.fail(log.read_text())


def storage(prefix: str) -> list[str]:
    return ["--default-storage-provider", "s3", "--default-storage-prefix", f"s3://p2wss/{prefix}"]


def keys(s3, prefix: str) -> set[str]:
    pages = s3.get_paginator("list_objects_v2").paginate(Bucket="p2wss", Prefix=f"{prefix}/")
    return {item["Key"].removeprefix(f"{prefix}/") for page in pages for item in page.get("Contents", [])}


def test_a_tile_goes_through_the_bucket_and_is_not_made_again_elsewhere(s3, project, tmp_path_factory):
    """Results, logs and benchmarks are in the bucket alone; another checkout has nothing to do."""
    target = ["-c1", "crops", *REGION, *storage("run")]
    project.snakemake(*target)
    in_bucket = keys(s3, "run")
    assert {
        "results/mini/scenes/index.tsv",
        "results/mini/scans/0653_6862.laz",
        "results/mini/crops/manifest.json",
        "logs/mini/scans/0653_6862.log",
        "logs/mini/benchmarks/scans/0653_6862.tsv",
    } <= in_bucket
    assert not (project.folder / "results").exists()
    other = Project(tmp_path_factory.mktemp("other"))
    assert rules_to_run(other.snakemake("-n", *target)) == {}


@pytest.mark.parametrize(
    "config", ["tests/mini/reduced.yaml", "config/shipped.yaml", "tests/mini/dataset.yaml"]
)
def test_the_profile_for_kubernetes_plans_to_the_report(s3, project, config):
    """What the config names (weights, PDAL's models, a drawn town) is not looked for in the bucket."""
    pytest.importorskip("snakemake_executor_plugin_kubernetes", reason="make engines")
    run = project.snakemake(
        *("-n", "eval_report", "--profile", "profiles/kubernetes", "--container-image", "p2wss"),
        *("--default-storage-prefix", "s3://p2wss/plan", "--configfile", config),
    )
    jobs = rules_to_run(run)
    assert {"cut_scene", "cast_scan", "eval_reconstruct", "eval_report"} <= set(jobs)
    log = run.stdout + run.stderr
    assert "Group job tile" in log and "gpu_manufacturer=nvidia" in log and "scale=0" in log
    assert "s3://p2wss/plan/results/" in log and "s3://p2wss/plan/config/" not in log
    assert "s3://p2wss/plan/resources/towns" not in log and "s3://p2wss/plan/models" not in log
