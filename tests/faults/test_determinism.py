"""The same input gives the same bytes, whatever the threads, the hash seed and the instruction set of the processor."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from p2wss.cli import main

DELFT = ROOT.parent / "shared/data/delft_ahn3"
# of the miniature, with 49 and 27 buildings
TILE, LIDAR_TILE = "0653000_6861500", "0653250_6861000"
CONFIG = ["--config", json.dumps({"region": {"tile_size_m": 250}, "scans": {"density_per_m2": 5.0}})]
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


def p2wss(arguments: Sequence[str | Path], environment: dict[str, str] | None, folder: Path = ROOT) -> None:
    """The command; that numpy does not know the name of an instruction set is an error.

    Without an environment it is run here, where its libraries are imported.
    """
    if environment is None:
        with chdir(folder):
            assert main(list(map(str, arguments))) == 0
        return
    program = "from p2wss.cli import main; raise SystemExit(main())"
    run = subprocess.run(
        [sys.executable, "-W", "error::ImportWarning", "-c", program, *map(str, arguments)],
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
    for words in (
        ["footprints", "--out", folder / "footprints.gpkg"],
        ["dtm", "--tile", TILE, "--out", folder / "dtm.tif"],
        ["lidar", "--tile", LIDAR_TILE, "--out", folder / "lidar.laz"],
    ):
        p2wss(["fetch", *words, "--downloads", folder / "downloads", *CONFIG], None)
    return folder


def stages(fetched: Path, out: Path, environment: dict[str, str] | None) -> dict[str, bytes]:
    """A scene, its buildings, a scan, and a reconstruction of other LiDAR, by name."""
    out.mkdir()
    scene, terrain, buildings, scan = (
        out / name for name in ("scene.parquet", "scene.tif", "buildings.parquet", "scan.laz")
    )
    footprints = fetched / "footprints.gpkg"
    cut = ["--footprints", footprints, "--dtm", fetched / "dtm.tif", "--out", scene, "--out-dtm", terrain]
    p2wss(["scenes", "cut", "--tile", TILE, "--place=", *cut, *CONFIG], environment)
    p2wss(["buildings", "--scene", scene, "--out", buildings], environment)
    inputs = ["--scene", scene, "--dtm", terrain, "--buildings", buildings]
    outputs = ["--out", scan, "--out-survey", out / "survey.json", "--picture", out / "scan.png"]
    p2wss(["scans", *inputs, *outputs, *CONFIG], environment)
    files = [fetched / "lidar.laz", footprints, out]
    more = ["--skin", "--wedges", "--vegetation", "--format", "cityjsonseq,glb,gpkg"]
    p2wss(["reconstruct", *files, "--tile", LIDAR_TILE, *more, *CONFIG], environment)
    return contents(out)


@pytest.fixture(scope="module")
def first(fetched: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    results = stages(fetched, tmp_path_factory.mktemp("stages") / "first", None)
    assert len(results) == 11
    return results


# numba compiles everything once more for another processor, which takes as long as all other tests of this folder
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if "NUMBA_CPU_NAME" in environment else [])
        for name, environment in INSTRUCTION_SETS.items()
    ],
)
def test_every_stage_is_the_same_to_the_byte_with_other_instructions(
    name: str, first: dict[str, bytes], fetched: Path, tmp_path: Path
) -> None:
    again = stages(fetched, tmp_path / "again", INSTRUCTION_SETS[name])
    assert [file for file, content in again.items() if content != first[file]] == []
