"""The mark of ``p2wss warm-up``; apart, so that it is found at once."""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

import numba
from llvmlite.binding import get_host_cpu_name

from p2wss.skeleton.compiled import cache_folder


def marker(with_scans: bool) -> Path | None:
    """The file beside the cached code that exists once all of these sources are compiled; None without a cache."""
    folder = cache_folder()
    if folder is None:
        return None
    digest = hashlib.blake2b(digest_size=6)
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    computer = platform.python_version(), numba.__version__, get_host_cpu_name()
    digest.update(repr((computer, with_scans)).encode())
    return folder / f"warm-up.{digest.hexdigest()}"
