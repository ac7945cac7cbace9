"""A training in the browser while it runs. Training never waits for it, and no bit of the result depends on it.

Three threads touch it. The training thread copies the splats at events at which the state is whole, if a browser looks
and the last refresh is long enough ago, and between two iterations draws the exact pictures that were asked for: the
rasterizer is never used by two threads. A thread of its own turns copies into previews and hands them to the server.
The viewer's thread that wants an exact picture waits for its turn.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.core.transforms import up_direction
from gs2d.pipeline.events import Event, Notice, OnEvent, Phase, Step
from gs2d.pipeline.job import Job
from gs2d.pipeline.observer import TrainingObserver
from gs2d.pipeline.options import TrainOptions
from gs2d.pipeline.view import drawn, frame_around, shots
from gs2d.training import events as train_events
from gs2d.training.state import TrainState
from gs2d.viewer.exact import Drawn, Render
from gs2d.viewer.server import Viewer, ViewerStage
from gs2d.viewer.splats import Preview, preview

HOST = "127.0.0.1"  # from another machine: ssh -L
NOW = "now"
MIN_SECONDS = 2.0  # between two refreshes
MAX_FRACTION = 0.03  # of one thread's time may go into refreshes
COLOUR_CAMERAS = 2  # from which a splat's colour is averaged: fewer than for a finished run, it is done again and again
STATUS_SECONDS = 0.5
LAST_WORDS_SECONDS = 0.3  # until the page has what is said at the end
_NOTHING = Preview(1.0, *(np.zeros((0, *shape), np.float32) for shape in ((3,), (3, 3), (3,), (1,))))


class Live(TrainingObserver):
    """Shows a training; open it with :func:`open_live`."""

    def __init__(self, viewer: Viewer, job: Job, tell: OnEvent) -> None:
        self._viewer, self._job, self._tell = viewer, job, tell
        self._cameras = [view.camera for view in job.scene.train]
        self._asked: deque[tuple[Callable[[], Drawn], Future[Drawn]]] = deque()
        self._newest: Splats | None = None  # a copy that waits for the preview thread
        self._changed = threading.Condition()
        self._closed = self._paused = self._told = False
        self._failure: Exception | None = None
        self._refresh_at, self._copied, self._status_at = 0.0, 0.0, 0.0
        self._phase, self._total, self._psnr = "", 0, ""
        self._say = viewer.add_status("training begins")
        viewer.add_stages({NOW: ViewerStage(lambda: _NOTHING, lambda: self._renderer(None))})
        viewer.add_switch("pause training", self._pause)
        self._thread = threading.Thread(target=self._refresh, name="gs2d live", daemon=True)
        self._thread.start()

    # -- the training thread -------------------------------------------------------------------------------------------
    def on_event(self, event: Event) -> None:
        """Pass an event of the pipeline on; the page says what is done."""
        if isinstance(event, Phase):
            self._phase, self._total = event.name, event.total
            self._status(f"**{event.name}**", at_once=True)
        elif isinstance(event, Step) and event.detail:
            self._status(f"**{self._phase}** {event.done:,}/{self._total:,}<br>{event.detail}{self._psnr}")
        self._tell(event)
        failure = self._failure or self._viewer.failure
        if failure is not None and not self._told:
            self._told = True
            self._tell(Notice(f"the viewer stopped, training goes on: {type(failure).__name__}: {failure}"))
        if not (isinstance(event, Step) and event.detail):  # those of training have their turn off the clock
            self.turn()

    def on_training_event(self, event: train_events.Event, state: TrainState) -> None:
        """Copy the splats if it is time to; the state is whole at every event."""
        if not isinstance(event, train_events.Progress | train_events.StageStarted):
            return
        now = time.perf_counter()
        if now < self._refresh_at or not self._viewer.watchers or self._failure is not None:
            return
        self._refresh_at = float("inf")  # until the preview thread has shown this one
        splats = Splats(**{name: tensor.detach().to("cpu", copy=True) for name, tensor in state.splats.items()})
        self._copied = time.perf_counter() - now
        with self._changed:
            self._newest = splats
            self._changed.notify()

    def scored(self, psnr: float | None) -> None:
        """Take the mean PSNR of the probe views."""
        self._psnr = "" if psnr is None else f"<br>PSNR {psnr:.2f} dB"

    @property
    def waiting(self) -> bool:
        """Whether there is something to do in a turn."""
        return bool(self._asked) or self._paused

    def turn(self) -> None:
        """Draw what browsers ask for; return when nothing is asked for, and nobody who looks wants a pause."""
        while True:
            while self._asked:
                draw, image = self._asked.popleft()
                try:
                    image.set_result(draw())
                except BaseException as error:
                    image.set_exception(error)
                    if not isinstance(error, Exception):
                        raise
            if not (self._paused and self._viewer.watchers):
                return
            time.sleep(0.02)

    def _status(self, text: str, *, at_once: bool = False) -> None:
        now = time.perf_counter()
        if at_once or now - self._status_at >= STATUS_SECONDS:
            self._status_at = now
            self._say(text)

    # -- the viewer's threads ------------------------------------------------------------------------------------------
    def _pause(self, wanted: bool) -> None:
        self._paused = wanted

    def _renderer(self, splats: Splats | None) -> Render:
        settings, backend, depth = self._job.settings, self._job.backend, self._job.protocol.depth

        def render(camera: Camera, kind: str) -> Drawn:
            if splats is None:
                size = (camera.height, camera.width)
                return Drawn(np.full((*size, 3), 255, np.uint8), np.full(size, np.inf, np.float32))
            return self._in_turn(lambda: drawn(splats.to(backend.device), camera, kind, settings, backend, depth))

        return render

    def _in_turn(self, draw: Callable[[], Drawn]) -> Drawn:
        image: Future[Drawn] = Future()
        with self._changed:
            if self._closed:
                raise RuntimeError("training has ended")
            self._asked.append((draw, image))
        return image.result()

    # -- the preview thread --------------------------------------------------------------------------------------------
    def _refresh(self) -> None:
        some = self._cameras[:: max(1, len(self._cameras) // COLOUR_CAMERAS)][:COLOUR_CAMERAS]
        while True:
            with self._changed:
                while self._newest is None and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                splats, self._newest = self._newest, None
            begun = time.thread_time()  # of this thread: it waits where the cores are busy
            try:
                self._show(splats, some)
            except Exception as error:
                self._failure = error  # told by the training thread
                return
            taken = self._copied + time.thread_time() - begun
            self._refresh_at = time.perf_counter() + max(MIN_SECONDS, taken / MAX_FRACTION)

    def _show(self, splats: Splats | None, cameras: Sequence[Camera]) -> None:
        if splats is not None:
            found = preview(splats, cameras)
            self._viewer.replace_stage(NOW, ViewerStage(lambda: found, lambda: self._renderer(splats)))

    # -- the end -------------------------------------------------------------------------------------------------------
    def close(self, text: str) -> None:
        """Say how it ended, and stop serving."""
        self._say(text)
        self._viewer.flush()
        if self._viewer.watchers:
            time.sleep(LAST_WORDS_SECONDS)
        with self._changed:
            self._closed = True
            self._changed.notify()
            while self._asked:
                self._asked.popleft()[1].set_exception(RuntimeError("training has ended"))
        self._thread.join(timeout=5)
        self._viewer.close()


def open_live(job: Job, options: TrainOptions, on_event: OnEvent) -> Live:
    """Serve a page for a training that is about to begin.

    Raises
    ------
    BackendError
        viser is not installed, or the port is taken.
    """
    cameras = [view.camera for view in job.scene.train]
    centers = np.zeros((0, 3)) if job.scene.points is None else job.scene.points.points
    frame = frame_around(cameras, centers)
    title = f"gs2d: {options.title or job.scene.name}"
    viewer = Viewer(title=title, host=HOST, port=options.viewer_port, frame=frame, up=up_direction(cameras))
    try:
        live = Live(viewer, job, on_event)
        viewer.add_cameras(shots(job.scene.train, job.settings, on_event))
        viewer.look_from(cameras[0], frame.origin)
    except BaseException:
        viewer.close()
        raise
    on_event(Notice(f"watch it at {viewer.url}"))
    return live
