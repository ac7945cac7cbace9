"""``--viewer``: the page of a training while it runs. It does not change the result, and training never waits for it.

The training thread copies the splats if a browser polls the page, has fetched the previous copy, and that copy is old
enough. A thread of the server packs the copy when a browser fetches it.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Mapping

import numpy as np

from gs2d.core.splats import Splats
from gs2d.errors import DataError
from gs2d.pipeline.look.page import page_scene, some_views
from gs2d.pipeline.look.view import photographs_route
from gs2d.pipeline.prepare.loaded import LoadedRun
from gs2d.training.events import Event, Notice, OnEvent, Phase, Progress, StageStarted, Step, TrainingEvent
from gs2d.training.state import TrainState
from gs2d.viewer.packed_splats import PackedSplats
from gs2d.viewer.page_server import PageServer, Response
from gs2d.viewer.scene_page import PageOffer, pack_for, served_page, splats_response

WATCHED = 5.0  # s after a poll during which a page counts as open; it polls every second
MIN_SECONDS = 2.0  # between two copies
MAX_FRACTION = 0.03  # of the time of one thread, for copying and packing


class Live:
    """Serves the page of a training. Raises BackendError if the port is taken."""

    def __init__(self, loaded: LoadedRun, on_event: OnEvent) -> None:
        self._forward = on_event
        self._lock = threading.Lock()  # of _copy and _packed
        self._copy: Splats | None = None
        self._packed: PackedSplats | None = None
        self._version = 0
        self._polled = -math.inf  # time of the last poll
        self._copy_at, self._copied = 0.0, 0.0
        self._phase, self._total, self._status, self._psnr = "", 0, "training begins", ""
        self._reported = False
        views = some_views(loaded.scene.train)
        points = np.zeros((0, 3)) if loaded.scene.points is None else loaded.scene.points.points
        self._scene = page_scene(loaded.resolved.title or loaded.scene.name, views, loaded.settings, points)
        page = served_page(self._scene, PageOffer(photographs=True, live=True))
        routes = {
            "": lambda _: Response("text/html; charset=utf-8", [page]),
            "state": self._state_response,
            "splats": self._splats_response,
            "photograph": photographs_route(views, loaded.settings.background),
        }
        self._server = PageServer(loaded.resolved.execution.viewer or None, routes, option="--viewer")
        on_event(Notice(f"watch it at {self._server.url}"))

    # -- the training thread -------------------------------------------------------------------------------------------
    def on_event(self, event: Event) -> None:
        """Forward an event of the pipeline, and show it in the status of the page."""
        if isinstance(event, Phase):
            self._phase, self._total, self._status = event.name, event.total, event.name
        elif isinstance(event, Step) and event.detail:
            self._status = f"{self._phase} {event.done:,}/{self._total:,}  {event.detail}{self._psnr}"
        self._forward(event)
        failure = self._server.failure
        if failure is not None and not self._reported:
            self._reported = True
            self._forward(Notice(f"the viewer failed, training continues: {type(failure).__name__}: {failure}"))

    def on_training_event(self, event: TrainingEvent, state: TrainState, psnr: float | None) -> None:
        """Copy the splats if a copy is due. ``psnr`` is that of the probe views."""
        self._psnr = "" if psnr is None else f"  PSNR {psnr:.2f} dB"
        now = time.monotonic()
        if not isinstance(event, Progress | StageStarted) or now < self._copy_at:
            return
        if now - self._polled > WATCHED or self._server.failure is not None:
            return
        try:
            copy = Splats(**{name: tensor.detach().to("cpu", copy=True) for name, tensor in state.splats.items()})
        except (MemoryError, RuntimeError) as error:  # RuntimeError: torch is out of memory
            self._server.failure = error
            return
        with self._lock:  # not packed at the same time: _copy_at is infinite meanwhile
            self._copy, self._packed = copy, None
            self._version += 1
            self._copied, self._copy_at = time.monotonic() - now, math.inf  # until it was fetched

    def close(self) -> None:
        """Stop serving."""
        self._server.close()

    # -- the server's threads ------------------------------------------------------------------------------------------
    def _state_response(self, _: Mapping[str, str]) -> Response:
        self._polled = time.monotonic()
        state = {"version": self._version, "status": self._status}
        return Response("application/json", [json.dumps(state).encode()])

    def _splats_response(self, _: Mapping[str, str]) -> Response:
        with self._lock:
            if self._copy is not None:
                began = time.thread_time()  # not the time that it waits for a core
                self._packed = pack_for(self._scene, self._copy)
                self._copy = None
                seconds = self._copied + time.thread_time() - began
                self._copy_at = time.monotonic() + max(MIN_SECONDS, seconds / MAX_FRACTION)
            if self._packed is None:
                raise DataError("there are no splats yet")
            return splats_response(self._packed)
