"""Checksums inside files, which reveal files that differ from what was written.

A file of p2wss holds the text ``p2wss-sha256:`` and 64 hexadecimal digits, the SHA-256 of the whole file with zeros in
place of those digits. So the checksum covers headers, metadata and content of any format, and needs no file beside it.
It is stored where readers of the format ignore it: in the metadata of Parquet and safetensors, in the key ``checksum``
of JSON, and else in a last line that follows the content (LAZ, TIFF, GeoPackage, PNG, arrays, checkpoints and tables).

A file without a checksum was not written by p2wss, and is read without verification.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import re
from pathlib import Path

from p2wss.errors import InputError

PREFIX = "p2wss-sha256:"
_MARKER = PREFIX.encode()
_ZEROS = b"0" * 64
# what a writer puts into a file, where :func:`fill` writes the checksum
SLOT = (_MARKER + _ZEROS).decode()
# the same, to be written after the content of a binary file, and after the lines of a table or of a JSON text sequence
TRAILER = b"\n" + SLOT.encode() + b"\n"
TABLE_TRAILER = f"# {SLOT}\n"
JSON_LINES_TRAILER = f'{{"checksum": "{SLOT}"}}\n'
# the checksum is this near to the beginning or the end: of a large file of others, no more is searched
_REACH = 1 << 20

# which rule makes a file again, by the end of its path below the folder of results
RULES = (
    (r"resources/ign/.*/dtm/.*\.tif", "fetch_dtm"),
    (r"resources/ign/.*/lidar/.*\.laz", "fetch_lidar"),
    (r"fetch/.*footprints\.gpkg", "fetch_footprints"),
    (r"fetch/lidar/.*\.laz", "prepare_lidar"),
    (r"scenes/index\.tsv", "index_scenes"),
    (r"scenes/.*\.(parquet|tif)", "cut_scene"),
    (r"buildings/.*\.parquet", "build_roofs"),
    (r"scans/.*\.(laz|json|png)", "cast_scan"),
    (r"crops/simulated/.*\.parquet", "crop_simulated"),
    (r"crops/real/.*\.parquet", "crop_real"),
    (r"crops/manifest\.json", "crops"),
    (r"dvae/(model\.safetensors|metrics\.jsonl)", "dvae"),
    (r"model/(model\.safetensors|metrics\.jsonl)", "model"),
    (r"ablation/.*/(model\.safetensors|metrics\.jsonl)", "ablation_model"),
    (r"eval/medians\.json", "medians"),
    (r"eval/recording\.parquet", "recording"),
    (r"eval/parts/\d+/(point2wss\.parquet|masked_errors\.json|cpu/point2wss\.json)", "predict"),
    (r"eval/parts/\d+/(cpu/)?(point2wss\+)?fit\.(parquet|json)", "fit"),
    (r"eval/parts/\d+/(measures\.parquet|variant_errors\.json)", "measure"),
    (r"eval/parts/\d+/(cpu/)?\w+\.(parquet|json)", "baseline"),
    (r"eval/(measures\.parquet|parameters\.json|methods\.json)", "merge"),
    (r"reconstruct/.*", "reconstruct_tile"),
)

# files that this process has verified, by path, inode, size and time: each is read once for it
_verified: set[tuple[str, int, int, int]] = set()


def fill(path: str | Path) -> None:
    """Write the checksum into the slot of a file; a file without :data:`SLOT` is left as it is."""
    with open(path, "r+b") as file:
        place = _find(file.fileno(), SLOT.encode())
        if place is not None:
            file.seek(place + len(_MARKER))
            file.write(_digest(file.fileno(), place).encode())


def seal(path: str | Path) -> None:
    """Add the checksum as a last line to a file that is complete."""
    append(path)
    fill(path)


def append(path: str | Path) -> None:
    """Add a last line with a slot to a file that is to be filled. A file that has a checksum is left as it is."""
    if not has_checksum(path):
        with open(path, "ab") as file:
            file.write(TRAILER)


def has_checksum(path: str | Path) -> bool:
    """Whether the file states its checksum, right or wrong."""
    with open(path, "rb") as file:
        return _find(file.fileno(), _MARKER) is not None


def is_intact(path: str | Path) -> bool | None:
    """Whether a file is what was written; None for one that does not state its checksum. Raises OSError."""
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


def require_checksum(text: str, path: str | Path) -> None:
    """Raise :class:`InputError` if the value in place of a checksum is not one: the file was then not verified."""
    if not text.startswith(PREFIX):
        raise InputError(_damaged(path))


def lines_of(content: bytes, name: str | Path) -> list[str]:
    """The lines of a text file of ours, without that with the checksum; name: of the file, for the message.

    Raises :class:`InputError` if the file is damaged.
    """
    place = content.rfind(_MARKER)
    if place >= 0:
        start = place + len(_MARKER)
        stated, rest = content[start : start + len(_ZEROS)], content[start + len(_ZEROS) :]
        if stated != hashlib.sha256(content[:start] + _ZEROS + rest).hexdigest().encode():
            raise InputError(_damaged(name))
    try:
        lines = content.decode().splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: not text in UTF-8: {error}") from error
    if place < 0 and lines and re.search("[0-9a-f]{64}", lines[-1]):
        raise InputError(_damaged(name))  # of a checksum that cannot be recognised
    return [line for line in lines if PREFIX not in line]


def is_usable(path: Path) -> bool:
    """Whether a file of a cache exists, has a checksum and is intact."""
    try:
        return is_intact(path) is True
    except OSError:
        return False


def verify(path: str | Path) -> None:
    """Raise :class:`InputError`, which says how to make it again, for a damaged file. A missing file is ignored."""
    try:
        intact = is_intact(path)
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"{path}: not readable: {error.strerror or error}") from error
    if intact is False:
        raise InputError(_damaged(path))


def remedy(path: str | Path) -> str:
    """The instruction that makes a file again."""
    rule = rule_of(path)
    return f"make it again (snakemake -R {rule} ..)" if rule else "make or copy it again"


def _damaged(path: str | Path) -> str:
    return (
        f"{path}: damaged or changed: its content does not have the checksum that it states; {remedy(path)}"
    )


def rule_of(path: str | Path) -> str | None:
    """The rule of the workflow that writes a file; None if no rule writes to its path."""
    name = Path(os.path.abspath(path)).as_posix()
    # folders above the results may have the name of a stage too: the shortest end of the path counts
    matches = []
    for number, (pattern, rule) in enumerate(RULES):
        starts = [
            match.start() for match in re.finditer("/", name) if re.fullmatch(pattern, name[match.end() :])
        ]
        matches += [(starts[-1], -number, rule)] if starts else []
    return max(matches)[2] if matches else None


def _find(descriptor: int, text: bytes) -> int | None:
    """Where ``text``, which is part of a slot, stands in a file: its last place at the end, else its first."""
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
