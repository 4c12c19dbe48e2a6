"""The same input gives the same bytes, whatever the threads, the hash seed and the instruction set of the processor."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

DELFT = ROOT.parent / "shared/data/delft_ahn3"
TILE, LIDAR_TILE = "0653_6862", "0653_6861"
# all that this numpy can do beyond its baseline; a name that it does not know would switch nothing off
BEYOND_BASELINE = " ".join(
    name
    for name in np._core._multiarray_umath.__cpu_dispatch__
    if np._core._multiarray_umath.__cpu_features__[name]
)
INSTRUCTION_SETS = {
    "numpy without its newer instructions": {"NPY_DISABLE_CPU_FEATURES": BEYOND_BASELINE},
    "numba for any processor": {"NUMBA_CPU_NAME": "generic"},
}
VARIANTS: dict[str, tuple[list[str], dict[str, str]]] = {
    "again": ([], {}),
    "2 threads": (["--threads", "2"], {}),
    "hash seed": ([], {"PYTHONHASHSEED": "4711"}),
    **{name: ([], environment) for name, environment in INSTRUCTION_SETS.items()},
}


def p2wss(arguments: Sequence[str | Path], environment: dict[str, str], folder: Path = ROOT) -> None:
    """The command; that numpy does not know the name of an instruction set is an error."""
    main = "from p2wss.cli import main; raise SystemExit(main())"
    run = subprocess.run(
        [sys.executable, "-W", "error::ImportWarning", "-c", main, *map(str, arguments)],
        env=os.environ | environment, capture_output=True, text=True, check=False, cwd=folder,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def reconstruct(out: Path, options: list[str], environment: dict[str, str]) -> dict[str, bytes]:
    """The CityJSON and meshes of Delft, by name."""
    inputs = [DELFT / "ahn3.laz", DELFT / "footprints.gpkg", out]
    p2wss(["reconstruct", *inputs, "--format", "cityjsonseq,obj,geoparquet", *options], environment)
    return contents(out)


@pytest.mark.slow
@pytest.mark.skipif(not DELFT.is_dir(), reason="no data of Delft")
def test_delft_is_the_same_to_the_byte(tmp_path: Path) -> None:
    first = reconstruct(tmp_path / "first", [], {"PYTHONHASHSEED": "0"})
    assert len(first) >= 3
    different = {
        variant: [
            name
            for name, content in reconstruct(tmp_path / variant, *settings).items()
            if content != first[name]
        ]
        for variant, settings in VARIANTS.items()
    }
    assert different == {variant: [] for variant in VARIANTS}


@pytest.fixture(scope="module")
def fetched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Footprints, terrain and LiDAR of the miniature."""
    folder = tmp_path_factory.mktemp("fetched")
    stored = ["--downloads", folder / "downloads"]
    p2wss(["fetch", "footprints", "--out", folder / "footprints.gpkg", *stored], {})
    p2wss(["fetch", "dtm", "--tile", TILE, "--out", folder / "dtm.tif", *stored], {})
    p2wss(["fetch", "lidar", "--tile", LIDAR_TILE, "--out", folder / "lidar.laz", *stored], {})
    return folder


def stages(fetched: Path, out: Path, environment: dict[str, str]) -> dict[str, bytes]:
    """A scene, its buildings, a scan, and a reconstruction of other LiDAR, by name."""
    config = json.dumps({"scans": {"density_per_m2": 5.0}})
    out.mkdir()
    scene, terrain, buildings, scan = (
        out / name for name in ("scene.parquet", "scene.tif", "buildings.parquet", "scan.laz")
    )
    footprints = fetched / "footprints.gpkg"
    cut = ["--footprints", footprints, "--dtm", fetched / "dtm.tif", "--out", scene, "--out-dtm", terrain]
    p2wss(["scenes", "cut", "--tile", TILE, "--place=", *cut], environment)
    p2wss(["buildings", "--scene", scene, "--out", buildings], environment)
    inputs = ["--scene", scene, "--dtm", terrain, "--buildings", buildings]
    outputs = ["--out", scan, "--out-survey", out / "survey.json", "--picture", out / "scan.png"]
    p2wss(["scans", *inputs, *outputs, "--config", config], environment)
    files = [fetched / "lidar.laz", footprints, out]
    more = ["--skin", "--wedges", "--vegetation", "--format", "cityjsonseq,glb,gpkg"]
    p2wss(["reconstruct", *files, "--tile", LIDAR_TILE, *more], environment)
    return contents(out)


def test_every_stage_is_the_same_to_the_byte_with_other_instructions(fetched: Path, tmp_path: Path) -> None:
    first = stages(fetched, tmp_path / "first", {})
    assert len(first) == 11
    different = {
        name: [
            file for file, content in stages(fetched, tmp_path / name, set_).items() if content != first[file]
        ]
        for name, set_ in INSTRUCTION_SETS.items()
    }
    assert different == {name: [] for name in INSTRUCTION_SETS}
