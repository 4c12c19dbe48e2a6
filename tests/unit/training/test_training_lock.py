"""Two trainings in one folder: the second is refused, and what a killed one left is taken over."""

from __future__ import annotations

import inspect
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

from p2wss.storage.messages import InputError
from p2wss.storage.temporary import Scratch
from p2wss.training.loop import training_lock

HOLDER = """
import sys, time
from pathlib import Path
from p2wss.training.loop import training_lock
with training_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_second_training_is_refused_and_a_killed_one_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, folder], stdout=subprocess.PIPE, env=environment
    ) as holder:
        try:
            assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
            with (
                pytest.raises(InputError, match="another training runs in this folder"),
                training_lock(folder, patience_s=0),
            ):
                pass
        finally:
            holder.send_signal(signal.SIGKILL)
            holder.wait()
    assert (tmp_path / "checkpoints.lock").exists()
    with training_lock(folder):
        folder.mkdir()
        (folder / "step-00000001.pt").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["checkpoints", "step-00000001.pt"]


def test_a_training_waits_for_one_that_is_about_to_stop(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", HOLDER.replace("60", "1"), tmp_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
        with caplog.at_level("INFO", "p2wss"), training_lock(tmp_path):
            pass
    assert holder.returncode == 0
    assert [record.getMessage() for record in caplog.records if "waiting" in record.getMessage()]


def test_a_folder_with_files_of_others_stays(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    with training_lock(folder):
        folder.mkdir()
        (folder / "of.another").touch()
    assert [path.name for path in folder.iterdir()] == ["of.another"]
    (folder / "of.another").unlink()
    with training_lock(folder):
        pass
    assert not folder.exists()


def test_no_file_is_unpickled() -> None:
    for path in (ROOT / "src").rglob("*.py"):
        for call in re.findall(r"\b(?:torch\.load|np\.load)\([^\n]*", path.read_text()):
            assert "weights_only=True" in call or ("np.load" in call and "allow_pickle" not in call), path
        imports_pickle = re.search(
            r"^\s*(import|from) (pickle|dill|joblib|cloudpickle)", path.read_text(), re.M
        )
        # values that a process keeps for itself, in a file without a name that no other process can open
        assert not imports_pickle or path.name in ("spool.py", "processes.py"), path
    for name, place in (("spool", "*self._place[index]"), ("processes", "place, size")):
        text = (ROOT / f"src/p2wss/reconstruction/running/{name}.py").read_text()
        assert re.findall(r"pickle\.load\w*\(.*", text) == [
            f"pickle.loads(self._scratch.read({place}))  # nosec B301"
        ]
    assert "TemporaryFile(" in inspect.getsource(Scratch) and "Named" not in inspect.getsource(Scratch)
