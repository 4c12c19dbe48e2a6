"""Damaged and hostile files end in one line that names the file, whatever library reads them."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import laspy
import numpy as np
import pytest

from p2wss.clouds.reading import read_clouds, read_headers
from p2wss.eval import report
from p2wss.formats import cityjson_read
from p2wss.storage.messages import InputError, reading

ROOT = Path(__file__).parents[2]


def fuzz(*arguments: str) -> dict[str, dict[str, float]]:
    run = subprocess.run(
        [sys.executable, ROOT / "tests/faults/fuzz.py", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-5000:] + run.stdout
    return json.loads(run.stdout.splitlines()[-1])


def test_200_damaged_files_end_in_no_traceback() -> None:
    assert fuzz("--cases", "200")["cases"]["value"] >= 200


@pytest.mark.slow
def test_10_000_damaged_files_end_in_no_traceback() -> None:
    assert fuzz("--cases", "10000")["cases"]["value"] >= 10_000


def test_a_failed_assertion_of_a_library_in_rust_is_an_error_of_the_file() -> None:
    class PanicException(BaseException):
        pass

    with pytest.raises(InputError, match="x: not a y: z"), reading("x", "a y"):
        raise PanicException("z")
    with pytest.raises(KeyboardInterrupt), reading("x", "a y"):
        raise KeyboardInterrupt


def test_metrics_that_are_cut_off_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "m.jsonl"
    path.write_text('{"step": 1, "loss": 2}\n{"step": 2, "lo', encoding="utf-8")
    with pytest.raises(InputError, match=r"line 2"):
        report.read_training(path)


def test_a_header_with_4_billion_records_takes_no_time(tmp_path: Path) -> None:
    cloud = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    cloud.x, cloud.y, cloud.z = np.zeros((3, 5))
    for name in ("a.las", "a.laz"):
        path = tmp_path / name
        cloud.write(path)
        content = bytearray(path.read_bytes())
        struct.pack_into("<I", content, 100, 4_000_000_000)
        path.write_bytes(content)
        start = time.perf_counter()
        for read in (read_headers, read_clouds):
            with pytest.raises(InputError, match="4000000000 variable length records"):
                read([path])
        assert time.perf_counter() - start < 5


@pytest.mark.parametrize(
    "change",
    [
        {"CityObjects": []},
        {"vertices": [[0, 0]]},
        {"transform": {"scale": "x"}},
        {"CityObjects": {"a": {"type": "Building", "geometry": [{"type": "Solid", "lod": "2.2"}]}}},
        {"CityObjects": {"a": {"type": "Building", "geometry": [
            {"type": "Solid", "lod": "2.2", "boundaries": [[[[0, 1, 99]]]]}]}}},
    ],
)  # fmt: skip
def test_cityjson_of_another_structure_is_one_line(change: dict, tmp_path: Path) -> None:
    path = tmp_path / "a.city.json"
    whole = {"type": "CityJSON", "version": "2.0", "CityObjects": {}, "vertices": [[0, 0, 0]] * 3}
    path.write_text(json.dumps(whole | change), encoding="utf-8")
    with pytest.raises(InputError, match=r"a\.city\.json: not CityJSON"):
        cityjson_read.read(path)
        list(cityjson_read.shells(path))


def test_text_is_utf_8_in_any_locale(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("eval: {attribution: ['© IGN, été']}\n", encoding="utf-8")
    # in ASCII: Python itself decodes the command line by the locale
    code = r"""
from pathlib import Path
from p2wss.config import load
from p2wss.storage import files
text = load("c.yaml").eval.attribution[0]
files.write_text("c.txt", text)
assert Path("c.txt").read_text(encoding="utf-8") == text == "\xa9 IGN, \xe9t\xe9"
"""
    environment = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LANG": "C"}
    run = subprocess.run(
        [sys.executable, "-X", "utf8=0", "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "c.txt").read_bytes() == "© IGN, été".encode()
