"""Damage is noticed where a file is read, and the message says what makes the file again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import toy_crops
from file_kinds import KINDS, flip_bits

from p2wss.cli import main
from p2wss.data.manifest import read_manifest
from p2wss.storage import files, integrity
from p2wss.storage.messages import InputError
from p2wss.training.dataset import TrainingLimits, load_dataset

COLUMN = pa.schema([("x", pa.int32())])


def _flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.unlink()  # a hard link would change its source
    path.write_bytes(content)


@pytest.mark.parametrize("name", KINDS)
def test_no_flipped_bit_is_read_silently(name: str, tmp_path: Path) -> None:
    outcome = flip_bits(KINDS[name], tmp_path, 5, seed=1)
    assert (outcome.silent, outcome.traceback) == (0, 0)
    assert outcome.told >= 3


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_no_flipped_bit_of_fifty_is_read_silently(name: str, tmp_path: Path) -> None:
    outcome = flip_bits(KINDS[name], tmp_path, 50)
    assert (outcome.silent, outcome.traceback) == (0, 0)
    assert outcome.told >= 30


@pytest.mark.parametrize("name", KINDS)
def test_every_bit_of_the_checksum_itself_is_harmless(name: str, tmp_path: Path) -> None:
    """A flip there changes nothing that is read; it is an error or it is not noticed."""
    kind = KINDS[name]
    path = kind.write(tmp_path)
    content, expected = path.read_bytes(), kind.read(path)
    start = content.rfind(integrity.PREFIX.encode())
    if start < 0:
        assert name == "metrics of a training that runs"  # a checksum in each line
        return
    for place in range(start, start + len(integrity.SLOT), 7):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        _flip(path, place)
        try:
            assert kind.read(path) == expected
        except InputError as error:
            assert str(path) in str(error) or kind.remade


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if not kind.remade])
def test_the_same_content_makes_the_same_file(name: str, tmp_path: Path) -> None:
    contents = [
        KINDS[name].write(tmp_path / number).read_bytes() for number in "12" if _made(tmp_path / number)
    ]
    assert contents[0] == contents[1] and len(contents) == 2


def _made(folder: Path) -> bool:
    folder.mkdir()
    return True


def test_a_file_of_others_is_read_as_it_is(tmp_path: Path) -> None:
    pq.write_table(pa.table({"x": [1, 2]}, schema=COLUMN), tmp_path / "x.parquet")
    assert files.read_table(tmp_path / "x.parquet", COLUMN)["x"].to_pylist() == [1, 2]
    (tmp_path / "x.json").write_text('{"a": 1}')
    assert files.read_json(tmp_path / "x.json") == {"a": 1}
    (tmp_path / "empty.laz").touch()
    assert integrity.is_intact(tmp_path / "empty.laz") is None


def test_json_without_keys_has_a_checksum(tmp_path: Path) -> None:
    files.write_json(tmp_path / "x.json", {})
    assert integrity.is_intact(tmp_path / "x.json") and files.read_json(tmp_path / "x.json") == {}


def test_parquet_pages_have_checksums_of_their_own(tmp_path: Path) -> None:
    """Other readers find damage too."""
    files.write_table(tmp_path / "x.parquet", {"x": list(range(1000))}, COLUMN, {})
    _flip(tmp_path / "x.parquet", 200)
    with pytest.raises(OSError, match="CRC checksum"):
        pq.read_table(tmp_path / "x.parquet", page_checksum_verification=True)


def test_another_shard_in_place_of_one_is_refused(tmp_path: Path) -> None:
    manifest = toy_crops.make(tmp_path / "a", {"train": 3})
    other = toy_crops.make(tmp_path / "b", {"train": 3}, seed=1)
    shard = manifest.with_name("0001_0001.parquet")
    shutil.copy(other.with_name(shard.name), shard)
    assert integrity.is_intact(shard)
    with pytest.raises(
        InputError, match=r"0001_0001\.parquet: not the file that the manifest lists.*-R crops "
    ):
        load_dataset(manifest, ["train"], TrainingLimits(1, 12, 100.0), labelled=True)


def test_a_manifest_from_which_a_shard_was_dropped_is_refused(tmp_path: Path) -> None:
    manifest = toy_crops.make(tmp_path / "crops", {"train": 3}, lidar=2)
    content = json.loads(manifest.read_text())
    del content["shards"][1]
    manifest.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"manifest\.json: damaged or changed.*delete it and make it again"):
        read_manifest(manifest)


def test_inspect_verifies_files_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    manifest = toy_crops.make(tmp_path / "crops", {"train": 3})
    shard = manifest.with_name("0001_0001.parquet")
    assert main(["inspect", "--verify", str(shard), str(manifest)]) == 0
    assert capsys.readouterr().out.count(": intact\n") == 2
    _flip(shard, 500)
    assert main(["inspect", "--verify", str(shard)]) == 2
    assert "damaged or changed" in capsys.readouterr().out
    assert main(["inspect", "--verify", "--json", str(manifest)]) == 2, "it lists the damaged shard"
    assert "0001_0001.parquet: damaged" in json.loads(capsys.readouterr().out)["checksum"]
    (tmp_path / "mine.json").write_text("{}")
    assert main(["inspect", "--verify", str(tmp_path / "mine.json")]) == 2
    assert "none stated" in capsys.readouterr().out
    assert main(["inspect", "--verify", str(tmp_path / "absent.json")]) == 2
