"""The source files of this package, each found and read once in a process."""

import os
from functools import cache
from hashlib import blake2b
from pathlib import Path

PACKAGE = "p2wss"
ROOT = Path(__file__).resolve().parents[1]


@cache
def modules() -> dict[str, Path]:
    """The file of each module and package, by its full name."""
    found = {}
    for folder, folders, files in os.walk(ROOT):
        folders[:] = [each for each in folders if each != "__pycache__"]
        package = ".".join((PACKAGE, *Path(folder).relative_to(ROOT).parts))
        for file in files:
            if file.endswith(".py"):
                name = package if file == "__init__.py" else f"{package}.{file.removesuffix('.py')}"
                found[name] = Path(folder, file)
    return found


@cache
def digest(path: Path) -> bytes:
    """A digest of the bytes of a file."""
    return blake2b(path.read_bytes(), digest_size=16).digest()
