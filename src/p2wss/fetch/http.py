"""HTTP requests that respect the service's limits, retry transient failures and detect incomplete responses."""

from __future__ import annotations

import errno
import logging
import random
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import TypeVar
from urllib.parse import urljoin, urlsplit

import requests
import tenacity

from p2wss.config import Geoplateforme
from p2wss.errors import InputError

log = logging.getLogger(__name__)
_BUSY = {408, 425, 429, 500, 502, 503, 504}
_NOT_FOUND = {404, 410}
_LONGEST_PAUSE_S = 60.0
_CHUNK_BYTES = 1 << 18
_PROGRESS_BYTES = 50_000_000
_QUOTE_CHARACTERS = 200
# parts of a file are parts of what it holds, not of a compressed form
_AS_IT_IS = {"Accept-Encoding": "identity"}
Result = TypeVar("Result")


class TransientError(Exception):
    """A failure that may not occur again. retry_after_s: the wait that the service asked for."""

    def __init__(self, reason: str, retry_after_s: float | None = None) -> None:
        super().__init__(reason)
        self.retry_after_s = retry_after_s


class NotFoundError(InputError):
    """Nothing exists at this address: the service responded with HTTP 404 or 410."""


class RangesUnsupportedError(InputError):
    """The service sends only whole files: it ignores Range requests."""


class Client:
    """HTTP GET within the limits of the config: request rate, attempts, timeout per request, total time."""

    def __init__(self, config: Geoplateforme, sleep: Callable[[float], None] = time.sleep) -> None:
        self.config = config
        self.session = _Session(config.redirect_hosts)
        self.session.headers["User-Agent"] = config.user_agent
        self._sleep = sleep
        self._next_request = 0.0

    def get(self, url: str, params: dict[str, str] | None = None) -> bytes:
        """The whole body. Raises :class:`InputError` with the address and the service's message."""

        def attempt(deadline: float) -> bytes:
            with self._response(url, params or {}, {}) as response:
                return b"".join(_body(response, deadline, self.config.max_response_mb))

        return self._with_retries(url, attempt)

    def range(self, url: str, start: int, end: int) -> tuple[bytes, int, str]:
        """Bytes ``start`` to ``end`` (exclusive, clipped to the end of the file), the size of the file, its edition.

        The edition, "" if the service states none, is another one once the file has changed.
        Raises :class:`RangesUnsupportedError` if the service sends only whole files.
        """

        def attempt(deadline: float) -> tuple[bytes, int, str]:
            headers = {"Range": f"bytes={start}-{end - 1}", **_AS_IT_IS}
            with self._response(url, {}, headers) as response:
                if response.status_code != 206 or _range_start(response) != start:
                    raise RangesUnsupportedError(
                        f"{url}: the service does not support Range requests (HTTP {response.status_code})"
                    )
                body = b"".join(_body(response, deadline, self.config.max_response_mb))
                size, edition = _size_of_file(response), _edition(response)
            if len(body) != min(end, size) - start:
                raise TransientError(f"{len(body)} bytes instead of {min(end, size) - start}")
            return body, size, edition

        return self._with_retries(url, attempt)

    def download(self, url: str, path: Path, magic: bytes) -> None:
        """Download a large file to ``path``, which appears once it is complete; it must begin with ``magic``.

        An incomplete file is kept beside it as ``<name>.part``, and as ``<name>.part.edition`` what the service calls
        this edition of it. The next attempt, or the next run, asks for the rest with a Range request, and starts
        again if the service sends the whole file or has another edition by now.
        Raises :class:`InputError` if all attempts fail, the file begins otherwise, or it cannot be written.
        """
        part = path.with_name(f"{path.name}.part")
        edition_of_part = path.with_name(f"{path.name}.part.edition")
        path.parent.mkdir(parents=True, exist_ok=True)

        def discard() -> None:
            part.unlink(missing_ok=True)
            edition_of_part.unlink(missing_ok=True)

        def attempt(deadline: float) -> None:
            start = part.stat().st_size if part.exists() else 0
            edition = _stored_edition(edition_of_part) if start else ""
            headers = {"Range": f"bytes={start}-"} if start else {}
            with self._response(
                url, {}, headers | ({"If-Range": edition} if edition else {}) | _AS_IT_IS
            ) as response:
                is_resumed = response.status_code == 206 and _range_start(response) == start
                if response.status_code == 416 or (response.status_code == 206 and not is_resumed):
                    discard()
                    raise TransientError("the service has no such range")
                if is_resumed and _edition(response) not in ("", edition):
                    discard()
                    raise TransientError("the file has changed since its beginning was downloaded")
                if not is_resumed:
                    edition_of_part.unlink(missing_ok=True)
                    if _edition(response):
                        edition_of_part.write_text(_edition(response), encoding="utf-8")
                total = _length(response)
                if is_resumed and total is not None:
                    total += start
                num_bytes = start if is_resumed else 0
                with part.open("ab" if is_resumed else "wb") as file:
                    limit_mb = self.config.max_download_mb - num_bytes / 1e6
                    for chunk in _body(response, deadline, limit_mb):
                        file.write(chunk)
                        previous, num_bytes = num_bytes, num_bytes + len(chunk)
                        if num_bytes // _PROGRESS_BYTES > previous // _PROGRESS_BYTES:
                            of_total = f" of {total / 1e6:.0f}" if total else ""
                            log.info(f"{path.name}: {num_bytes / 1e6:.0f}{of_total} MB")
            size = part.stat().st_size
            with part.open("rb") as file:
                head = file.read(_QUOTE_CHARACTERS)
            if not head.startswith(magic):
                discard()
                raise InputError(f"{url}: expected a file that begins with {magic!r}, got {quote(head)}")
            if total is not None and size < total:
                raise TransientError(f"{size} of {total} bytes")
            if total is not None and size > total:
                discard()
                raise TransientError(f"{size} bytes instead of {total}")
            part.replace(path)
            edition_of_part.unlink(missing_ok=True)

        try:
            self._with_retries(url, attempt)
        except OSError as error:
            if error.errno == errno.ENOSPC:
                discard()
            raise InputError(f"{path}: not written: {error.strerror or error}") from error

    def _with_retries(self, url: str, attempt: Callable[[float], Result]) -> Result:
        deadline = time.monotonic() + self.config.max_wait_s
        retrying = tenacity.Retrying(
            retry=tenacity.retry_if_exception_type(TransientError),
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
        except TransientError as error:
            raise InputError(
                f"{url}: {error}, after {retrying.statistics.get('attempt_number', 1)} attempts; "
                "try again later, or set fetch.source: folder and use files that you already have"
            ) from error

    @contextmanager
    def _response(
        self, url: str, params: dict[str, str], headers: dict[str, str]
    ) -> Iterator[requests.Response]:
        """A streamed response with a good status. A busy service or a broken connection: TransientError."""
        pause = self._next_request - time.monotonic()
        if pause > 0:
            self._sleep(pause)
        self._next_request = time.monotonic() + 1 / self.config.requests_per_s
        try:
            with self.session.get(
                url, params=params, headers=headers, timeout=self.config.timeout_s, stream=True
            ) as response:
                if response.status_code in _BUSY:
                    raise TransientError(f"HTTP {response.status_code}", _retry_after_s(response))
                if response.status_code >= 400 and response.status_code != 416:
                    error_type = NotFoundError if response.status_code in _NOT_FOUND else InputError
                    raise error_type(
                        f"{response.url}: HTTP {response.status_code} {response.reason}: "
                        f"{quote(response.content)}"
                    )
                yield response
        except requests.exceptions.SSLError as error:
            raise InputError(
                f"{url}: its TLS certificate cannot be verified: {' '.join(str(error).split())[:_QUOTE_CHARACTERS]}"
            ) from error
        except requests.RequestException as error:
            raise TransientError(
                f"{type(error).__name__}: {' '.join(str(error).split())[:_QUOTE_CHARACTERS]}"
            ) from error


class _Session(requests.Session):
    """A session that follows redirects to the same host, or to one of ``hosts``, and refuses all others.

    The config names the services. A service that was made to redirect must not choose which other hosts are contacted.
    """

    def __init__(self, hosts: Collection[str]) -> None:
        super().__init__()
        self.hosts = hosts

    def get_redirect_target(self, resp: requests.Response) -> str | None:
        location = super().get_redirect_target(resp)
        if location is None:
            return None
        before, after = urlsplit(resp.url), urlsplit(urljoin(resp.url, location))
        if after.hostname != before.hostname and after.hostname not in self.hosts:
            raise InputError(
                f"{resp.url}: redirects to {after.hostname}, which is not permitted; if the host is correct, add it to"
                " fetch.geoplateforme.redirect_hosts"
            )
        if before.scheme == "https" and after.scheme != "https":
            raise InputError(f"{resp.url}: redirects from https to {after.scheme}, which is not permitted")
        return location


def quote(body: bytes) -> str:
    """The beginning of a response, in quotation marks, for a message."""
    text = " ".join(body[: 10 * _QUOTE_CHARACTERS].decode("utf-8", "replace").split())
    return f'"{text[:_QUOTE_CHARACTERS]}"' if text else "nothing"


def _body(response: requests.Response, deadline: float, limit_mb: float) -> Iterator[bytes]:
    """The body in chunks, decompressed. Raises :class:`InputError` once it is larger than ``limit_mb``."""
    num_bytes = 0
    for chunk in response.iter_content(_CHUNK_BYTES):
        if time.monotonic() > deadline:
            raise TransientError("the response took too long (fetch.geoplateforme.max_wait_s)")
        num_bytes += len(chunk)
        if num_bytes > limit_mb * 1e6:
            raise InputError(
                f"{response.url}: the response is too large (fetch.geoplateforme.max_response_mb, max_download_mb)"
            )
        yield chunk


def _retry_after_s(response: requests.Response) -> float | None:
    """The wait that the service asks for, if it does.

    A date is compared with the service's own clock where the response states it, because ours may differ. One that
    has passed asks for nothing: else all attempts would follow at once.
    """
    value = response.headers.get("Retry-After", "")
    try:
        seconds = float(value)
    except ValueError:  # absent, or a date
        date = _date(value)
        if date is None:
            return None
        seconds = (date - (_date(response.headers.get("Date", "")) or datetime.now(UTC))).total_seconds()
        return seconds if seconds > 0 else None
    return seconds if seconds >= 0 else None


def _date(value: str) -> datetime | None:
    try:
        date = parsedate_to_datetime(value)
    except (ValueError, TypeError):
        return None
    return date.replace(tzinfo=UTC) if date.tzinfo is None else date


def _edition(response: requests.Response) -> str:
    """What identifies an edition of a file, as ``If-Range`` expects it; "" if the service states nothing."""
    tag = response.headers.get("ETag", "")
    return tag if tag and not tag.startswith("W/") else response.headers.get("Last-Modified", "")


def _stored_edition(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (FileNotFoundError, UnicodeDecodeError):
        return ""


def _range_start(response: requests.Response) -> int | None:
    try:
        return int(response.headers["Content-Range"].removeprefix("bytes ").split("-")[0])
    except (KeyError, ValueError):
        return None


def _size_of_file(response: requests.Response) -> int:
    """The size of the whole file, from the header of a response to a Range request."""
    value = response.headers["Content-Range"]
    size = value.rpartition("/")[2]
    if not size.isdigit():
        raise RangesUnsupportedError(
            f"{response.url}: the service does not state the size of the file: {value[:80]}"
        )
    return int(size)


def _length(response: requests.Response) -> int | None:
    length = response.headers.get("Content-Length", "")
    return int(length) if length.isdigit() else None


def _exception(state: tenacity.RetryCallState) -> BaseException | None:
    return state.outcome.exception() if state.outcome else None


def _pause_s(state: tenacity.RetryCallState) -> float:
    error = _exception(state)
    if isinstance(error, TransientError) and error.retry_after_s is not None:
        return error.retry_after_s
    # half of the pause is random, so that jobs that failed together do not retry together
    return min(_LONGEST_PAUSE_S, 2.0**state.attempt_number) * random.uniform(0.5, 1.0)
