"""Shared by the benchmarks: the real places beside the checkout, and the judge, which shares no code with p2wss."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyproj

from p2wss.reconstruction.outputs.city import city_json as reconstruct_city_json
from p2wss.reconstruction.result import Result


@dataclass(frozen=True)
class Place:
    """Footprints and clouds in files, and their CRS."""

    footprints: Path
    clouds: tuple[Path, ...]
    epsg: int


def places(folder: Path) -> dict[str, Place]:
    """The real places below ``folder``."""
    delft, bresse, crops = (folder / name for name in ("delft_ahn3", "bresse_ign", "lidarhd_crops"))
    tiles = [path for path in sorted(crops.glob("*.laz")) if "copc" not in path.name]
    return {
        "delft": Place(delft / "footprints.gpkg", (delft / "ahn3.laz",), 28992),
        "lidar hd": Place(crops / "footprints.gpkg", tuple(tiles), 2154),
        "bresse": Place(bresse / "footprints.gpkg", (bresse / "lidar.laz",), 2154),
    }


def judged_file(judge: Path, city_json: Path, footprints: Path, clouds: Sequence[Path]) -> dict[str, Any]:
    """The judge's result for a CityJSON file: a ``summary``, and ``rows``, one per building."""
    command = [sys.executable, judge, city_json, footprints, *clouds, "--json"]
    completed = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=True)
    judged: dict[str, Any] = json.loads(completed.stdout)
    return judged


def judged_rows(
    judge: Path, results: Sequence[Result], place: Place, footprints: Path | None = None
) -> list[dict[str, Any]]:
    """The judge's rows for reconstructions, one per building. footprints: in place of the footprints of the place."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "reconstructions.city.jsonl"
        path.write_text(
            "".join(reconstruct_city_json(results, pyproj.CRS.from_epsg(place.epsg))), encoding="utf-8"
        )
        rows: list[dict[str, Any]] = judged_file(judge, path, footprints or place.footprints, place.clouds)[
            "rows"
        ]
    return rows
