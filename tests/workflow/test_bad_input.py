"""Bad input gets one clear line and a non-zero exit, and loses nothing that was there."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import rasterio
import shapely
from checkout import ROOT, TILE, TILE_SIZE_M

MINI = ROOT / "tests/mini"
LAZ = next((MINI / "lidar").glob("*.laz"))


def error_of(run: subprocess.CompletedProcess[str]) -> str:
    """The one line that the user sees."""
    lines = run.stderr.strip().splitlines()
    assert run.returncode == 2, run.stderr
    assert lines[-1].startswith("p2wss: error: ") and "Traceback" not in run.stderr, run.stderr
    return lines[-1]


@pytest.fixture
def footprints(tmp_path):
    path = tmp_path / "footprints.gpkg"
    place = shapely.box(653400, 6860400, 653410, 6860408)
    gpd.GeoDataFrame({"building_id": ["A"]}, geometry=[place], crs=2154).to_file(path)
    return path


@pytest.fixture
def model(done):
    return done.folder / "results/mini/model/model.safetensors"


def test_missing_cloud(fresh, footprints, model, tmp_path):
    out = tmp_path / "out"
    run = fresh.p2wss("reconstruct", "no-such.laz", footprints, out, "--model", model, check=False)
    assert "no-such.laz: no such file" in error_of(run) and not out.exists()


@pytest.mark.parametrize("num_bytes", [100, 400_000])
def test_truncated_cloud(fresh, footprints, model, tmp_path, num_bytes):
    cloud, out = tmp_path / "short.laz", tmp_path / "out"
    cloud.write_bytes(LAZ.read_bytes()[:num_bytes])
    run = fresh.p2wss("reconstruct", cloud, footprints, out, "--model", model, check=False)
    assert "short.laz" in error_of(run) and not out.exists()


def test_missing_model(fresh, footprints, tmp_path):
    run = fresh.p2wss(
        "reconstruct", LAZ, footprints, tmp_path / "out", "--model", "no-such.safetensors", check=False
    )
    assert "no-such.safetensors: no such file" in error_of(run)


def test_footprints_that_lie_elsewhere_once_they_are_reprojected(fresh, footprints, model, tmp_path):
    other = tmp_path / "other.gpkg"
    gpd.read_file(footprints).to_crs(32631).to_file(other)
    run = fresh.p2wss("reconstruct", LAZ, other, tmp_path / "out", "--model", model, check=False)
    line = error_of(run)
    assert "other.gpkg" in line and "no point near any of the 1 footprints" in line


def test_footprints_without_the_needed_columns(fresh, footprints, tmp_path):
    out = tmp_path / "out.gpkg"
    out.write_bytes(b"what was there")
    config = f"{{fetch: {{folder: {{footprints: {footprints}, footprints_layer: ''}}}}}}"
    run = fresh.p2wss("fetch", "footprints", "--out", out, "--config", config, check=False)
    assert "footprints.gpkg" in error_of(run) and "cleabs" in error_of(run)
    assert out.read_bytes() == b"what was there"


def test_a_tile_without_buildings(done, tmp_path):
    run = done.p2wss(
        "scenes", "cut", "--tile", "0100_6200", "--footprints", "results/mini/fetch/footprints.gpkg",
        "--dtm", f"resources/ign/mini/dtm/{TILE}.tif", "--out", tmp_path / "s.parquet",
        "--out-dtm", tmp_path / "s.tif", check=False,
    )  # fmt: skip
    assert "0100_6200" in error_of(run) and not list(tmp_path.glob("s.*"))


def test_terrain_with_a_hole_under_buildings(done, tmp_path):
    """The buildings over the hole are left out with a reason, the others stay."""
    hole = tmp_path / "hole.tif"
    with rasterio.open(done.folder / f"resources/ign/mini/dtm/{TILE}.tif") as source:
        height, profile = source.read(1), source.profile
    height[: height.shape[0] // 2] = np.nan
    with rasterio.open(hole, "w", **profile) as target:
        target.write(height, 1)
    out = tmp_path / "s.parquet"
    run = done.p2wss(
        "scenes", "cut", "--tile", TILE, "--footprints", "results/mini/fetch/footprints.gpkg",
        "--dtm", hole, "--out", out, "--out-dtm", tmp_path / "s.tif",
        "--config", f"{{region: {{tile_size_m: {TILE_SIZE_M}}}, scenes: {{max_failed_fraction: 1.0}}}}",
    )  # fmt: skip
    status = gpd.read_parquet(out)["status"].value_counts()
    assert status["no-terrain"] > 50 and status["ok"] > 50 and "no-terrain" in run.stderr
    run = done.p2wss(
        "scenes", "cut", "--tile", TILE, "--footprints", "results/mini/fetch/footprints.gpkg",
        "--dtm", hole, "--out", tmp_path / "t.parquet", "--out-dtm", tmp_path / "t.tif",
        "--config", f"{{region: {{tile_size_m: {TILE_SIZE_M}}}}}", check=False,
    )  # fmt: skip
    assert "max_failed_fraction" in error_of(run)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ("{scans: {densty_per_m2: 8}}", "scans.densty_per_m2: unknown key (did you mean density_per_m2?)"),
        ("{scans: {density_per_m2: -1}}", "scans.density_per_m2: Input should be greater than"),
        ("no-such.yaml", "no-such.yaml: no such file"),
    ],
)
def test_config(fresh, tmp_path, config, message):
    run = fresh.p2wss(
        *("scans", "--scene", "a", "--dtm", "b", "--buildings", "c", "--out", tmp_path / "d.laz"),
        *("--out-survey", tmp_path / "e.json", "--config", config),
        check=False,
    )
    assert message in error_of(run)


def test_a_disk_that_fills_up_leaves_the_old_file(done, tmp_path):
    """A limit on the size of files stands for a full disk: the write fails halfway."""
    results, out = done.folder / "results/mini", tmp_path / "scan.laz"
    out.write_bytes(b"what was there")

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

    run = subprocess.run(
        [
            Path(sys.executable).with_name("p2wss"), "scans", "--scene", results / f"scenes/{TILE}.parquet",
            "--dtm", results / f"scenes/{TILE}.tif", "--buildings", results / f"buildings/{TILE}.parquet",
            "--out", out, "--out-survey", tmp_path / "s.json", "--config", "{scans: {density_per_m2: 5.0}}",
        ],
        env=os.environ | {"PYTHONPATH": str(done.folder / "src")},
        preexec_fn=limit, capture_output=True, text=True,
    )  # fmt: skip
    assert "scan.laz: not written" in error_of(run)
    assert out.read_bytes() == b"what was there" and os.listdir(tmp_path) == ["scan.laz"]
