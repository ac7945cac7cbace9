"""A browser of viser without a screen: it connects, says where it looks from, and keeps what it is sent."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec
import viser
import zstandard
from websockets.sync.client import connect
from websockets.typing import Subprotocol


class Client:
    """Listens in a thread until it is closed."""

    def __init__(self, url: str) -> None:
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        self._socket = connect(url.replace("http", "ws", 1), subprotocols=[protocol], max_size=None)
        self.counts: Counter[str] = Counter()  # of messages, by type
        self.bytes = 0
        self._widgets: dict[str, str] = {}  # label -> uuid
        self.text = ""  # of the status line
        self.look_from((0.0, -3.0, 1.0))
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        with contextlib.suppress(Exception):  # closed by either side
            for data in self._socket:
                assert isinstance(data, bytes)
                self.bytes += len(data)
                size = int.from_bytes(data[8:16], "little")
                decoded = msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + size], 1 << 28))
                self._read(decoded)

    def _read(self, value: Any) -> None:
        """Messages are somewhere in it: maps with a type."""
        if isinstance(value, list):
            for entry in value:
                self._read(entry)
        if not isinstance(value, dict):
            return
        if isinstance(kind := value.get("type"), str):
            self.counts[kind] += 1
            props = value.get("props") or {}
            if isinstance(props, dict) and props.get("label"):
                self._widgets[props["label"]] = value["uuid"]
            if kind == "GuiMarkdownMessage":
                self.text = props["_markdown"]
            updates = value.get("updates")
            if isinstance(updates, dict) and "_markdown" in updates:
                self.text = updates["_markdown"]
        for entry in value.values():
            if isinstance(entry, list):
                self._read(entry)

    def _send(self, kind: str, **fields: Any) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look_from(self, position: tuple[float, float, float]) -> None:
        """Move."""
        self._send(
            "ViewerCameraMessage",
            wxyz=(0.70710678, -0.70710678, 0.0, 0.0),
            position=position,
            fov=1.0,
            near=0.001,
            far=100.0,
            image_height=60,
            image_width=80,
            look_at=(0.0, 0.0, 0.0),
            up_direction=(0.0, 0.0, 1.0),
        )

    def choose(self, label: str, value: Any) -> None:
        """Set a widget."""
        self.wait(lambda: label in self._widgets)
        self._send("GuiUpdateMessage", uuid=self._widgets[label], updates={"value": value})

    def wait(self, condition: Callable[[], bool], seconds: float = 60.0) -> None:
        """Until something is true."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, (self.counts, self.text)
            time.sleep(0.01)

    def close(self) -> None:
        """Go away."""
        self._socket.close()
        self._thread.join(timeout=5)
