"""Faults of a service, simulated by a local server. Each test counts the requests."""

from __future__ import annotations

import gzip
import shutil
import socket
import socketserver
import ssl
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import requests
from pytest_httpserver import HTTPServer

from p2wss.config import Geoplateforme
from p2wss.fetching.http import Client
from p2wss.storage.messages import InputError

BODY = b"LASF" + bytes(range(256)) * 400


def client(pauses: list[float] | None = None, **settings: Any) -> Client:
    config = Geoplateforme(requests_per_s=1e6, timeout_s=settings.pop("timeout_s", 5), **settings)
    return Client(config, sleep=(pauses if pauses is not None else []).append)


def test_retry_after_is_respected(httpserver: HTTPServer) -> None:
    httpserver.expect_ordered_request("/x").respond_with_data("", status=429, headers={"Retry-After": "5"})
    httpserver.expect_ordered_request("/x").respond_with_data("", status=429, headers={"Retry-After": "3"})
    httpserver.expect_ordered_request("/x").respond_with_data("fine")
    pauses: list[float] = []
    assert client(pauses).get(httpserver.url_for("/x")) == b"fine"
    assert [pause for pause in pauses if pause > 0.1] == [5.0, 3.0]
    assert len(httpserver.log) == 3


@pytest.mark.parametrize("value", ["Thu, 01 Jan 1970 00:00:00 GMT", "-5", "nan", "soon", "Mon, 99 Foo 2020"])
def test_a_retry_after_in_the_past_is_no_reason_to_hurry(httpserver: HTTPServer, value: str) -> None:
    headers = {"Retry-After": value}
    httpserver.expect_request("/x").respond_with_data("", status=429, headers=headers)
    pauses: list[float] = []
    with pytest.raises(InputError, match="HTTP 429, after 3 attempts"):
        client(pauses, max_attempts=3).get(httpserver.url_for("/x"))
    assert len(httpserver.log) == 3
    assert len([pause for pause in pauses if pause >= 1]) == 2, "growing pauses, as without the header"


@pytest.mark.parametrize("value", ["86400", "9" * 30])
def test_a_retry_after_in_the_far_future_is_an_error_at_once(httpserver: HTTPServer, value: str) -> None:
    headers = {"Retry-After": value}
    httpserver.expect_request("/x").respond_with_data("", status=503, headers=headers)
    pauses: list[float] = []
    with pytest.raises(InputError, match="HTTP 503, after 1 attempts"):
        client(pauses, max_wait_s=600).get(httpserver.url_for("/x"))
    assert len(httpserver.log) == 1 and max(pauses, default=0) < 600


def test_server_errors_are_retried_with_growing_pauses(httpserver: HTTPServer) -> None:
    for _ in range(2):
        httpserver.expect_ordered_request("/x").respond_with_data("", status=500)
    httpserver.expect_ordered_request("/x").respond_with_data("fine")
    pauses: list[float] = []
    assert client(pauses).get(httpserver.url_for("/x")) == b"fine"
    first, second = (pause for pause in pauses if pause > 0.1)
    assert 1 <= first <= 2 <= second <= 4
    assert len(httpserver.log) == 3


def test_a_service_that_stays_down_is_an_error(httpserver: HTTPServer) -> None:
    httpserver.expect_request("/x").respond_with_data("", status=503)
    with pytest.raises(InputError, match=r"/x: HTTP 503, after 4 attempts"):
        client(max_attempts=4).get(httpserver.url_for("/x"))
    assert len(httpserver.log) == 4


def test_a_refusal_is_quoted_and_not_retried(httpserver: HTTPServer) -> None:
    httpserver.expect_request("/x").respond_with_data("<html>unknown layer</html>", status=400)
    with pytest.raises(InputError, match=r'HTTP 400 BAD REQUEST: "<html>unknown layer</html>"'):
        client().get(httpserver.url_for("/x"))
    assert len(httpserver.log) == 1


def test_no_response() -> None:
    with socketserver.TCPServer(("127.0.0.1", 0), None) as nobody:  # type: ignore[arg-type]
        port = nobody.server_address[1]
    with pytest.raises(InputError, match=r"after 2 attempts; try again later, or set fetch\.source: folder"):
        client(max_attempts=2).get(f"http://127.0.0.1:{port}/x")


def test_requests_are_spaced(httpserver: HTTPServer) -> None:
    httpserver.expect_request("/x").respond_with_data("fine")
    pauses: list[float] = []
    client = Client(Geoplateforme(requests_per_s=0.5), sleep=pauses.append)
    for _ in range(3):
        client.get(httpserver.url_for("/x"))
    assert len(pauses) == 2
    assert all(1.5 < pause <= 2 for pause in pauses)


def test_user_agent_and_redirect(httpserver: HTTPServer) -> None:
    httpserver.expect_request("/old").respond_with_data(
        "", status=302, headers={"Location": httpserver.url_for("/new")}
    )
    httpserver.expect_request("/new", headers={"User-Agent": "p2wss"}).respond_with_data("fine")
    assert client().get(httpserver.url_for("/old")) == b"fine"
    assert len(httpserver.log) == 2


@contextmanager
def broken_server(answers: list[bytes]) -> Iterator[tuple[str, list[bytes]]]:
    """Sends each of ``answers`` as raw bytes, then closes the connection. Yields (url, list of requests)."""
    requests: list[bytes] = []

    class Handler(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            requests.append(self.request.recv(65536))
            self.request.sendall(answers[min(len(requests), len(answers)) - 1])

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/tile.laz", requests
        server.shutdown()


def raw(status: str, body: bytes, **headers: object) -> bytes:
    lines = [f"HTTP/1.1 {status}", *(f"{name.replace('_', '-')}: {value}" for name, value in headers.items())]
    return "\r\n".join([*lines, "Connection: close", "", ""]).encode() + body


def test_a_redirect_to_another_host_is_refused_unless_it_is_listed(httpserver: HTTPServer) -> None:
    elsewhere = httpserver.url_for("/new").replace("localhost", "127.0.0.1")
    assert "127.0.0.1" in elsewhere and "localhost" in httpserver.url_for("/old")
    httpserver.expect_request("/old").respond_with_data("", status=302, headers={"Location": elsewhere})
    httpserver.expect_request("/new").respond_with_data("fine")
    with pytest.raises(InputError, match=r"/old: redirects to 127\.0\.0\.1, which is not permitted"):
        client().get(httpserver.url_for("/old"))
    assert len(httpserver.log) == 1
    assert client(redirect_hosts=["127.0.0.1"]).get(httpserver.url_for("/old")) == b"fine"


def test_a_redirect_out_of_tls_is_refused() -> None:
    response = requests.Response()
    response.status_code, response.url = 302, "https://data.example/old"
    session = client().session
    response.headers["Location"] = "https://data.example/new"
    assert session.get_redirect_target(response) == "https://data.example/new"
    response.headers["Location"] = "http://data.example/new"
    with pytest.raises(InputError, match="/old: redirects from https to http, which is not permitted"):
        session.get_redirect_target(response)


def test_a_decompression_bomb_is_refused_before_it_is_whole(httpserver: HTTPServer, tmp_path: Path) -> None:
    bomb = gzip.compress(b"LASF" + bytes(50_000_000))
    assert len(bomb) < 100_000
    httpserver.expect_request("/x").respond_with_data(bomb, headers={"Content-Encoding": "gzip"})
    limits = {"max_response_mb": 1, "max_download_mb": 1}
    with pytest.raises(InputError, match="the response is too large"):
        client(**limits).get(httpserver.url_for("/x"))
    with pytest.raises(InputError, match="the response is too large"):
        client(**limits).download(httpserver.url_for("/x"), tmp_path / "a.laz", b"LASF")
    assert len(httpserver.log) == 2
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 2e6


def test_a_certificate_that_does_not_verify_is_not_asked_again(tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("needs the program openssl, which makes a certificate that nobody trusts")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    make = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-days",
        "2",
        "-subj",
        "/CN=localhost",
    ]
    subprocess.run([*make, "-keyout", key, "-out", certificate], check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    with HTTPServer(ssl_context=context) as server:
        server.expect_request("/x").respond_with_data("fine")
        with pytest.raises(InputError, match="its TLS certificate cannot be verified"):
            client().get(server.url_for("/x"))
        assert len(server.log) == 0


def test_without_network_the_files_to_give_are_named_at_once() -> None:
    waits: list[float] = []
    with pytest.raises(
        InputError, match=r"no host no-such-host\.invalid; .*fetch\.folder\.footprints"
    ) as error:
        client(waits).get("http://no-such-host.invalid/x")
    assert waits == [] and all(f"fetch.folder.{name}" in str(error.value) for name in ("dtm", "lidar"))


def test_connection_lost_in_the_body() -> None:
    answers = [raw("200 OK", b"only a pie", Content_Length=20), raw("200 OK", b"fine", Content_Length=4)]
    with broken_server(answers) as (url, requests):
        assert client().get(url) == b"fine"
        assert len(requests) == 2


@pytest.mark.parametrize("stated", [len(BODY) - 1000, len(BODY) + 1000])
def test_a_wrong_content_length(tmp_path: Path, stated: int) -> None:
    """Too short a length cuts the body off, whose end nobody sends; too long a one is never reached."""
    with broken_server([raw("200 OK", BODY, Content_Length=stated)]) as (url, requests):
        if stated < len(BODY):
            assert client().get(url) == BODY[:stated] and len(requests) == 1
        else:
            with pytest.raises(InputError, match="after 3 attempts"):
                client(max_attempts=3).get(url)
            with pytest.raises(InputError, match="after 3 attempts"):
                client(max_attempts=3).download(url, tmp_path / "t.laz", b"LASF")
            assert len(requests) == 6


def test_a_service_with_ipv6_only(monkeypatch: pytest.MonkeyPatch) -> None:
    class Server(socketserver.ThreadingTCPServer):
        address_family = socket.AF_INET6

    requests: list[bytes] = []

    class Handler(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            requests.append(self.request.recv(65536))
            self.request.sendall(raw("200 OK", b"fine", Content_Length=4))

    asked = socket.getaddrinfo

    def only_ipv6(host: str, *arguments: Any, **named: Any) -> Any:
        return asked("::1" if host == "six.test" else host, *arguments, **named)

    monkeypatch.setattr(socket, "getaddrinfo", only_ipv6)
    try:
        server = Server(("::1", 0), Handler)
    except OSError:
        pytest.skip("no IPv6 here")
    with server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        port = server.server_address[1]
        for host in ("[::1]", "six.test"):
            assert client().get(f"http://{host}:{port}/x") == b"fine"
        server.shutdown()
    assert len(requests) == 2 and f"Host: [::1]:{port}".encode() in requests[0]


def test_a_web_page_is_not_a_tile(httpserver: HTTPServer, tmp_path: Path) -> None:
    httpserver.expect_request("/t").respond_with_data("<html>Moved, see our new site</html>")
    with pytest.raises(InputError, match="begins with b'LASF', got \"<html>Moved"):
        client().download(httpserver.url_for("/t"), tmp_path / "t.laz", b"LASF")
    assert len(httpserver.log) == 1


def test_a_response_that_is_too_slow_is_an_error(tmp_path: Path) -> None:
    """Each chunk comes within the timeout, but the whole response would never end."""

    class Drip(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            self.request.recv(65536)
            self.request.sendall(raw("200 OK", b"", Transfer_Encoding="chunked"))
            try:
                for _ in range(100):
                    self.request.sendall(b"1\r\nx\r\n")
                    stop.wait(0.05)
            except OSError:
                pass

    stop = threading.Event()
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Drip) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        with pytest.raises(InputError, match="took too long"):
            client(max_attempts=1, max_wait_s=0.3).get(f"http://127.0.0.1:{server.server_address[1]}/x")
        stop.set()
        server.shutdown()


def test_repeated_connection_resets_are_an_error_with_their_count(tmp_path: Path) -> None:
    answer = raw("200 OK", b"LASF" + bytes(600_000), Content_Length=2_000_000)
    with broken_server([answer]) as (url, requests):
        with pytest.raises(InputError, match="after 3 attempts"):
            client(max_attempts=3).download(url, tmp_path / "t.laz", b"LASF")
        assert len(requests) == 3


def test_a_download_that_breaks_off_begins_again(tmp_path: Path) -> None:
    answers = [
        raw("200 OK", BODY[:1000], Content_Length=len(BODY)),
        raw("200 OK", BODY, Content_Length=len(BODY)),
    ]
    with broken_server(answers) as (url, requests):
        client().download(url, tmp_path / "t.laz", b"LASF")
    assert (tmp_path / "t.laz").read_bytes() == BODY and len(requests) == 2
