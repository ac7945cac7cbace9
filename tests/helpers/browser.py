"""Drive headless Chromium through the DevTools protocol."""

from __future__ import annotations

import base64
import io
import itertools
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

CHROMIUM = next((found for name in ("chromium", "google-chrome", "chrome") if (found := shutil.which(name))), None)
FLAGS = ("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE = 300.0  # s: test machines are busy and render without a GPU


def require_browser() -> None:
    """Skip if there is no browser or no WebSocket client."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium on this machine")
    pytest.importorskip("websockets.sync.client", reason="websockets drives the browser")


class Page:
    """A tab: sends commands and reads replies in order; page errors are collected in ``errors``."""

    def __init__(self, socket: Any) -> None:
        self.socket, self.errors = socket, []  # type: ignore[var-annotated]
        self._numbers = itertools.count(1)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a protocol command and return its reply."""
        number = next(self._numbers)
        self.socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv(timeout=PATIENCE))
            if message.get("method") == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(message["params"]["exceptionDetails"])[:600])
            if message.get("method") == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
                self.errors.append(message["params"]["entry"]["text"])
            if message.get("id") == number:
                assert "error" not in message, f"{method}: {message['error']}"
                return dict(message["result"])

    def open(self, url: str) -> None:
        """Open a page and wait until it is loaded."""
        self.send("Page.navigate", url=url)
        self.until("document.readyState === 'complete' && location.href !== 'about:blank'")

    def ask(self, expression: str) -> Any:
        """Evaluate a JavaScript expression and return its value."""
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, expression: str, patience: float = PATIENCE) -> None:
        """Wait up to ``patience`` seconds until an expression is true."""
        end = time.monotonic() + patience
        while not self.ask(f"Boolean({expression})"):
            assert time.monotonic() < end, f"never true: {expression}; {self.errors}"
            time.sleep(0.05)

    def size(self, width: int, height: int, *, phone: bool = False, scale: float = 1.0) -> None:
        """Set the window size in CSS px; ``phone`` enables touch input."""
        self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=phone
        )
        self.send("Emulation.setTouchEmulationEnabled", enabled=phone, maxTouchPoints=5)

    def middle(self, selector: str) -> tuple[float, float]:
        """Scroll to an element and return its centre in px."""
        box = self.ask(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)}); "
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect(); "
            "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        return float(box[0]), float(box[1])

    def click(self, selector: str) -> None:
        """Press and release the mouse on an element."""
        x, y = self.middle(selector)
        self.mouse("mousePressed", x, y)
        self.mouse("mouseReleased", x, y)

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send a mouse event with the left button."""
        pressed = {"button": "left", "buttons": 1, "clickCount": 1} if kind != "mouseWheel" else {}
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **{**pressed, **more})

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 6) -> None:
        """Drag the mouse from start to end in ``steps`` steps."""
        self.mouse("mousePressed", *start)
        for t in np.linspace(0, 1, steps + 1)[1:]:
            self.mouse("mouseMoved", *(a + t * (b - a) for a, b in zip(start, end, strict=True)))
        self.mouse("mouseReleased", *end)

    def fingers(self, *ways: tuple[tuple[float, float], tuple[float, float]], steps: int = 6) -> None:
        """Touch with one finger per (start, end) pair, move all fingers along their paths, then lift them."""
        for i, t in enumerate(np.linspace(0, 1, steps + 1)):
            points = [
                {"x": a[0] + t * (b[0] - a[0]), "y": a[1] + t * (b[1] - a[1]), "id": k} for k, (a, b) in enumerate(ways)
            ]
            self.send("Input.dispatchTouchEvent", type="touchMove" if i else "touchStart", touchPoints=points)
        self.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def key(self, key: str, **more: Any) -> None:
        """Press and release a key, by its name in KeyboardEvent.key."""
        codes = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "Escape": 27, "Tab": 9, "Enter": 13}
        text = {"text": key} if len(key) == 1 else {"text": "\r"} if key == "Enter" else {}
        code = {"windowsVirtualKeyCode": codes.get(key, ord(key[0].upper()))}
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, **code, **text, **more)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key, **code, **more)

    def image(self, path: Path | None = None, *, whole: bool = False) -> np.ndarray:
        """Return the window (or the whole document) as [H, W, 3] in [0, 1]; also write it to ``path`` if it is set."""
        data = base64.b64decode(self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)["data"])
        if path is not None:
            path.write_bytes(data)
        with Image.open(io.BytesIO(data)) as file:
            return np.asarray(file.convert("RGB")) / 255


@contextmanager
def browser(*flags: str) -> Iterator[Page]:
    """Start Chromium with an empty profile and yield a tab; both are closed on exit."""
    from websockets.sync.client import connect

    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(prefix="gs2d_browser_", ignore_cleanup_errors=True) as profile:
        words = [CHROMIUM, *FLAGS, *flags, f"--user-data-dir={profile}", "--remote-debugging-port=0", "about:blank"]
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            with connect(_address(Path(profile), process), max_size=None, open_timeout=PATIENCE) as socket:
                page = Page(socket)
                for domain in ("Page", "Runtime", "Log"):
                    page.send(f"{domain}.enable")
                yield page
        finally:
            process.terminate()
            process.wait(timeout=PATIENCE)


def _address(profile: Path, process: subprocess.Popen[bytes]) -> str:
    """Return the debugger address of the first tab."""
    import urllib.request

    end = time.monotonic() + PATIENCE
    port_file = profile / "DevToolsActivePort"
    while not (port_file.is_file() and len(port_file.read_text().splitlines()) == 2):
        assert process.poll() is None, "the browser ended at once"
        assert time.monotonic() < end, "the browser did not start"
        time.sleep(0.1)
    port = port_file.read_text().splitlines()[0]
    while True:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=PATIENCE) as answer:
            tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
        if tabs:
            return str(tabs[0]["webSocketDebuggerUrl"])
        assert time.monotonic() < end, "the browser has no tab"
        time.sleep(0.1)
