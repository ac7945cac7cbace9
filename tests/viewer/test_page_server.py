"""The server of the page: only requests with the token, for this machine, are answered."""

from __future__ import annotations

import http.client
import socket
import time
from collections.abc import Iterator, Mapping

import numpy as np
import pytest

from gs2d.errors import BackendError, DataError
from gs2d.viewer.page_server import HOST, PageServer, Response, free_port


def page(_: Mapping[str, str]) -> Response:
    return Response("text/html", [b"<!doctype html>", memoryview(np.arange(3, dtype=np.uint8))], {"X-More": "yes"})


def refuse(_: Mapping[str, str]) -> Response:
    raise DataError("there is no such stage")


def fail(_: Mapping[str, str]) -> Response:
    raise ValueError("a defect")


@pytest.fixture
def server() -> Iterator[PageServer]:
    served = PageServer(None, {"": page, "refuse": refuse, "fail": fail})
    yield served
    served.close()


def get(server: PageServer, address: str, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(HOST, server.port, timeout=20)
    connection.request("GET", address, headers=headers)
    return connection.getresponse()


def test_the_printed_address_is_the_page(server: PageServer) -> None:
    assert server.url == f"http://127.0.0.1:{server.port}/?token={server.token}"
    answer = get(server, f"/?token={server.token}")
    assert (answer.status, answer.read()) == (200, b"<!doctype html>\x00\x01\x02")
    assert answer.headers["X-More"] == "yes"
    assert answer.headers["Cache-Control"] == "no-store"
    assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert answer.headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize("address", ["/", "/?token=", "/?token=wrong", "/?token={token}x", "/refuse", "/nothing"])
def test_without_the_token_everything_is_refused(server: PageServer, address: str) -> None:
    answer = get(server, address.format(token=server.token))
    assert answer.status == 403
    assert b"open the address that gs2d printed" in answer.read()


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:{port}", 200),
        ("localhost:9000", 200),  # another local port: ssh -L
        ("LOCALHOST", 200),
        ("evil.example:{port}", 403),
        ("127.0.0.1.evil.example:{port}", 403),
        ("127.0.0.1@evil.example", 403),
        ("", 403),
        ("[", 400),
    ],
)
def test_a_request_for_another_host_is_refused(server: PageServer, host: str, status: int) -> None:
    """After DNS rebinding a page of another site asks this server, with the name of that site as host."""
    assert get(server, f"/?token={server.token}", Host=host.format(port=server.port)).status == status


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"\x00\xff\x16\x03\x01",
        b"GET",
        b"GET //[ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 200 + b"\r\n",
        b"GET /?" + b"a=1&" * 100 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ],
)
def test_broken_requests_leave_the_server_alive_and_the_terminal_clean(
    server: PageServer, sent: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    with socket.create_connection((HOST, server.port), timeout=20) as connection:
        connection.sendall(sent)
        connection.shutdown(socket.SHUT_WR)
        received = connection.recv(4096)
    assert b"<!doctype html>" not in received
    assert get(server, f"/?token={server.token}").status == 200
    assert server.failure is None
    assert capfd.readouterr() == ("", "")


def test_idle_connections_are_limited_and_end_in_time(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("gs2d.viewer.page_server._MAX_CONNECTIONS", 2)
    monkeypatch.setattr("gs2d.viewer.page_server._Handler.timeout", 0.5)
    server = PageServer(None, {"": page})
    idle = [socket.create_connection((HOST, server.port)) for _ in range(2)]
    time.sleep(0.2)
    with socket.create_connection((HOST, server.port), timeout=20) as third:
        assert third.recv(1) == b""  # closed at once
    time.sleep(0.6)
    assert get(server, f"/?token={server.token}").status == 200
    for connection in idle:
        connection.close()
    server.close()
    assert capfd.readouterr() == ("", "")


def test_a_requested_port_in_use_is_an_error_and_the_default_skips_it() -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(BackendError, match=rf"a free port on 127\.0\.0\.1 was expected, port {port}: .*--port"):
            free_port(port)
        assert free_port(None) != port
    with pytest.raises(BackendError, match="--port"):
        free_port(0)
