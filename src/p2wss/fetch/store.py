"""A store of downloaded responses, each with a record of its request, so that nothing is requested twice."""

from __future__ import annotations

import hashlib
import json
import logging
from datetime import UTC, datetime
from pathlib import Path

from p2wss.storage import files

log = logging.getLogger(__name__)
Request = dict[str, str]


class Store:
    """A folder of responses. Beside each, ``<name>.json`` records the request, size, SHA-256 and time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, kind: str, request: Request, suffix: str) -> Path:
        """Where the response to ``request`` is stored; kind: name of the subfolder."""
        digest = hashlib.blake2b(json.dumps(request, sort_keys=True).encode(), digest_size=8).hexdigest()
        return self.folder / kind / f"{digest}{suffix}"

    def holds(self, path: Path, request: Request) -> bool:
        """Whether ``path`` is the complete response to ``request``, by its record; a damaged one is removed."""
        if not path.is_file():
            return False
        try:
            record = json.loads(_record_path(path).read_text())
        except (OSError, ValueError):
            return False
        if record.get("request") != request:
            return False
        if path.stat().st_size == record["num_bytes"] and files.sha256(path) == record["sha256"]:
            return True
        log.warning(f"{path}: size or checksum differs from its record; downloading it again")
        self.forget(path)
        return False

    def read(self, path: Path, request: Request) -> bytes | None:
        """The stored response to ``request``, or None."""
        return path.read_bytes() if self.holds(path, request) else None

    def write(self, path: Path, request: Request, body: bytes) -> None:
        """Store a complete response."""
        files.write_bytes(path, body)
        self.record(path, request)

    def record(self, path: Path, request: Request) -> None:
        """Record that the file ``path`` is the complete response to ``request``."""
        files.write_json(
            _record_path(path),
            {
                "request": request,
                "num_bytes": path.stat().st_size,
                "sha256": files.sha256(path),
                "retrieved": datetime.now(UTC).isoformat(timespec="seconds"),
            },
        )

    def forget(self, path: Path) -> None:
        """Delete a response and its record."""
        path.unlink(missing_ok=True)
        _record_path(path).unlink(missing_ok=True)


def _record_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")
