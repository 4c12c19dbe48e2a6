"""Unpack RGE ALTI as IGN delivers it: grids in 7z archives, which may be split into parts of 4 GB."""

from __future__ import annotations

import hashlib
import lzma
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

import multivolumefile
import py7zr

from p2wss.data.tiling import Bounds
from p2wss.errors import InputError
from p2wss.fetch.listing import with_companions
from p2wss.storage import files
from p2wss.storage.temporary import temporary_folder

# a grid of 1 km² in text has 8 MB, one of 25 km² in cells of 1 m 200 MB
_MAX_GRID_BYTES = 1_000_000_000
_HALF_CELL_M = 2.5  # of the larger cells
_BROKEN = (py7zr.exceptions.ArchiveError, lzma.LZMAError, EOFError, OSError, ValueError, KeyError)
_CORNER = re.compile(r"_(\d{4})_(\d{4})_.*\.asc$", re.IGNORECASE)


def is_archive(path: Path) -> bool:
    """Whether ``path`` is a 7z archive, or the first part of a split one."""
    return path.name.lower().endswith((".7z", ".7z.001"))


def unpacked_folder(archive: Path, folder: Path) -> Path:
    """The folder below ``folder`` for the grids of an archive.

    Its name ends in a digest of the sizes and times of the archive's parts: an archive that replaces another under the
    same name is unpacked again.
    """
    state = [(part.name, part.stat().st_size, part.stat().st_mtime_ns) for part in with_companions(archive)]
    digest = hashlib.blake2b(repr(state).encode(), digest_size=4).hexdigest()
    return folder / f"{archive.name.split('.7z')[0]}-{digest}"


def unpack(archive: Path, bounds: Bounds, folder: Path) -> list[Path]:
    """Unpack the grids of an archive that may intersect ``bounds`` into ``folder``, unless they are there already.

    The names of the grids give their location: the kilometres of the north-west corner. Returns their paths.

    Raises :class:`InputError` if the archive is broken, incomplete or needs a password.
    """
    with _content(archive) as content:
        grids = {
            member.filename: folder / Path(member.filename).name
            for member in content.list()
            if _intersects(member.filename, f"{archive.name}/{member.filename}", bounds)
        }
        for member in content.list():
            if member.filename in grids and member.uncompressed > _MAX_GRID_BYTES:
                size = f"{member.uncompressed / 1e9:.1f} GB"
                raise InputError(f"{archive}: {member.filename} would unpack to {size}, too large for a grid")
        missing = [name for name, path in grids.items() if not path.is_file()]
        if missing:
            folder.mkdir(parents=True, exist_ok=True)
            with temporary_folder("unpacking", folder) as work:
                content.extract(work, targets=missing)
                for name in missing:
                    with files.atomic(grids[name]) as temporary:
                        os.replace(Path(work, name), temporary)
    return sorted(grids.values())


def members(archive: Path) -> list[str]:
    """The names of the files in an archive. Raises :class:`InputError` if the archive is broken or incomplete."""
    with _content(archive) as content:
        return content.getnames()


@contextmanager
def _content(archive: Path) -> Iterator[py7zr.SevenZipFile]:
    """The content of an archive. Any failure to read it is an :class:`InputError`."""
    try:
        with _open(archive) as file, py7zr.SevenZipFile(file, "r") as content:
            yield content
    except InputError:
        raise
    except py7zr.exceptions.PasswordRequired as error:
        raise InputError(
            f"{archive}: is password-protected; unpack it and name the folder instead"
        ) from error
    except _BROKEN as error:
        parts = "; are all of its parts in the folder?" if archive.suffix == ".001" else ""
        raise InputError(f"{archive}: not a readable 7z archive, or truncated: {error}{parts}") from error


def _open(archive: Path) -> IO[bytes]:
    if archive.suffix == ".001":
        return cast(IO[bytes], multivolumefile.open(archive.with_suffix(""), "rb"))
    return archive.open("rb")


def _intersects(name: str, product: str, bounds: Bounds) -> bool:
    corner = _CORNER.search(name)
    if corner is None:
        return False
    # a grid has 1000 x 1000 cells of 1 m or 5 m, depending on the product
    edge = 5000.0 if re.search(r"_5M_", product, re.IGNORECASE) else 1000.0
    x_min, y_max = (1000.0 * int(part) for part in corner.groups())
    # cells are centred on whole kilometres, so a grid extends by half a cell to the west and the north
    return bool(
        x_min - _HALF_CELL_M < bounds[2]
        and x_min + edge > bounds[0]
        and y_max - edge < bounds[3]
        and y_max + _HALF_CELL_M > bounds[1]
    )
