"""Sionna RT itself loads a reconstructed scene and traces paths in it, installed into an environment of its own."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import venv
from pathlib import Path

import pytest
import rasterio
from places import MINI, ROOT, SHARED

from p2wss import cli

VERSION = "2.2.0"
# the environment and LLVM are kept for the next run
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "p2wss-tests"
# the package that is unpacked where the system has no LLVM that works; older ones than 17 cannot translate what
# drjit 1.5 asks of them
LLVM_PACKAGE = "libllvm19"
# what such a version fails at
PROBE = """
import drjit, mitsuba
mitsuba.set_variant("llvm_ad_mono_polarized")
x = drjit.arange(mitsuba.Float, 64)
assert drjit.sum(drjit.sqrt(drjit.maximum(1 - x * x, 0)))[0] == 1
"""

pytestmark = pytest.mark.slow


def attempt(command: list[str | Path], cwd: Path | None = None) -> str | None:
    """The last line of the error output of a command that fails, None if it succeeds."""
    try:
        result = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    except FileNotFoundError:
        return f"there is no {command[0]}"
    if result.returncode == 0:
        return None
    return (result.stderr.strip().splitlines() or [f"exit code {result.returncode}"])[-1]


@pytest.fixture(scope="module")
def python() -> Path:
    """An interpreter that has Sionna RT, else the reason why the tests are skipped."""
    folder = CACHE / f"sionna-rt-{VERSION}"
    interpreter, complete = folder / "bin" / "python", folder / "complete"
    if not complete.exists():
        venv.create(folder, with_pip=True, clear=True)
        reason = attempt([interpreter, "-m", "pip", "install", "--quiet", f"sionna-rt=={VERSION}"])
        if reason is not None:
            pytest.skip(f"sionna-rt {VERSION} cannot be installed: {reason}")
        complete.touch()
    return interpreter


@pytest.fixture(scope="module")
def environment(python: Path) -> dict[str, str]:
    """Variables with an LLVM that Dr.Jit can use; one GPU makes it superfluous, but does no harm."""
    libraries = [Path(os.environ["DRJIT_LIBLLVM_PATH"])] if "DRJIT_LIBLLVM_PATH" in os.environ else []
    libraries += installed("/usr/lib")
    unpacked = CACHE / LLVM_PACKAGE
    libraries += installed(unpacked)
    for library in libraries:
        if works(python, library):
            return os.environ | {"DRJIT_LIBLLVM_PATH": str(library)}
    unpacked.mkdir(parents=True, exist_ok=True)
    reason = attempt(["apt-get", "download", LLVM_PACKAGE], unpacked)
    for package in unpacked.glob("*.deb"):
        reason = attempt(["dpkg", "-x", package, unpacked])
    for library in installed(unpacked):
        if works(python, library):
            return os.environ | {"DRJIT_LIBLLVM_PATH": str(library)}
    pytest.skip(f"no libLLVM that Dr.Jit can use; {LLVM_PACKAGE} of the package manager: {reason}")


def installed(folder: str | Path) -> list[Path]:
    """Libraries of LLVM below a folder, the newest first."""
    found = [path for path in Path(folder).rglob("libLLVM*.so*") if re.search(r"\d", path.name)]
    unique = {path.resolve(): path for path in found if path.exists()}
    return sorted(unique, key=lambda path: [int(n) for n in re.findall(r"\d+", path.name)], reverse=True)


def works(python: Path, library: Path) -> bool:
    variables = os.environ | {"DRJIT_LIBLLVM_PATH": str(library)}
    return subprocess.run([python, "-c", PROBE], env=variables, capture_output=True).returncode == 0


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Cloud, footprints and terrain of 74 houses in Delft, else of the miniature."""
    delft = SHARED / "data" / "delft_ahn3"
    if delft.is_dir():
        cloud, footprints, grid, crs = delft / "ahn3.laz", delft / "footprints.gpkg", delft / "dtm.asc", 28992
    else:
        (cloud,) = (MINI / "lidar").glob("*.laz")
        (footprints,) = (MINI / "bdtopo").glob("*.gpkg")
        grid, crs = MINI / "rgealti" / "RGEALTI_FXX_0653_6861_MNT_LAMB93_IGN69.asc", 2154
    terrain = tmp_path_factory.mktemp("terrain") / "dtm.tif"
    with rasterio.open(grid) as source:
        profile = source.profile | {"driver": "GTiff", "crs": f"EPSG:{crs}"}
        with rasterio.open(terrain, "w", **profile) as target:
            target.write(source.read())
    return [str(cloud), str(footprints), str(terrain)]


@pytest.mark.parametrize("frequency_ghz", ["3.5", "77"])
def test_a_reconstructed_scene_is_loaded_and_traced(
    frequency_ghz: str, python: Path, environment: dict[str, str], inputs: list[str], tmp_path: Path
) -> None:
    cloud, footprints, terrain = inputs
    options = ["--model", "none", "--format", "sionna", "--terrain", terrain]
    assert (
        cli.main(
            ["reconstruct", cloud, footprints, str(tmp_path), *options, "--frequency-ghz", frequency_ghz]
        )
        == 0
    )
    (folder,) = tmp_path.glob("*_sionna")
    run = subprocess.run(
        [python, ROOT / "tests" / "unit" / "sionna_tracing.py", folder],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    answer = json.loads(run.stdout.splitlines()[-1])
    facts = json.loads((folder / "scene.json").read_text())
    print({**answer, "shapes": len(answer["shapes"])}, file=sys.stderr)
    assert set(answer["shapes"]) == set(facts["shapes"]) and len(answer["shapes"]) > 30
    # Mitsuba warns of each property of a file that it does not know
    assert "WARN" not in run.stdout + run.stderr
    for direction in ("down", "slanted"):
        hits, from_behind = answer[direction]
        assert hits > 100_000 and from_behind == 0
    assert answer["down"][0] == 200_000
    assert answer["reflected"] > 0 and answer["diffracted"] > 0
    assert answer["paths"] > answer["reflected"] + answer["diffracted"]
    assert answer["lit_cells"] > 0.5 * answer["cells"] > 1000
