"""``gs2d view``: the page of a run, or of a file of splats, served on this machine."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path

from PIL import Image

from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.errors import DataError
from gs2d.io.meshes import glb_bytes, read_mesh
from gs2d.io.run_dir import MESH, TEXTURED, RunFolder, load_tensors
from gs2d.pipeline.look.page import page_content
from gs2d.report.images import valid_image
from gs2d.training.events import OnEvent, Step, ignore
from gs2d.training.state import TrainState
from gs2d.viewer.server import Answer, PageServer, Route, number_in
from gs2d.viewer.web import Packed, PageScene, Served, pack, served_page, splats_answer

FINAL = "final"
IMAGE_SIDE = 640  # px, longer side of the image of a view
_TICK = 0.2  # s between looks at Ctrl-C


def open_viewer(path: Path, port: int | None = None, on_event: OnEvent = ignore) -> tuple[PageServer, list[str]]:
    """Start to serve a run, or a file of splats; ``close`` the server at the end.

    Returns
    -------
    server : PageServer
    shown : list of str
        What there is to see: "cameras", "mesh", "splats".
    """
    content = page_content(path, on_event)
    stages: dict[str, Callable[[], Splats]] = {FINAL: lambda: content.splats}
    mesh: Callable[[], bytes] | None = None
    if content.run is not None:
        ends = [checkpoint for checkpoint in content.run.checkpoints() if checkpoint.iteration is None]
        earlier = {end.stage: partial(_splats_of, end.path) for end in ends[:-1]}  # the last one is splats.ply
        stages, mesh = {**earlier, **stages}, _mesh_of(content.run)
    has_images = bool(content.photographs)
    page = served_page(content.scene, Served(list(stages), mesh is not None, has_images))
    routes: dict[str, Route] = {
        "": lambda _: Answer("text/html; charset=utf-8", [page]),
        "splats": _stages_route(stages, content.scene),
        "image": images_route(content.photographs, content.scene.settings.background),
    }
    if mesh is not None:
        routes["mesh"] = lambda _: Answer("model/gltf-binary", [mesh()])
    shown = [*(["cameras"] if has_images else []), *(["mesh"] if mesh else []), "splats"]
    return PageServer(port, routes), shown


def serve(server: PageServer, on_event: OnEvent = ignore) -> None:
    """Wait until KeyboardInterrupt (from ``on_event`` or Ctrl-C), or until a request failed.

    Raises
    ------
    Exception
        The unexpected error of a request.
    """
    while server.failure is None:
        on_event(Step(0))  # where a Ctrl-C that somebody swallowed is raised again
        time.sleep(_TICK)
    raise server.failure


def images_route(views: Sequence[View], background: Sequence[float]) -> Route:
    """Return the route of the views' images, as small JPEG files; transparent ones lie over the background (RGB)."""

    def answer(arguments: Mapping[str, str]) -> Answer:
        view = views[number_in(arguments, "view", len(views))]
        image = Image.fromarray(valid_image(view.image(), view.valid()))
        image.thumbnail((IMAGE_SIDE, IMAGE_SIDE), Image.Resampling.BOX)
        if image.mode == "RGBA":
            behind = Image.new("RGBA", image.size, tuple(round(255 * channel) for channel in background))
            image = Image.alpha_composite(behind, image)
        file = io.BytesIO()
        image.convert("RGB").save(file, "JPEG", quality=90)
        return Answer("image/jpeg", [file.getvalue()])

    return answer


def _stages_route(stages: Mapping[str, Callable[[], Splats]], scene: PageScene) -> Route:
    lock = threading.Lock()

    @lru_cache(maxsize=1)  # one stage in memory
    def packed(stage: str) -> Packed:
        return pack(stages[stage](), scene.focus, scene.settings.sh_degree, scene.settings.alpha_min)

    def answer(arguments: Mapping[str, str]) -> Answer:
        stage = arguments.get("stage", "")
        if stage not in stages:
            raise DataError(f"stage must be one of {', '.join(stages)}, got {stage[:40]!r}")
        with lock:
            return splats_answer(packed(stage))

    return answer


def _splats_of(checkpoint: Path) -> Splats:
    return TrainState.from_state_dict(load_tensors(checkpoint)["state"]).splats


def _mesh_of(run: RunFolder) -> Callable[[], bytes] | None:
    """Return what reads the textured mesh, else the coloured one, as a .glb file; None where there is no mesh."""
    if run.file(TEXTURED).exists():
        return run.file(TEXTURED).read_bytes
    return (lambda: glb_bytes(read_mesh(run.file(MESH)))) if run.file(MESH).exists() else None
