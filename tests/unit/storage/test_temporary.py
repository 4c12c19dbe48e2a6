"""Temporary files of killed processes are removed; those of living ones are not."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from p2wss.storage import files, temporary

WRITER = """
import sys, time
from p2wss.storage import files
with files.atomic(sys.argv[1]) as path:
    path.write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)
"""


def test_folders_of_killed_processes_are_removed_too(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    old = tmp_path / temporary.temporary_prefix("roofer").replace(f"-{os.getpid()}-", f"-{ended.pid}-")
    old.mkdir()
    (old / "input.laz").touch()
    with temporary.temporary_folder("roofer", tmp_path) as folder:
        assert folder.is_dir() and list(tmp_path.iterdir()) == [folder]
    assert list(tmp_path.iterdir()) == []


def test_files_of_killed_processes_are_removed_and_others_stay(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITER]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    writers = [
        subprocess.Popen([*command, tmp_path / f"{n}.laz"], stdout=subprocess.PIPE, env=environment)
        for n in "12"
    ]
    try:
        for writer in writers:
            assert writer.stdout is not None and writer.stdout.readline() == b"writing\n"
        # one that has written nothing for a day still runs
        for path in tmp_path.iterdir():
            os.utime(path, (time.time() - 90_000,) * 2)
        writers[0].kill()
        writers[0].wait()
        assert len(list(tmp_path.glob(".*.laz"))) == 2
        (tmp_path / ".other-a1b2c3d4.laz").touch()
        files.write_json(tmp_path / "x.json", {})
        names = [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]
        assert len(names) == 2 and ".other-a1b2c3d4.laz" in names
        assert any(name.startswith(".2~") for name in names)
    finally:
        for writer in writers:
            writer.kill()
            writer.communicate()


def test_files_of_other_hosts_are_removed_when_they_are_old(tmp_path: Path) -> None:
    old, new = tmp_path / ".x~00000000-1-abc.laz", tmp_path / ".y~00000000-1-abc.laz"
    for path in (old, new):
        path.touch()
    os.utime(old, (time.time() - 90_000,) * 2)
    (tmp_path / ".decoding~00000000-1-abc").mkdir()
    os.utime(tmp_path / ".decoding~00000000-1-abc", (time.time() - 90_000,) * 2)
    temporary.remove_leftovers(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [new.name]
