"""HTTP requests that respect the service's limits, retry transient failures and detect incomplete responses."""

import random
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar
from urllib.parse import urljoin, urlsplit

import requests
import tenacity

from p2wss.config import Geoplateforme
from p2wss.storage.messages import InputError, log
from p2wss.storage.progress import Progress

_BUSY = {408, 425, 429, 500, 502, 503, 504}
_NOT_FOUND = {404, 410}
_LONGEST_PAUSE_S = 60.0
_CHUNK_BYTES = 1 << 18
_QUOTE_CHARACTERS = 200
_OTHERWISE = (
    "try again later, or set fetch.source: folder with files that you have: fetch.folder.footprints, fetch.folder.dtm"
    " (terrain) and fetch.folder.lidar"
)
Result = TypeVar("Result")


class TransientError(Exception):
    """A failure that may not occur again. retry_after_s: the wait that the service asked for."""

    def __init__(self, reason: str, retry_after_s: float | None = None) -> None:
        super().__init__(reason)
        self.retry_after_s = retry_after_s


class NotFoundError(InputError):
    """Nothing exists at this address: the service responded with HTTP 404 or 410."""


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
            with self._response(url, params or {}) as response:
                return b"".join(_body(response, deadline, self.config.max_response_mb))

        return self._with_retries(url, attempt)

    def download(self, url: str, path: Path, magic: bytes) -> None:
        """Download a large file, which must begin with ``magic``, to ``path``.

        Raises :class:`InputError` if all attempts fail or the file begins otherwise.
        """

        def attempt(deadline: float) -> None:
            with (
                self._response(url, {}) as response,
                path.open("wb") as file,
                Progress(
                    path.name, int(response.headers.get("Content-Length", 0)) // 10**6, "MB"
                ) as progress,
            ):
                num_bytes = 0
                for chunk in _body(response, deadline, self.config.max_download_mb):
                    if num_bytes == 0 and not chunk.startswith(magic):
                        raise InputError(
                            f"{url}: expected a file that begins with {magic!r}, got {quote(chunk)}"
                        )
                    file.write(chunk)
                    num_bytes += len(chunk)
                    progress.update(num_bytes // 10**6)

        self._with_retries(url, attempt)

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
                f"{url}: {error}, after {retrying.statistics.get('attempt_number', 1)} attempts; {_OTHERWISE}"
            ) from error

    @contextmanager
    def _response(self, url: str, params: dict[str, str]) -> Iterator[requests.Response]:
        """A streamed response with a good status. A busy service or a broken connection: TransientError."""
        pause = self._next_request - time.monotonic()
        if pause > 0:
            self._sleep(pause)
        self._next_request = time.monotonic() + 1 / self.config.requests_per_s
        try:
            with self.session.get(url, params=params, timeout=self.config.timeout_s, stream=True) as response:
                if response.status_code in _BUSY:
                    retry_after_s = response.headers.get("Retry-After", "")
                    raise TransientError(
                        f"HTTP {response.status_code}",
                        float(retry_after_s) if retry_after_s.isdecimal() else None,
                    )
                if response.status_code >= 400:
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
            if "Failed to resolve" in str(error):
                host = urlsplit(url).hostname
                raise InputError(f"{url}: no network, or no host {host}; {_OTHERWISE}") from error
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


def _exception(state: tenacity.RetryCallState) -> BaseException | None:
    return state.outcome.exception() if state.outcome else None


def _pause_s(state: tenacity.RetryCallState) -> float:
    error = _exception(state)
    if isinstance(error, TransientError) and error.retry_after_s is not None:
        return error.retry_after_s
    # half of the pause is random, so that jobs that failed together do not retry together
    return min(_LONGEST_PAUSE_S, 2.0**state.attempt_number) * random.uniform(0.5, 1.0)
