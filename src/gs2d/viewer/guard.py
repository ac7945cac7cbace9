"""Who may look at the viewer, and what may be said to it: a gate in front of viser's server, which has none.

viser (1.1) serves its page and its scene to whoever asks, takes messages of any type and any numbers, prints the
traceback of what it cannot read, and passes requests for a public tunnel on. So its server is started through
:func:`guarded`, which puts four things between the network and viser, without a change to viser itself:

- a token, made anew for each viewer, in the address that is printed; the page then has it as a cookie;
- the origin of a connection must be the page itself, so that a page of another site gets nothing even with the cookie;
- messages are read before viser sees them: of the types that our page has, short, with finite numbers, at a bounded
  rate. What cannot be read, or is not a number, ends the connection it came from, and that alone;
- the library's own log of foreign requests is silent.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import http
import logging
import math
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

__all__ = ["Guard", "guarded", "problem_of"]

MAX_CLIENTS = 16  # browsers at once
MAX_MESSAGE = 1 << 16  # bytes of a message from a browser
RATE, BURST = 200.0, 400.0  # messages a second of a browser; more have to wait
FARTHEST = 1e9  # of any number in a message
MAX_SIDE = 1 << 15  # px of a browser's window
MAX_TEXT = 256
REFUSED = "This viewer is for whoever started it: open the address that gs2d printed, with its token.\n"
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

_log = logging.getLogger("gs2d.viewer.connections")
_log.addHandler(logging.NullHandler())
_log.propagate = False


class Guard:
    """The gate of one viewer.

    Attributes
    ----------
    token : str
        What a browser must know.
    control : callable
        The handle of a widget by its uuid, None where there is none; given once the widgets exist.
    """

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(24)
        self.control: Callable[[str], Any] = lambda uuid: None
        self.installed = False
        self._cookie = "gs2d-" + hashlib.sha256(self.token.encode()).hexdigest()[:12]
        self._clients = 0

    # -- requests ----------------------------------------------------------------------------------------------------
    def admits(self, path: str, headers: Mapping[str, str]) -> bool:
        """Whether a request knows the token: in its address, or as the page's cookie."""
        known = [*parse_qs(urlsplit(path).query, max_num_fields=20).get("token", ())]
        with contextlib.suppress(CookieError):
            cookie = SimpleCookie(headers.get("Cookie", "")).get(self._cookie)
            known += [] if cookie is None else [cookie.value]
        return any(hmac.compare_digest(token.encode(), self.token.encode()) for token in known)

    def refusal(self, path: str, headers: Mapping[str, str]) -> http.HTTPStatus | None:
        """Return why a request is turned away, None where it is let in."""
        try:
            if not self.admits(path, headers):
                return http.HTTPStatus.FORBIDDEN
            if "Upgrade" not in headers:
                return None
            origin = headers.get("Origin")  # programs that are no browsers send none; every browser does
            if origin is not None and urlsplit(origin).netloc.lower() != headers.get("Host", "").lower():
                return http.HTTPStatus.FORBIDDEN
        except (ValueError, LookupError):  # addresses that cannot be read, headers given twice
            return http.HTTPStatus.BAD_REQUEST
        return http.HTTPStatus.SERVICE_UNAVAILABLE if self._clients >= MAX_CLIENTS else None

    def process_request(self, serve_file: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return what answers requests: refuses them, or asks ``serve_file``, viser's."""

        def answer(connection: Any, request: Any) -> Any:
            refusal = self.refusal(request.path, request.headers)
            if refusal is not None:
                response = connection.respond(refusal, REFUSED)
            else:
                response = serve_file(connection, request)
                if response is not None and "token=" in request.path:
                    response.headers["Set-Cookie"] = f"{self._cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            if response is not None:
                for name, value in _HEADERS.items():
                    response.headers[name] = value
            return response

        return answer

    # -- connections -------------------------------------------------------------------------------------------------
    def handler(self, serve_client: Callable[[Any], Any], version: str) -> Callable[[Any], Any]:
        """Return what serves a connection: ``serve_client``, viser's, which gets checked messages only."""

        async def serve(connection: Any) -> None:
            if connection.subprotocol != f"viser-v{version}":  # viser would print what the client says it is
                await connection.close(1002, "another version of the page")
                return
            self._clients += 1
            try:
                await serve_client(_CheckedConnection(connection, self))
            finally:
                self._clients -= 1

        return serve


class _CheckedConnection:
    """The parts of a connection that viser uses."""

    def __init__(self, inner: Any, guard: Guard) -> None:
        self._inner, self._guard = inner, guard
        self._credit, self._at = BURST, time.monotonic()
        self.subprotocol = inner.subprotocol
        self.send, self.close = inner.send, inner.close

    async def recv(self) -> bytes:
        """Return the next message that may be passed on; ends the connection at one that cannot be read."""
        from websockets.exceptions import ConnectionClosedError

        while True:
            raw = await self._inner.recv()
            now = time.monotonic()
            self._credit = min(BURST, self._credit + RATE * (now - self._at)) - 1
            self._at = now
            if self._credit < 0:  # it waits, and by that the browser does
                await asyncio.sleep(-self._credit / RATE)
            problem = problem_of(raw, self._guard.control)
            if problem is None:
                return bytes(raw)
            if problem:
                await self._inner.close(1008, problem)
                raise ConnectionClosedError(None, None)


# -- messages ----------------------------------------------------------------------------------------------------------
def problem_of(raw: Any, control: Callable[[str], Any]) -> str | None:
    """Return what is wrong with a message of a browser; None: it may be passed on; "": it is left out."""
    import msgspec
    from viser import _messages

    try:
        message = msgspec.msgpack.decode(raw if isinstance(raw, bytes) else b"")
    except (msgspec.MsgspecError, ValueError, RecursionError, UnicodeDecodeError):
        return "not a message"
    kind = message.get("type") if isinstance(message, dict) else None
    if not isinstance(kind, str):
        return "not a message"
    fields = {name: value for name, value in message.items() if name != "type"}
    if kind == "ViewerCameraMessage":
        return None if _is_camera(fields) else "not a camera"
    if kind == "GuiUpdateMessage":
        return _problem_of_update(fields, control)
    if kind == "SceneNodeClickMessage":
        return None if _is_click(fields) else "not a click"
    if kind == "ScenePointerMessage":
        return None if _is_pointer(fields) else "not a click"
    # Others that viser has (uploads, tunnels, ...) are of no use to our page.
    return "" if kind.isidentifier() and hasattr(_messages, kind) else "not a message"


def _is_number(value: Any, limit: float = FARTHEST) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and abs(value) <= limit


def _are_numbers(value: Any, count: int, limit: float = FARTHEST) -> bool:
    return isinstance(value, list) and len(value) == count and all(_is_number(entry, limit) for entry in value)


_CAMERA: Mapping[str, Callable[[Any], bool]] = {
    "wxyz": lambda v: _are_numbers(v, 4, 2.0) and sum(x * x for x in v) > 0.25,
    "position": lambda v: _are_numbers(v, 3),
    "fov": lambda v: _is_number(v) and 0 < v < math.pi,
    "near": _is_number,
    "far": _is_number,
    "image_height": lambda v: type(v) is int and 0 <= v <= MAX_SIDE,
    "image_width": lambda v: type(v) is int and 0 <= v <= MAX_SIDE,
    "look_at": lambda v: _are_numbers(v, 3),
    "up_direction": lambda v: _are_numbers(v, 3),
}
_CLICK: Mapping[str, Callable[[Any], bool]] = {
    "name": lambda v: isinstance(v, str) and len(v) <= MAX_TEXT,
    "instance_index": lambda v: v is None or type(v) is int,
    "ray_origin": lambda v: _are_numbers(v, 3),
    "ray_direction": lambda v: _are_numbers(v, 3),
    "screen_pos": lambda v: _are_numbers(v, 2),
    "modifier": lambda v: v is None or (isinstance(v, str) and len(v) <= MAX_TEXT),
}


_POINTER: Mapping[str, Callable[[Any], bool]] = {
    "event_type": lambda v: v == "click",
    "ray_origin": _CLICK["ray_origin"],
    "ray_direction": lambda v: _are_numbers(v, 3) and any(v),
    "screen_pos": lambda v: isinstance(v, list) and len(v) == 1 and _are_numbers(v[0], 2),
    "modifier": _CLICK["modifier"],
}


def _is_pointer(fields: Mapping[str, Any]) -> bool:
    return set(fields) == set(_POINTER) and all(check(fields[name]) for name, check in _POINTER.items())


def _is_camera(fields: Mapping[str, Any]) -> bool:
    return set(fields) == set(_CAMERA) and all(check(fields[name]) for name, check in _CAMERA.items())


def _is_click(fields: Mapping[str, Any]) -> bool:
    owner = fields.get("owner", "")
    if not isinstance(owner, str) or len(owner) > MAX_TEXT or set(fields) - {"owner"} != set(_CLICK):
        return False
    return all(check(fields[name]) for name, check in _CLICK.items())


def _problem_of_update(fields: Mapping[str, Any], control: Callable[[str], Any]) -> str | None:
    uuid, updates = fields.get("uuid"), fields.get("updates")
    if set(fields) != {"uuid", "updates"} or not isinstance(uuid, str) or not isinstance(updates, dict):
        return "not a value of a widget"
    if set(updates) != {"value"}:  # viser would set any attribute of the widget
        return "not a value of a widget"
    handle = control(uuid)
    if handle is None:
        return ""  # of a widget that was there
    return None if _fits(handle, updates["value"]) else "not a value of a widget"


def _fits(handle: Any, value: Any) -> bool:
    """Whether a widget can have a value."""
    options, held = getattr(handle, "options", None), handle.value
    if options is not None:
        return isinstance(value, str) and value in options
    if isinstance(held, bool):
        return isinstance(value, bool)
    low, high = getattr(handle, "min", -FARTHEST), getattr(handle, "max", FARTHEST)
    room = 1e-6 * (1 + abs(high - low))
    values = value if isinstance(held, tuple) and isinstance(value, list) else [value]
    if isinstance(held, tuple) and len(values) != len(held):
        return False
    return all(_is_number(entry) and low - room <= entry <= high + room for entry in values)


# -- viser's server ----------------------------------------------------------------------------------------------------
@contextlib.contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """Let what is served by viser in this block be served through a gate.

    viser calls ``websockets.asyncio.server.serve`` in a thread that is done with it when its constructor returns, and
    has no door for what is wanted here: for so long the function is another one.
    """
    import viser
    import websockets.asyncio.server as module

    serve = module.serve

    def through_the_gate(handler: Any, *args: Any, **options: Any) -> Any:
        guard.installed = True
        # What goes wrong with a connection, or where there are no more files, is nothing for the terminal.
        asyncio.get_running_loop().set_exception_handler(lambda _, context: _log.debug("%s", context.get("message")))
        options |= {"max_size": MAX_MESSAGE, "max_queue": 16, "logger": _log, "open_timeout": 10}
        options["process_request"] = guard.process_request(options["process_request"])
        return serve(guard.handler(handler, viser.__version__), *args, **options)

    module.serve = through_the_gate  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        module.serve = serve  # type: ignore[misc]
