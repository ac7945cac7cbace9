"""A viewer in the browser, served from this machine (extra ``view``: viser): splats, mesh, cameras, exact renderings.

Nothing is fetched from elsewhere: the page is a part of viser, and what it shows comes from here.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from gs2d.core.camera import Camera
from gs2d.core.extras import install
from gs2d.core.georeference import Georeference
from gs2d.core.transforms import focus_point
from gs2d.errors import BackendError, Gs2dError
from gs2d.viewer.clip import ClipBox
from gs2d.viewer.exact import ExactImages, Render, ViewerFrame
from gs2d.viewer.guard import Guard, guarded
from gs2d.viewer.ruler import Ruler
from gs2d.viewer.splats import Preview

DEFAULT_PORT = 8080
IMAGES = ("preview", "exact", "normals", "depth")  # what is drawn of the splats
THUMBNAIL = 160  # px, longer side
NEAREST = 1e-3  # of the scene's size: what is nearer to the eye is not drawn
STEP_BACK = 2.0  # times as far from the middle as a photograph
_TRIED_PORTS = 100


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph to stand in the scene.

    Attributes
    ----------
    name : str
    camera : Camera
    thumbnail : ndarray [h, w, 3] uint8
    """

    name: str
    camera: Camera
    thumbnail: np.ndarray


@dataclass(frozen=True, eq=False)
class ViewerStage:
    """Splats at some point of training, made when they are asked for."""

    preview: Callable[[], Preview]
    render: Callable[[], Render]


def required_viser() -> Any:
    """Return the package viser.

    Raises
    ------
    BackendError
        It is not installed.
    """
    try:
        return importlib.import_module("viser")
    except ModuleNotFoundError as error:
        raise BackendError(f"the viewer needs {error.name}, which is not installed; {install('view')}") from error


def free_port(host: str, port: int | None, *, option: str = "--port") -> int:
    """``port`` if nobody listens there; without one the first free one from 8080 on. ``option`` is what sets it.

    Raises
    ------
    BackendError
        Taken, or no address of this machine.
    """
    wanted = [port] if port is not None else list(range(DEFAULT_PORT, DEFAULT_PORT + _TRIED_PORTS))
    reason = ""
    for number in wanted:
        if not 1 <= number <= 65535:
            raise BackendError(f"{option} must be 1 to 65535, got {number}")
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
                return number
        except OSError as error:
            reason = error.strerror or str(error)
    tried = f"port {port}" if port is not None else f"ports {wanted[0]} to {wanted[-1]}"
    raise BackendError(f"a free port on {host} was expected, {tried}: {reason}; choose another {option}")


def thumbnail(image: np.ndarray, background: Sequence[float]) -> np.ndarray:
    """Return a photograph [H, W, 3 or 4] uint8, small and without alpha."""
    picture = Image.fromarray(image)
    picture.thumbnail((THUMBNAIL, THUMBNAIL), Image.Resampling.BOX)
    if picture.mode == "RGBA":
        behind = Image.new("RGBA", picture.size, tuple(round(255 * channel) for channel in background))
        picture = Image.alpha_composite(behind, picture)
    return np.asarray(picture.convert("RGB"))


class Viewer:
    """A server with one scene; every browser that opens its address, token and all, sees it.

    Parameters
    ----------
    title : str
    host : str
    port : int or None
        None: the first free one from 8080 on.
    frame : ViewerFrame
        Which part of the world is the viewer's: its camera, its depths and its numbers are made for scenes of size 1.
    up : ndarray [3]
    """

    def __init__(self, *, title: str, host: str, port: int | None, frame: ViewerFrame, up: np.ndarray) -> None:
        viser = required_viser()
        self._frame = frame
        self.host, self.port = host, free_port(host, port)
        self._guard = Guard()
        # it shows its addresses, whatever `verbose` says
        with contextlib.redirect_stdout(io.StringIO()), guarded(self._guard):
            self._server = viser.ViserServer(host=host, port=self.port, label=title, verbose=False)
        if not self._guard.installed:
            self._server.stop()
            raise BackendError(
                f"a viser that can be served through a gate was expected, got {viser.__version__}, which anybody could "
                f"look at; {install('view')}"
            )
        # viser has no public way from the name in a message to its widget
        self._guard.control = self._server.gui._gui_input_handle_from_uuid.get
        self._server.gui.configure_theme(show_share_button=False, show_logo=False)  # nothing leaves this machine
        self._server.scene.set_up_direction(tuple(up))
        self._nodes: dict[str, list[Any]] = {}
        self._splats: Any = None
        self._exact: ExactImages | None = None
        self._stages: dict[str, ViewerStage] = {}
        self._preview: Preview | None = None
        self.clip: ClipBox | None = None
        self.ruler: Ruler | None = None
        self._showing = (
            threading.Lock()
        )  # held by whoever changes the splats: browsers' threads, and that of a training

    @property
    def url(self) -> str:
        """Where the page is, with the token without which nothing is shown."""
        shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self.host, self.host)
        place = f"http://{f'[{shown}]' if ':' in shown and shown[0] != '[' else shown}:{self.port}"
        return f"{place}/?token={self._guard.token}"

    @property
    def token(self) -> str:
        """What a browser must know to be let in."""
        return self._guard.token

    @property
    def nodes(self) -> Mapping[str, Sequence[Any]]:
        """What is in the scene, by kind: "splats", "mesh", "cameras"."""
        return {**self._nodes, **({} if self._splats is None else {"splats": [self._splats]})}

    def look_from(self, camera: Camera, target: np.ndarray) -> None:
        """Where a browser looks from when it opens the page: from behind a camera, so that the camera is seen too."""
        start, behind = self._server.initial_camera, target + STEP_BACK * (camera.center - target)
        start.position, start.look_at = self._frame.inside(behind), self._frame.inside(target)
        start.fov = field_of_view(camera)
        start.near = NEAREST

    def add_stages(self, stages: Mapping[str, ViewerStage]) -> None:
        """Splats to choose from; the last ones are shown first."""
        gui, names = self._server.gui, list(stages)
        self._stages = dict(stages)
        self._chosen = gui.add_dropdown("stage", names, initial_value=names[-1], visible=len(names) > 1)
        self._drawn = gui.add_dropdown("splats", [*IMAGES, "none"], initial_value="preview")
        self._exact = ExactImages(self._server, self._frame, stages[names[-1]].render)

        def choose(_: Any) -> None:
            try:
                self._show(load=True)
            except Gs2dError as error:  # a checkpoint that cannot be read: what was shown stays
                for client in self._server.get_clients().values():
                    client.add_notification("This stage cannot be shown", str(error), color="red")

        self._show(load=True)
        self._chosen.on_update(choose)
        self._drawn.on_update(lambda _: self._show(load=False))

    def replace_stage(self, name: str, stage: ViewerStage) -> None:
        """Other splats under a name that there is; shown at once where it is the one that is looked at."""
        self._stages[name] = stage
        if self._chosen.value == name:
            self._show(load=True)

    def _show(self, *, load: bool) -> None:
        assert self._exact is not None
        with self._showing:
            stage, drawn = self._stages[self._chosen.value], self._drawn.value
            if load:
                self._preview = stage.preview()
                self._show_splats(self._preview, visible=drawn == "preview")
                self._exact.scene(stage.render)
            elif self._splats is not None:
                self._splats.visible = drawn == "preview"
            self._exact.draw(drawn if drawn in IMAGES[1:] else None)

    def _show_splats(self, splats: Preview, *, visible: bool) -> None:
        splats = splats if self.clip is None else self.clip.clipped(splats)
        with self._server.atomic():
            if self._splats is not None:
                self._splats.remove()
            self._splats = self._server.scene.add_gaussian_splats(
                "/splats",
                centers=splats.centers,
                covariances=splats.covariances,
                rgbs=splats.colors,
                opacities=splats.opacities,
                scale=splats.scale / self._frame.unit,
                position=self._frame.inside(np.zeros(3)),
                visible=visible,
            )

    def add_clip_box(self, box: np.ndarray, source: str, *, of_run: bool) -> None:
        """Sliders for a box [2, 3] world units that clips the preview, and the commands that cut ``source`` to it."""

        def show() -> None:
            with self._showing:
                if self._preview is not None:
                    self._show_splats(self._preview, visible=self._drawn.value == "preview")

        self.clip = ClipBox(self._server, self._frame, box, source, show, of_run=of_run)

    def add_ruler(self, source: str, *, of_run: bool, world: Georeference | None) -> None:
        """Add what measures distances on the splats that are shown, in metres where ``world`` is known."""

        def shown() -> Render:
            return self._stages[self._chosen.value].render()

        self.ruler = Ruler(self._server, self._frame, shown, source, of_run=of_run, world=world)

    def add_status(self, text: str) -> Callable[[str], None]:
        """Return a line of text above all else, in Markdown; returns what changes it."""
        line = self._server.gui.add_markdown(text, order=-1)
        return lambda changed: setattr(line, "content", changed)

    def add_switch(self, label: str, on_change: Callable[[bool], None]) -> None:
        """Add a box that is off at first."""
        box = self._server.gui.add_checkbox(label, initial_value=False)
        box.on_update(lambda _: on_change(bool(box.value)))

    @property
    def watchers(self) -> int:
        """Browsers that look at it."""
        return len(self._server.get_clients())

    def flush(self) -> None:
        """Send what was changed."""
        self._server.flush()

    def add_mesh(self, glb: bytes, turn: Sequence[float]) -> None:
        """Add a mesh (.glb) whose own ``turn`` (x, y, z, w) is undone: the scene is in the capture's frame."""
        x, y, z, w = turn
        node = self._server.scene.add_glb(
            "/mesh",
            glb,
            scale=1 / self._frame.unit,
            wxyz=(w, -x, -y, -z),
            position=self._frame.inside(np.zeros(3)),
            visible=False,
        )
        self._nodes["mesh"] = [node]
        box = self._server.gui.add_checkbox("mesh", initial_value=False)
        box.on_update(lambda _: setattr(node, "visible", box.value))

    def add_cameras(self, shots: Sequence[Shot]) -> None:
        """Photographs where they were taken; a click goes there."""
        if not shots:
            return
        cameras = [shot.camera for shot in shots]
        side = 0.25 * _spacing(np.array([self._frame.inside(camera.center) for camera in cameras]))
        self._nodes["cameras"] = [self._frustum(f"/cameras/{i:05d}", shot, side) for i, shot in enumerate(shots)]
        box = self._server.gui.add_checkbox("cameras", initial_value=True)
        size = self._server.gui.add_slider("camera size", min=0.1, max=4.0, step=0.05, initial_value=1.0)

        def update(_: Any) -> None:
            with self._server.atomic():
                for node in self._nodes["cameras"]:
                    node.visible, node.scale = box.value, side * size.value

        box.on_update(update)
        size.on_update(update)

    def _frustum(self, name: str, shot: Shot, side: float) -> Any:
        camera = shot.camera
        node = self._server.scene.add_camera_frustum(
            name,
            fov=field_of_view(camera),
            aspect=camera.width / camera.fx * camera.fy / camera.height,
            scale=side,
            thickness=1.5,
            thickness_units="screen",
            image=shot.thumbnail,
            wxyz=quaternion(camera.rotation.T),
            position=self._frame.inside(camera.center),
        )

        def go(event: Any) -> None:
            client = event.client
            if client is not None:
                with client.atomic():
                    client.camera.position = self._frame.inside(camera.center)
                    client.camera.wxyz = quaternion(camera.rotation.T)

        node.on_click(go)
        return node

    @property
    def failure(self) -> Exception | None:
        """Why no more exact pictures are drawn, if none are."""
        return None if self._exact is None else self._exact.failure

    def close(self) -> None:
        """Stop serving."""
        if self._exact is not None:
            self._exact.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()


def _spacing(centers: np.ndarray) -> float:
    """Return a typical distance between neighbours [V, 3]; of one camera 1."""
    if len(centers) < 2:
        return 1.0
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return max(float(np.median(distance.min(axis=1))), float(np.ptp(centers, axis=0).max()) * 0.01, 1e-9)


def field_of_view(camera: Camera) -> float:
    """Return the vertical angle, radians."""
    return float(2 * np.arctan(camera.height / 2 / camera.fy))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return a rotation matrix [3, 3] as w, x, y, z."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])


def middle_of(cameras: Sequence[Camera], centers: np.ndarray) -> np.ndarray:
    """Return what to look at first: what the cameras look at, else the middle of the splats' centres [N, 3]."""
    if len(cameras) > 1:
        return focus_point(list(cameras))
    return np.asarray(np.median(centers, axis=0) if len(centers) else np.zeros(3), np.float64)
