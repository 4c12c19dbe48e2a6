"""Requests with manners: slow enough, patient with a busy service, and never fooled by half an answer."""

from __future__ import annotations

import errno
import logging
import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import TypeVar

import requests
import tenacity

from p2wss.config import Geoplateforme
from p2wss.errors import InputError

log = logging.getLogger(__name__)
_BUSY = {408, 425, 429, 500, 502, 503, 504}
_GONE = {404, 410}
_LONGEST_PAUSE_S = 60.0
_CHUNK_BYTES = 1 << 18
_PROGRESS_BYTES = 50_000_000
_QUOTE_CHARACTERS = 200
Result = TypeVar("Result")


class Transient(Exception):
    """A failure that may be gone at the next attempt. retry_after_s: how long the service asked to wait."""

    def __init__(self, reason: str, retry_after_s: float | None = None) -> None:
        super().__init__(reason)
        self.retry_after_s = retry_after_s


class Gone(InputError):
    """The service answered that there is nothing at this address: HTTP 404 or 410."""


class NoRanges(InputError):
    """The service sends whole files only."""


class Client:
    """HTTP GET within the limits of the config: requests per second, attempts, time per answer and in all."""

    def __init__(self, config: Geoplateforme, sleep: Callable[[float], None] = time.sleep) -> None:
        self.config = config
        self.session = requests.Session()
        self.session.headers["User-Agent"] = config.user_agent
        self._sleep = sleep
        self._next_request = 0.0

    def get(self, url: str, params: dict[str, str] | None = None) -> bytes:
        """The whole body. Raises :class:`InputError` with the address and what the service said."""

        def attempt(deadline: float) -> bytes:
            with self._answer(url, params or {}, {}) as response:
                return b"".join(_body(response, deadline))

        return self._patiently(url, attempt)

    def range(self, url: str, start: int, end: int) -> tuple[bytes, int]:
        """Bytes ``start`` to ``end`` (exclusive, or where the file ends), and the size of the whole file.

        Raises :class:`NoRanges` if the service does not send parts of files.
        """

        def attempt(deadline: float) -> tuple[bytes, int]:
            with self._answer(url, {}, {"Range": f"bytes={start}-{end - 1}"}) as response:
                if response.status_code != 206 or _range_start(response) != start:
                    raise NoRanges(f"{url}: does not send parts of files (HTTP {response.status_code})")
                body = b"".join(_body(response, deadline))
                size = int(response.headers["Content-Range"].rpartition("/")[2])
            if len(body) != min(end, size) - start:
                raise Transient(f"{len(body)} bytes instead of {min(end, size) - start}")
            return body, size

        return self._patiently(url, attempt)

    def download(self, url: str, path: Path, magic: bytes) -> None:
        """A large file into ``path``, which appears once it is whole; it must begin with ``magic``.

        What has come so far stays beside it in ``<name>.part``; the next attempt, or the next run, asks for
        the rest with a Range request, and begins anew if the service answers with the whole.
        """
        part = path.with_name(f"{path.name}.part")
        path.parent.mkdir(parents=True, exist_ok=True)

        def attempt(deadline: float) -> None:
            have = part.stat().st_size if part.exists() else 0
            with self._answer(url, {}, {"Range": f"bytes={have}-"} if have else {}) as response:
                resumed = response.status_code == 206 and _range_start(response) == have
                if response.status_code == 416 or (response.status_code == 206 and not resumed):
                    part.unlink(missing_ok=True)
                    raise Transient("the service has no such range")
                total = _length(response)
                if resumed and total is not None:
                    total += have
                come = have if resumed else 0
                with part.open("ab" if resumed else "wb") as file:
                    for chunk in _body(response, deadline):
                        file.write(chunk)
                        if (come + len(chunk)) // _PROGRESS_BYTES > come // _PROGRESS_BYTES:
                            of = f" of {total / 1e6:.0f}" if total else ""
                            log.info(f"{path.name}: {(come + len(chunk)) / 1e6:.0f}{of} MB")
                        come += len(chunk)
            size = part.stat().st_size
            with part.open("rb") as file:
                head = file.read(_QUOTE_CHARACTERS)
            if not head.startswith(magic):
                part.unlink()
                raise InputError(f"{url}: expected a file that begins with {magic!r}, got {quote(head)}")
            if total is not None and size < total:
                raise Transient(f"{size} of {total} bytes")
            if total is not None and size > total:
                part.unlink()
                raise Transient(f"{size} bytes instead of {total}")
            part.replace(path)

        try:
            self._patiently(url, attempt)
        except OSError as error:
            if error.errno == errno.ENOSPC:
                part.unlink(missing_ok=True)
            raise InputError(f"{path}: not written: {error.strerror or error}") from error

    def _patiently(self, url: str, attempt: Callable[[float], Result]) -> Result:
        deadline = time.monotonic() + self.config.max_wait_s
        retrying = tenacity.Retrying(
            retry=tenacity.retry_if_exception_type(Transient),
            stop=tenacity.stop_after_attempt(self.config.max_attempts)
            | tenacity.stop_before_delay(self.config.max_wait_s),
            wait=_pause_s,
            sleep=self._sleep,
            before_sleep=lambda state: log.warning(
                f"{url}: {_exception(state)}; attempt {state.attempt_number}"
            ),
            reraise=True,
        )
        try:
            return retrying(attempt, deadline)
        except Transient as error:
            raise InputError(
                f"{url}: {error}, after {retrying.statistics.get('attempt_number', 1)} attempts; "
                "try again later, or set fetch.source: folder and use files that you have"
            ) from error

    @contextmanager
    def _answer(
        self, url: str, params: dict[str, str], headers: dict[str, str]
    ) -> Iterator[requests.Response]:
        """A streamed answer with a good status; a busy service or a broken connection becomes Transient."""
        pause = self._next_request - time.monotonic()
        if pause > 0:
            self._sleep(pause)
        self._next_request = time.monotonic() + 1 / self.config.requests_per_s
        try:
            with self.session.get(
                url, params=params, headers=headers, timeout=self.config.timeout_s, stream=True
            ) as response:
                if response.status_code in _BUSY:
                    raise Transient(f"HTTP {response.status_code}", _retry_after_s(response))
                if response.status_code >= 400 and response.status_code != 416:
                    kind = Gone if response.status_code in _GONE else InputError
                    raise kind(
                        f"{response.url}: HTTP {response.status_code} {response.reason}: "
                        f"{quote(response.content)}"
                    )
                yield response
        except requests.RequestException as error:
            raise Transient(
                f"{type(error).__name__}: {' '.join(str(error).split())[:_QUOTE_CHARACTERS]}"
            ) from error


def quote(body: bytes) -> str:
    """The beginning of an answer, for a message."""
    text = " ".join(body[: 10 * _QUOTE_CHARACTERS].decode("utf-8", "replace").split())
    return f'"{text[:_QUOTE_CHARACTERS]}"' if text else "nothing"


def _body(response: requests.Response, deadline: float) -> Iterator[bytes]:
    for chunk in response.iter_content(_CHUNK_BYTES):
        if time.monotonic() > deadline:
            raise Transient("the answer came too slowly (fetch.geoplateforme.max_wait_s)")
        yield chunk


def _retry_after_s(response: requests.Response) -> float | None:
    value = response.headers.get("Retry-After", "")
    try:
        return max(0.0, float(value))
    except ValueError:  # absent, or a date
        pass
    try:
        return max(0.0, (parsedate_to_datetime(value) - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError):
        return None


def _range_start(response: requests.Response) -> int | None:
    try:
        return int(response.headers["Content-Range"].removeprefix("bytes ").split("-")[0])
    except (KeyError, ValueError):
        return None


def _length(response: requests.Response) -> int | None:
    length = response.headers.get("Content-Length", "")
    return int(length) if length.isdigit() else None


def _exception(state: tenacity.RetryCallState) -> BaseException | None:
    return state.outcome.exception() if state.outcome else None


def _pause_s(state: tenacity.RetryCallState) -> float:
    error = _exception(state)
    if isinstance(error, Transient) and error.retry_after_s is not None:
        return error.retry_after_s
    # half of it at random, so that jobs that failed together do not come back together
    return min(_LONGEST_PAUSE_S, 2.0**state.attempt_number) * random.uniform(0.5, 1.0)
