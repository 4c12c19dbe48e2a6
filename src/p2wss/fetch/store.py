"""What a service sent, kept beside the vintage with a record of what was asked: none of it is asked for twice."""

from __future__ import annotations

import hashlib
import json
import logging
from datetime import UTC, datetime
from pathlib import Path

from p2wss.data import files

log = logging.getLogger(__name__)
Request = dict[str, str]


class Store:
    """A folder of answers. Beside each stands ``<name>.json``: the request, size, SHA-256 and time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, kind: str, request: Request, suffix: str) -> Path:
        """Where the answer to ``request`` belongs; kind: names its subfolder."""
        digest = hashlib.blake2b(json.dumps(request, sort_keys=True).encode(), digest_size=8).hexdigest()
        return self.folder / kind / f"{digest}{suffix}"

    def holds(self, path: Path, request: Request) -> bool:
        """Whether ``path`` is the whole answer to ``request``, by its record; a damaged one is removed."""
        record = _record(path)
        if not path.is_file():
            return False
        try:
            known = json.loads(record.read_text())
        except (OSError, ValueError):
            return False
        if known.get("request") != request:
            return False
        if path.stat().st_size == known["num_bytes"] and files.sha256(path) == known["sha256"]:
            return True
        log.warning(f"{path}: is not what its record says; it is fetched again")
        self.forget(path)
        return False

    def read(self, path: Path, request: Request) -> bytes | None:
        return path.read_bytes() if self.holds(path, request) else None

    def write(self, path: Path, request: Request, body: bytes) -> None:
        files.write_bytes(path, body)
        self.record(path, request)

    def record(self, path: Path, request: Request) -> None:
        """Declare the file ``path`` whole."""
        files.write_json(
            _record(path),
            {
                "request": request,
                "num_bytes": path.stat().st_size,
                "sha256": files.sha256(path),
                "retrieved": datetime.now(UTC).isoformat(timespec="seconds"),
            },
        )

    def forget(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        _record(path).unlink(missing_ok=True)


def _record(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")
