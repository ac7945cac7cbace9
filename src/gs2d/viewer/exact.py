"""Exact pictures in the viewer: the rasterizer draws what each browser looks at, coarse while it moves, then sharp."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.errors import Gs2dError, ShapeError

Render = Callable[[Camera, str], "Drawn"]

MAX_PIXELS, MOVING_PIXELS = 1280 * 960, 320 * 240
FARTHEST = 160.0  # viewer units, of what has no depth
SETTLED = 0.15  # s without a movement, after which the picture gets sharp


@dataclass(frozen=True, eq=False)
class ViewerFrame:
    """The viewer's frame: that of the capture, moved and scaled (viser's depths end at 168 and have steps of 1e-5).

    Attributes
    ----------
    origin : ndarray [3] world units
    unit : float
        World units.
    """

    origin: np.ndarray
    unit: float

    def inside(self, point: np.ndarray) -> np.ndarray:
        """Return a place in the world [3] in the viewer."""
        return np.asarray((np.asarray(point, np.float64) - self.origin) / self.unit)

    def outside(self, point: np.ndarray) -> np.ndarray:
        """Return a place in the viewer [3] in the world."""
        return np.asarray(np.asarray(point, np.float64) * self.unit + self.origin)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A picture for the viewer.

    Attributes
    ----------
    image : ndarray [H, W, 3] uint8
    depth : ndarray [H, W] float32, world units
        Along the optical axis, so that mesh and cameras stand behind or before it; infinity where there is nothing.
    """

    image: np.ndarray
    depth: np.ndarray


@dataclass
class _Wish:
    """What a browser looks at and has got."""

    client: Any
    moved: float = field(default_factory=time.monotonic)
    coarse: bool = False  # was drawn since
    sharp: bool = False


class ExactImages:
    """Draws the background of every connected browser in a thread of its own: the newest wish of each counts."""

    def __init__(self, server: Any, frame: ViewerFrame, render: Callable[[], Render]) -> None:
        self._server, self._frame, self._render = server, frame, render
        self._kind: str | None = None
        self._wishes: dict[int, _Wish] = {}
        self._changed = threading.Condition()
        self._closed = False
        self.failure: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="gs2d view", daemon=True)
        server.on_client_connect(self._connected)
        server.on_client_disconnect(self._left)
        self._thread.start()

    def _connected(self, client: Any) -> None:
        client.camera.on_update(lambda _: self._moved(client))
        self._moved(client)

    def _moved(self, client: Any) -> None:
        with self._changed:
            self._wishes[client.client_id] = _Wish(client)
            self._changed.notify()

    def _left(self, client: Any) -> None:
        with self._changed:
            self._wishes.pop(client.client_id, None)

    def scene(self, render: Callable[[], Render]) -> None:
        """Draw other splats from now on."""
        with self._changed:
            self._render = render
            self._again()

    def draw(self, kind: str | None) -> None:
        """Draw "exact", "normals", "depth", or nothing (None)."""
        with self._changed:
            if kind is None and self._kind is not None:
                for client in self._server.get_clients().values():
                    client.scene.set_background_image(None)
            self._kind = kind
            self._again()

    def _again(self) -> None:
        for number, client in self._server.get_clients().items():
            self._wishes[number] = _Wish(client)
        self._changed.notify()

    def close(self) -> None:
        """Stop; what is being drawn is finished first."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout=5)

    def _next(self) -> tuple[_Wish, bool, str, Callable[[], Render]] | None:
        """Return the next picture to draw, and whether it is a sharp one; waits for a wish. None: closed."""
        with self._changed:
            while not self._closed:
                now = time.monotonic()
                if self._kind is not None:
                    for wish in self._wishes.values():
                        settled = now - wish.moved >= SETTLED
                        if not wish.sharp and (settled or not wish.coarse):
                            wish.coarse, wish.sharp = True, settled
                            return wish, settled, self._kind, self._render
                waiting = self._kind is not None and any(not wish.sharp for wish in self._wishes.values())
                self._changed.wait(SETTLED / 3 if waiting else None)
        return None

    def _work(self) -> None:
        while (found := self._next()) is not None:
            wish, sharp, kind, render = found
            try:
                camera = camera_of(wish.client.camera, self._frame, MAX_PIXELS if sharp else MOVING_PIXELS)
            except (Gs2dError, ArithmeticError, AttributeError, TypeError, ValueError):
                self._left(wish.client)  # no camera: nothing is drawn for this browser before it looks from somewhere
                continue
            try:
                drawn = render()(camera, kind)
                depth = np.minimum(drawn.depth / self._frame.unit, FARTHEST)
                wish.client.scene.set_background_image(
                    drawn.image, format="jpeg", jpeg_quality=90 if sharp else 60, depth=depth
                )
            except Exception as error:
                if wish.client.client_id not in self._server.get_clients():
                    continue  # its browser went away while it was drawn for
                self.failure = error  # told by the main thread, in which this one cannot raise
                return


def camera_of(view: Any, frame: ViewerFrame, most_pixels: int) -> Camera:
    """Return a browser's camera, with as many pixels as allowed; viser's look along +z with y down, as ours.

    ``view`` has ``wxyz``, ``position``, ``fov`` (vertical, radians), ``image_width`` and ``image_height``.
    """
    from scipy.spatial.transform import Rotation

    numbers = np.array([*view.wxyz, *view.position, view.fov, view.image_width, view.image_height], np.float64)
    if not np.isfinite(numbers).all() or not 0 < view.fov < np.pi:
        raise ShapeError(f"a camera with finite numbers and an angle between 0 and pi was expected, got {numbers}")
    width, height = max(int(view.image_width), 1), max(int(view.image_height), 1)
    shrink = min(1.0, (most_pixels / (width * height)) ** 0.5)
    width, height = max(round(width * shrink), 1), max(round(height * shrink), 1)
    w, x, y, z = view.wxyz
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix().T
    T[:3, 3] = -T[:3, :3] @ frame.outside(view.position)
    focal = 0.5 * height / np.tan(0.5 * float(view.fov))
    return Camera(width, height, focal, focal, width / 2, height / 2, T)
