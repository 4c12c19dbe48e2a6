"""The same input gives the same bytes, whatever the number of threads, the batch size and the hash seed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DELFT = ROOT.parent / "shared/data/delft_ahn3"
VARIANTS: dict[str, tuple[list[str], dict[str, str]]] = {
    "again": ([], {}),
    "2 threads": (["--threads", "2"], {}),
    "hash seed": ([], {"PYTHONHASHSEED": "4711"}),
    "no AVX in numpy": ([], {"NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3"}),
}


def reconstruct(out: Path, options: list[str], environment: dict[str, str]) -> dict[str, bytes]:
    """The CityJSON and meshes of Delft, by name."""
    command = [
        "reconstruct",
        DELFT / "ahn3.laz",
        DELFT / "footprints.gpkg",
        out,
        "--format",
        "cityjsonseq,obj,geoparquet",
    ]
    run = subprocess.run(
        [sys.executable, "-c", "from p2wss.cli import main; raise SystemExit(main())", *map(str, command), *options],
        env=os.environ | environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return {path.name: path.read_bytes() for path in sorted(out.iterdir()) if path.suffix != ".json"}


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
