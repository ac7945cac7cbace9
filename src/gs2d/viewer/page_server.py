"""A small web server for the page: one process, the loopback interface and a secret token.

Requests must carry the token of the printed address and name this machine as their host; all others get status 403.
Each connection carries one request.
"""

from __future__ import annotations

import contextlib
import hmac
import secrets
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from gs2d.errors import BackendError, DataError, Gs2dError

HOST = "127.0.0.1"  # from another machine: ssh -L
DEFAULT_PORT = 8080
TEXT = "text/plain; charset=utf-8"
REFUSED = "This page is private: open the address that gs2d printed, with its token.\n"
_LOCAL_NAMES = ("127.0.0.1", "localhost")  # other names may be DNS rebinding by another site
_MAX_CONNECTIONS = 16  # simultaneous; further ones are closed at once
_TIMEOUT = 30.0  # s; a connection is closed after this time without a byte
_TRIED_PORTS = 100
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True, eq=False)
class Response:
    """The response to a request."""

    kind: str  # content type
    parts: Sequence[bytes | memoryview]  # the body
    headers: Mapping[str, str] = field(default_factory=dict)  # further headers


Route = Callable[[Mapping[str, str]], Response]
"""Responds to a request with the arguments of its address. A Gs2dError becomes status 400 with its text."""


def free_port(port: int | None, *, option: str = "--port") -> int:
    """Return ``port`` if it is free; for None the first free port from 8080 on. ``option`` names it in messages.

    Raise BackendError if the port is out of range or in use.
    """
    tried = [port] if port is not None else list(range(DEFAULT_PORT, DEFAULT_PORT + _TRIED_PORTS))
    reason = ""
    for number in tried:
        if not 1 <= number <= 65535:
            raise BackendError(f"{option} must be 1 to 65535, got {number}")
        try:
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((HOST, number))
                return number
        except OSError as error:
            reason = error.strerror or str(error)
    ports = f"port {port}" if port is not None else f"ports {tried[0]} to {tried[-1]}"
    raise BackendError(f"a free port on {HOST} was expected, {ports}: {reason}; choose another {option}")


def number_in(arguments: Mapping[str, str], name: str, count: int) -> int:
    """Return an argument that must be an index below ``count``.

    Raise DataError if it is missing, not a number, or out of range.
    """
    text = arguments.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) < 10 and int(text) < count):
        raise DataError(f"{name} must be 0 to {count - 1}, got {text[:20]!r}")
    return int(text)


class PageServer:
    """Serves routes from its own threads until it is closed.

    ``port``: None: the first free port from 8080 on. ``routes``: routes by path, without the slash; ``""`` is the page.
    ``failure`` is an unexpected error of a route.
    """

    def __init__(self, port: int | None, routes: Mapping[str, Route], *, option: str = "--port") -> None:
        self.port = free_port(port, option=option)
        self.token = secrets.token_urlsafe(24)
        self.failure: Exception | None = None
        self._routes = routes
        self._server = _Server(self)
        self._thread = threading.Thread(target=self._server.serve_forever, args=[0.1], name="gs2d page", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Return the address of the page, with its token."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    def respond(self, address: str, hosts: Sequence[str]) -> tuple[HTTPStatus, Response]:
        """Respond to a request for an address (path and query); ``hosts`` are its Host headers."""
        try:
            target = urlsplit(address)
            arguments = dict(parse_qsl(target.query, max_num_fields=20))
            is_local = len(hosts) == 1 and urlsplit(f"//{hosts[0]}").hostname in _LOCAL_NAMES
        except ValueError:
            return HTTPStatus.BAD_REQUEST, Response(TEXT, [b"The address cannot be read.\n"])
        if not (is_local and hmac.compare_digest(arguments.get("token", "").encode(), self.token.encode())):
            return HTTPStatus.FORBIDDEN, Response(TEXT, [REFUSED.encode()])
        route = self._routes.get(target.path.removeprefix("/"))
        if route is None:
            return HTTPStatus.NOT_FOUND, Response(TEXT, [b"There is nothing at this address.\n"])
        try:
            return HTTPStatus.OK, route(arguments)
        except Gs2dError as error:
            return HTTPStatus.BAD_REQUEST, Response(TEXT, [str(error).encode()])
        except Exception as error:  # reported by the main thread
            self.failure = error
            return HTTPStatus.INTERNAL_SERVER_ERROR, Response(TEXT, [f"{type(error).__name__}: {error}".encode()])

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(timeout=5)


class _Server(ThreadingHTTPServer):
    """A thread for each connection, up to a limit. Broken connections are not reported."""

    def __init__(self, page: PageServer) -> None:
        self.page = page
        self._free = threading.Semaphore(_MAX_CONNECTIONS)
        super().__init__((HOST, page.port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:  # no thread could be started
            self._free.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass


class _Handler(BaseHTTPRequestHandler):
    """Reads a request and sends the response."""

    timeout = _TIMEOUT
    server: _Server

    def do_GET(self) -> None:
        status, response = self.server.page.respond(self.path, self.headers.get_all("Host", []))
        self.send_response(status)
        length = sum(memoryview(part).nbytes for part in response.parts)
        body = {"Content-Type": response.kind, "Content-Length": length}
        for name, value in {**_HEADERS, **response.headers, **body}.items():
            self.send_header(name, str(value))
        self.end_headers()
        with contextlib.suppress(OSError):  # the browser left
            for part in response.parts:
                self.wfile.write(part)

    def version_string(self) -> str:
        return "gs2d"

    def log_message(self, *_: Any) -> None:
        pass
