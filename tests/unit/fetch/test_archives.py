"""RGE ALTI in 7z archives, complete and split, as IGN delivers it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import py7zr
import pytest
from places import MINI

from p2wss.config import Folder
from p2wss.errors import InputError
from p2wss.fetch import archives
from p2wss.fetch.archives import members, unpack
from p2wss.fetch.folder import FolderSource

GRIDS = MINI / "rgealti"
INSIDE = (
    "RGEALTI_2-0_{0}M_ASC_LAMB93-IGN69_D078/RGEALTI/1_DONNEES_LIVRAISON_2023-09-00001/RGEALTI_MNT_{0}M_ASC"
)
WINDOW = (652100.0, 6860100.0, 652900.0, 6860900.0)  # within 0652_6861


def pack(path: Path, product: int = 1, part_bytes: int | None = None) -> Path:
    """The miniature's grids in an archive; part_bytes: size of its parts, as with ``split -b``."""
    whole = path.with_name("whole.7z")
    with py7zr.SevenZipFile(whole, "w") as archive:
        for grid in sorted(GRIDS.glob("*.asc")):
            archive.write(grid, f"{INSIDE.format(product)}/{grid.name}")
        archive.writestr(b"read me", f"{INSIDE.format(product)}/LISEZMOI.txt")
    if part_bytes is None:
        return whole.rename(path)
    body = whole.read_bytes()
    whole.unlink()
    for number, start in enumerate(range(0, len(body), part_bytes), 1):
        path.with_name(f"{path.name}.{number:03}").write_bytes(body[start : start + part_bytes])
    return path.with_name(f"{path.name}.001")


@pytest.mark.parametrize("part_bytes", [None, 40_000])
def test_only_grids_in_the_window_are_unpacked_and_only_once(tmp_path, part_bytes, monkeypatch):
    archive = pack(tmp_path / "RGEALTI_D078.7z", part_bytes=part_bytes)
    assert len(list(tmp_path.iterdir())) == (1 if part_bytes is None else 3)
    grids = unpack(archive, WINDOW, tmp_path / "grids")
    assert [path.name for path in grids] == ["RGEALTI_FXX_0652_6861_MNT_LAMB93_IGN69.asc"]
    assert grids[0].read_bytes() == (GRIDS / grids[0].name).read_bytes()
    assert list((tmp_path / "grids").iterdir()) == grids
    monkeypatch.setattr(py7zr.SevenZipFile, "extract", lambda *a, **k: pytest.fail("unpacked again"))
    assert unpack(archive, WINDOW, tmp_path / "grids") == grids


def test_an_archive_that_replaces_another_is_unpacked_anew(tmp_path):
    (tmp_path / "in").mkdir()
    archive = pack(tmp_path / "in" / "RGEALTI.7z")
    source = FolderSource(Folder(dtm=str(tmp_path / "in")), "EPSG:2154", tmp_path / "out")
    before = source.dtm(WINDOW).height_m
    raised = tmp_path / "raised"
    raised.mkdir()
    for grid in GRIDS.glob("*.asc"):
        header, rows = grid.read_text().split("\n", 6)[:6], np.loadtxt(grid, skiprows=6)
        np.savetxt(raised / grid.name, rows + 100, "%.2f", header="\n".join(header), comments="")
    with py7zr.SevenZipFile(archive, "w") as content:
        for grid in sorted(raised.iterdir()):
            content.write(grid, f"{INSIDE.format(1)}/{grid.name}")
    assert np.allclose(source.dtm(WINDOW).height_m, before + 100)


def test_an_archive_with_a_password_is_one_clear_line(tmp_path):
    archive = tmp_path / "a.7z"
    with py7zr.SevenZipFile(archive, "w", password="secret") as content:
        for grid in sorted(GRIDS.glob("*.asc")):
            content.write(grid, f"{INSIDE.format(1)}/{grid.name}")
    with pytest.raises(InputError, match=r"a\.7z: is password-protected"):
        unpack(archive, WINDOW, tmp_path / "grids")


def test_a_grid_that_would_fill_the_disk_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "_MAX_GRID_BYTES", 1000)
    with pytest.raises(InputError, match="too large for a grid"):
        unpack(pack(tmp_path / "a.7z"), WINDOW, tmp_path / "grids")
    assert not (tmp_path / "grids").exists()


def test_a_window_at_a_corner_needs_four_grids(tmp_path):
    archive = pack(tmp_path / "a.7z")
    grids = unpack(archive, (652990.0, 6860990.0, 653010.0, 6861010.0), tmp_path / "grids")
    assert len(grids) == 4


def test_grids_of_the_five_metre_product_are_five_kilometres_wide(tmp_path):
    archive = pack(tmp_path / "RGEALTI_2-0_5M_ASC.7z", product=5)
    grids = unpack(archive, (656000.0, 6857000.0, 656500.0, 6857500.0), tmp_path / "grids")
    assert {path.name[12:21] for path in grids} == {"0652_6861", "0652_6862", "0653_6861", "0653_6862"}
    assert unpack(archive, (659000.0, 6857000.0, 659500.0, 6857500.0), tmp_path / "grids") == []


@pytest.mark.parametrize("part_bytes", [None, 40_000])
def test_terrain_from_an_archive_equals_its_grids(tmp_path, part_bytes):
    (tmp_path / "in").mkdir()
    pack(tmp_path / "in" / "RGEALTI.7z", part_bytes=part_bytes)
    bounds = (652900.0, 6860900.0, 653100.0, 6861100.0)
    terrain = FolderSource(Folder(dtm=str(tmp_path / "in")), "EPSG:2154", tmp_path / "grids").dtm(bounds)
    expected = FolderSource(Folder(dtm=str(GRIDS)), "EPSG:2154", tmp_path / "none").dtm(bounds)
    np.testing.assert_array_equal(terrain.height_m, expected.height_m)
    assert len(list((tmp_path / "grids").rglob("*.asc"))) == 4


@pytest.mark.parametrize("damage", ["truncated", "part missing", "no archive"])
def test_a_broken_archive_leaves_no_files(tmp_path, damage):
    archive = pack(tmp_path / "a.7z", part_bytes=40_000)
    if damage == "truncated":
        archive.write_bytes(archive.read_bytes()[:20_000])
    elif damage == "part missing":
        sorted(tmp_path.glob("a.7z.*"))[-1].unlink()
    else:
        for part in tmp_path.glob("a.7z.*"):
            part.write_text("<html>")
    with pytest.raises(InputError, match=r"a\.7z\.001: not a readable 7z archive, or truncated"):
        unpack(archive, WINDOW, tmp_path / "grids")
    assert list(tmp_path.rglob("*.asc")) == []


def test_members(tmp_path):
    names = members(pack(tmp_path / "a.7z"))
    assert len([name for name in names if name.endswith(".asc")]) == 4
    shutil.copy(GRIDS / "RGEALTI_FXX_0652_6861_MNT_LAMB93_IGN69.asc", tmp_path / "b.7z")
    with pytest.raises(InputError, match=r"b\.7z: not a readable 7z"):
        members(tmp_path / "b.7z")
