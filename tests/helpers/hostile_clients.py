"""Connections that a viewer does not want: each opens, does its worst and goes."""

from __future__ import annotations

import contextlib
import socket
import struct
import urllib.error
import urllib.request
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import msgspec
import viser
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

NAN, INF = float("nan"), float("inf")
CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, -3.0, 1.0],
    "fov": 1.0,
    "near": 0.001,
    "far": 100.0,
    "image_height": 60,
    "image_width": 80,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}


def packed(**change: Any) -> bytes:
    """A camera with other values."""
    return msgspec.msgpack.encode({**CAMERA, **change})


def message(kind: str, **fields: Any) -> bytes:
    """A message of any type."""
    return msgspec.msgpack.encode({"type": kind, **fields})


MESSAGES: dict[str, bytes | str] = {
    "nothing": b"",
    "noise": bytes(range(256)) * 4,
    "text": "{}",
    "a number": msgspec.msgpack.encode(7),
    "a map without a type": msgspec.msgpack.encode({"wxyz": [1.0]}),
    "a type that is no text": msgspec.msgpack.encode({"type": [1]}),
    "a type that nobody has": message("\x1b[31mNoSuchMessage"),
    "nested deeply": b"\x91" * 60_000 + b"\x01",
    "too long": packed(note="x" * 1_000_000),
    "a length beyond its end": b"\xdd\xff\xff\xff\xff" + b"\x01" * 16,
    "camera: nan": packed(position=[NAN, 0.0, 0.0]),
    "camera: nan turn": packed(wxyz=[NAN] * 4),
    "camera: no turn": packed(wxyz=[0.0] * 4),
    "camera: infinite angle": packed(fov=INF),
    "camera: no angle": packed(fov=0.0),
    "camera: nan angle": packed(fov=NAN),
    "camera: huge picture": packed(image_width=10**9, image_height=10**9),
    "camera: negative picture": packed(image_width=-5),
    "camera: text": packed(position="abc"),
    "camera: far away": packed(position=[1e300, 0.0, 0.0]),
    "camera: two numbers": packed(position=[0.0, 0.0]),
    "camera: without a field": message("ViewerCameraMessage", fov=1.0),
    "camera: with another": packed(camera_cb=1),
    "camera: huge number": packed(image_width=2**63),
    "widget: an attribute": message("GuiUpdateMessage", uuid="x", updates={"removed": True}),
    "widget: a list": message("GuiUpdateMessage", uuid="x", updates=[1]),
    "widget: no text": message("GuiUpdateMessage", uuid=3, updates={"value": 1}),
    "click: nan": message(
        "SceneNodeClickMessage",
        name="/cameras/00000",
        instance_index=None,
        ray_origin=[NAN] * 3,
        ray_direction=[0.0] * 3,
        screen_pos=[0.0, 0.0],
        modifier=None,
    ),
}
DROPPED: dict[str, bytes] = {
    "tunnel": message("ShareUrlRequest"),
    "upload": message(
        "FileTransferStartUpload", source_component_uuid="x", transfer_uuid="y", filename="../a", mime_type="a"
    ),
    "no such widget": message("GuiUpdateMessage", uuid="nobody", updates={"value": NAN}),
}
PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


def open_socket(url: str, **options: Any) -> Any:
    """A connection as the page's."""
    options = {"subprotocols": [PROTOCOL], "open_timeout": 60, "max_size": None} | options
    return connect(url.replace("http", "ws", 1), **options)


def say(url: str, data: bytes | str, patience: float = 0.5) -> int:
    """Say something; returns the code by which the connection was closed, 0 if it was not.

    ``patience``: seconds of silence after which it counts as not closed; a loaded machine needs more of them.
    """
    with open_socket(url) as connection:
        try:
            connection.send(data)
            while True:
                connection.recv(timeout=patience)
        except TimeoutError:
            return 0
        except ConnectionClosed as closed:
            return 0 if closed.rcvd is None else closed.rcvd.code


def status_of(url: str, **options: Any) -> int:
    """The status by which a connection is refused; 101: it is not."""
    try:
        with open_socket(url, **options):
            return 101
    except InvalidStatus as refused:
        return int(refused.response.status_code)


def page_status(url: str, **headers: str) -> int:
    """The status of the page."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as refused:
        return refused.code


def _raw(url: str, data: bytes, *, reset: bool = False) -> None:
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname, parts.port), timeout=20) as plain:
        if reset:
            plain.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        plain.sendall(data)


def attacks(url: str) -> list[Callable[[], object]]:
    """Every attack once."""
    bare = url.partition("?")[0]
    handshake = b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    return [
        *(lambda data=data: say(url, data) for data in (*MESSAGES.values(), *DROPPED.values())),  # type: ignore[misc]
        lambda: status_of(bare),
        lambda: status_of(bare + "?token=wrong"),
        lambda: status_of(url, origin=Origin("http://evil.example")),
        lambda: status_of(url, subprotocols=[Subprotocol("viser-v0.0.0")]),
        lambda: page_status(bare),
        lambda: page_status(bare + "../../../etc/passwd?token=" + "x" * 3000),
        lambda: page_status(bare, Cookie="gs2d=1; ="),
        lambda: _raw(url, b"\x16\x03\x01" + bytes(200)),
        lambda: _raw(url, b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 500),
        lambda: _raw(url, handshake),
        lambda: _raw(url, handshake, reset=True),
        lambda: _raw(url, b"", reset=True),
        lambda: _raw(url, b"\r\n" * 1000),
    ]


def attack(url: str, count: int) -> int:
    """``count`` hostile connections in turn; returns how many there were."""
    done = 0
    while done < count:
        for one in attacks(url)[: count - done]:
            with contextlib.suppress(OSError, ConnectionClosed, EOFError, InvalidStatus, TimeoutError):
                one()
            done += 1
    return done
