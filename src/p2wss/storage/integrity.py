"""Checksums inside files, which reveal files that differ from what was written.

A file of p2wss holds the text ``p2wss-sha256:`` and 64 hexadecimal digits, the SHA-256 of the whole file with zeros in
place of those digits. So the checksum covers headers, metadata and content of any format, and needs no file beside it.
It is stored where readers of the format ignore it: in the metadata of Parquet and safetensors, in the key ``checksum``
of JSON, and else in a last line that follows the content (LAZ, TIFF, GeoPackage, PNG, arrays, checkpoints and tables).

A file without a checksum was not written by p2wss, and is read without verification.
"""

import hashlib
import mmap
import os
from pathlib import Path

from p2wss.storage.messages import InputError, reading

PREFIX = "p2wss-sha256:"
_MARKER = PREFIX.encode()
_ZEROS = b"0" * 64
# placeholder that a writer puts into a file, and that :func:`fill` replaces by the checksum
SLOT = (_MARKER + _ZEROS).decode()
# the placeholder as a last line: after the content of a binary file, the lines of a table, a JSON text sequence
TRAILER = b"\n" + SLOT.encode() + b"\n"
TABLE_TRAILER = f"# {SLOT}\n"
JSON_LINES_TRAILER = f'{{"checksum": "{SLOT}"}}\n'
REMEDY = "delete it and make it again, as the next run of the workflow does"
# distance of the checksum from the beginning or the end of a file, bytes: no more is searched, as files of others may
# be large
_REACH = 1 << 20

# beginnings of the last line of text files, which does not belong to their content
_CHECKSUM_LINES = ("# ", '{"checksum": ')

# files that this process has verified, by path, inode, size and time, so that each is read for it only once
_verified: set[tuple[str, int, int, int]] = set()


def fill(path: str | Path) -> None:
    """Write the checksum into the slot of a file; a file without :data:`SLOT` is left as it is."""
    with open(path, "r+b") as file:
        place = _find(file.fileno(), SLOT.encode())
        if place is not None:
            file.seek(place + len(_MARKER))
            file.write(_digest(file.fileno(), place).encode())


def append(path: str | Path) -> None:
    """Add a slot as the last line of a file that is yet to be filled. A file that has a checksum is left as it is."""
    if not has_checksum(path):
        with open(path, "ab") as file:
            file.write(TRAILER)


def has_checksum(path: str | Path) -> bool:
    """Whether the file states its checksum, right or wrong."""
    with open(path, "rb") as file:
        return _find(file.fileno(), _MARKER) is not None


def is_intact(path: str | Path) -> bool | None:
    """Whether a file is as it was written; None if it does not state its checksum. Raises OSError."""
    with open(path, "rb") as file:
        place = _find(file.fileno(), _MARKER)
        if place is None:
            return None
        status = os.fstat(file.fileno())
        key = (str(path), status.st_ino, status.st_size, status.st_mtime_ns)
        if key in _verified:
            return True
        stated = os.pread(file.fileno(), len(_ZEROS), place + len(_MARKER))
        if stated != _digest(file.fileno(), place).encode():
            return False
        _verified.add(key)
        return True


def read_lines(path: str | Path) -> list[str]:
    """The lines of a text file of p2wss, without its checksum. Raises :class:`InputError` if it is damaged."""
    verify(path)
    with reading(path, "UTF-8 text"):
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if not line.startswith(_CHECKSUM_LINES)]


def is_usable(path: Path) -> bool:
    """Whether a file of a cache exists, has a checksum and is intact."""
    try:
        return is_intact(path) is True
    except OSError:
        return False


def verify(path: str | Path) -> None:
    """Raise :class:`InputError` for a damaged file. A missing file is ignored."""
    try:
        intact = is_intact(path)
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"{path}: not readable: {error.strerror or error}") from error
    if intact is False:
        raise InputError(
            f"{path}: damaged or changed: its content does not have the checksum that it states; {REMEDY}"
        )


def _find(descriptor: int, text: bytes) -> int | None:
    """Offset of ``text``, a part of a slot: its last occurrence in the last MiB, else its first one in the first MiB;
    None without one."""
    size = os.fstat(descriptor).st_size
    first = max(size - _REACH, 0)
    place = os.pread(descriptor, _REACH, first).rfind(text)
    if place >= 0:
        place += first
    elif first:
        place = os.pread(descriptor, _REACH, 0).find(text)
    return place if 0 <= place <= size - len(SLOT) else None


def _digest(descriptor: int, place: int) -> str:
    """SHA-256 of a file, with zeros in the slot at ``place``."""
    with mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ) as content, memoryview(content) as view:
        start = place + len(_MARKER)
        digest = hashlib.sha256(view[:start])
        digest.update(_ZEROS)
        digest.update(view[start + len(_ZEROS) :])
    return digest.hexdigest()
