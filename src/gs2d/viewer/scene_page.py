"""The page that shows splats, mesh and photographs in a browser, as one file or served.

The page consists of the files in ``web_assets``: HTML, WebGL 2 shaders and scripts without libraries. The shaders
implement the rasterizer's contract (``render/api.py``) in float32. :func:`write_page` embeds all data in one file that
opens offline; :func:`served_page` returns the same page without data, which it then requests from its server.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.atomic_files import atomic_write
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.core.text import printable
from gs2d.data.subject_box import OBJECT, Subject
from gs2d.render.types import NEAR_PLANE_POLICIES, RasterSettings
from gs2d.viewer.opening_view import guessed_subject, opening_camera, photographed_arc
from gs2d.viewer.packed_splats import PackedSplats, pack_splats
from gs2d.viewer.page_server import Response

SHADERS = ("splat.vert", "splat.frag", "final.vert", "final.frag", "mesh.vert", "mesh.frag")
SCRIPTS = ("camera.js", "data.js", "splats.js", "mesh.js", "photographs.js", "measure.js", "controls.js", "main.js")
SCENE_MARGIN = 0.5  # a scene is cropped to the box of its surface, enlarged by this share of its size on each side


@dataclass(frozen=True, eq=False)
class PageView:
    """A photograph's name and camera."""

    name: str
    camera: Camera


@dataclass(frozen=True, eq=False)
class WorldScale:
    """Metres per unit of the splats, and the rotation [3, 3] to axes with z up."""

    metres: float
    rotation: np.ndarray

    def to_json(self) -> dict[str, Any]:
        """Return the scale as the page reads it, the rotation row by row."""
        return {"metres": self.metres, "rotation": self.rotation.flatten().tolist()}


@dataclass(frozen=True, eq=False)
class PageScene:
    """The content of a page, except splats, meshes and photographs."""

    title: str
    views: Sequence[PageView]  # at least one
    settings: RasterSettings  # the settings of the training
    focus: np.ndarray  # [3] world units: the point that the views look at, origin of the page's coordinates
    unit: float  # world units: typical distance between the views and ``focus``
    up: np.ndarray  # [3]: unit vector
    subject: Subject | None = None  # the page opens at it; None: guessed from the cameras
    world: WorldScale | None = None  # scale for measurements in metres; None: in units of the capture
    # False: there are no photographs; ``views`` is the opening view only, and all directions are allowed.
    is_photographed: bool = True


@dataclass(frozen=True)
class PageOffer:
    """The data that a page can request."""

    meshes: Sequence[str] = ()  # "mesh" (vertex colours) and "textured", as far as they exist
    photographs: bool = False  # whether there is a photograph for each view
    served: bool = True  # whether the data come from a server; False: they are embedded in the page
    stages: Sequence[str] = ()  # stages whose splats a server offers
    live: bool = False  # whether the splats change


def write_page(
    path: str | os.PathLike[str],
    splats: Splats,
    scene: PageScene,
    *,
    meshes: Mapping[str, bytes] | None = None,
    photographs: Sequence[bytes] = (),
) -> dict[str, Any]:
    """Write the page with its data as one file; return ``splats`` stored, ``sh_degree``, and ``bytes`` of the file.

    ``meshes``: ``meshing.web_mesh`` blocks, by the names of :class:`PageOffer`. ``photographs``: JPEG files, one per
    view.
    """
    meshes = meshes or {}
    packed = pack_for(scene, splats)
    offer = PageOffer(tuple(meshes), bool(photographs), served=False)
    before, after = _page(scene, packed.metadata, offer)
    written = 0
    with atomic_write(Path(path)) as file:
        written += file.write(before)
        for name, block in meshes.items():
            written += file.write(_data_element(name, base64.b64encode(gzip.compress(block, mtime=0))))
        if photographs:
            written += file.write(_data_element("photographs", b"\n".join(map(base64.b64encode, photographs))))
        for piece in _splats_element(packed):
            written += file.write(piece)
        written += file.write(after)
    return {"splats": packed.count, "sh_degree": packed.degree, "bytes": written}


def pack_for(scene: PageScene, splats: Splats) -> PackedSplats:
    """Return splats as the page of a scene reads them; SH of degree 3, 2, 1, 0 take 45, 24, 9 or 0 bytes per splat."""
    settings = scene.settings
    eyes = np.array([view.camera.center for view in scene.views])
    return pack_splats(splats, scene.focus, settings.sh_degree, settings.alpha_min, eyes)


def served_page(scene: PageScene, offer: PageOffer) -> bytes:
    """Return the page without data; it requests the data of ``offer`` from its server."""
    no_splats = {"splats": 0, "degree": 0, "texels": 0, "scales": [0.0] * 15}
    return b"".join(_page(scene, no_splats, offer))


def splats_response(packed: PackedSplats) -> Response:
    """Return splats as a served page requests them: the bytes as the body, their metadata as a header."""
    return Response("application/octet-stream", packed.data, {"X-Splats": json.dumps(packed.metadata, allow_nan=False)})


def _page(scene: PageScene, splats: Mapping[str, Any], offer: PageOffer) -> tuple[bytes, bytes]:
    """Return the parts of the page before and after its data."""
    subject = scene.subject
    if subject is None:
        subject = guessed_subject([view.camera for view in scene.views], scene.focus, scene.unit, scene.up)
    metadata = json.dumps({**splats, **_metadata(scene, subject), "offer": asdict(offer)}, allow_nan=False)
    background = scene.settings.background
    is_dark = sum(background) < 1.5
    values = {
        "title": html.escape(printable(scene.title)),
        "splats": f"{splats['splats']:,}",
        "connect": "connect-src 'self'; " if offer.served else "",
        "images": "img-src 'self' data:" if offer.served else "img-src data:",
        "icon": '<link rel="icon" href="data:,">' if offer.served else "",  # browsers would request one
        "background": "#" + "".join(f"{round(255 * part):02x}" for part in background),
        "ink": "#eee" if is_dark else "#222",
        "on_ink": "#222" if is_dark else "#fff",
        "paper": "rgba(0,0,0,.55)" if is_dark else "rgba(255,255,255,.75)",
        "panel": "rgba(24,26,30,.93)" if is_dark else "rgba(255,255,255,.95)",
        "crop_rows": "\n".join(map(_crop_row, range(3))),
        "facts": metadata.replace("<", "\\u003c"),
        "style": _asset("page.css"),
        "shaders": "\n".join(f'<script type="x-shader" id="{name}">\n{_asset(name)}\n</script>' for name in SHADERS),
        "sorter": _asset("sorter.js"),
        "scripts": "\n\n".join(map(_asset, SCRIPTS)),
    }
    before, after = (
        re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], part).encode()
        for part in _asset("page.html").split("{{data}}\n")
    )
    return before, after


def _data_element(name: str, text: bytes) -> bytes:
    return b'<script type="application/octet-stream" id="%b">\n%b\n</script>\n' % (name.encode(), text)


def _splats_element(packed: PackedSplats) -> Iterator[bytes]:
    """Yield the splats as base64 of a gzip file in pieces, to limit peak memory."""
    before, after = _data_element("splats", b"|").split(b"|")
    yield before
    rest = b""
    for zipped in packed.zipped():
        rest += zipped
        whole = len(rest) // 3 * 3  # base64 encodes 3 bytes as 4 letters
        yield base64.b64encode(rest[:whole])
        rest = rest[whole:]
    yield base64.b64encode(rest) + after


def _asset(name: str) -> str:
    return (files("gs2d.viewer") / "web_assets" / name).read_text(encoding="utf-8").strip()


def _crop_row(axis: int) -> str:
    """Return the two limits of the crop box along an axis."""
    name = "xyz"[axis]
    inputs = "".join(
        f'<input type="number" data-side="{side}" data-axis="{axis}" aria-label="{word} {name}">'
        for side, word in (("low", "lowest"), ("high", "highest"))
    )
    return f'<div class="row"><b class="{name}" aria-hidden="true">{name}</b>{inputs}</div>'


def _metadata(scene: PageScene, subject: Subject) -> dict[str, Any]:
    """Return the values that the page needs; coordinates are relative to the focus."""
    cameras, settings, origin = [view.camera for view in scene.views], scene.settings, scene.focus
    arc = photographed_arc(cameras if scene.is_photographed else (), subject, scene.up)
    margin = 0.0 if subject.kind == OBJECT else SCENE_MARGIN * (subject.high - subject.low)
    return {
        "near": settings.near,
        "alphaMin": settings.alpha_min,
        "alphaMax": settings.alpha_max,
        "lowpass": settings.clamp_px,
        "mip": settings.mip_px,
        "nearPlanePolicy": NEAR_PLANE_POLICIES.index(settings.near_plane_policy),
        "crossingCutoff": settings.error_cutoff,
        "background": list(settings.background),
        "origin": origin.tolist(),
        "subject": {
            "isObject": subject.kind == OBJECT,
            "isPhotographed": scene.is_photographed,
            "center": (subject.center - origin).tolist(),
            "radius": subject.radius,
            "home": opening_camera(cameras, subject, arc, scene.up),
            "arc": {"middle": arc.middle.tolist(), "half": arc.half, "low": arc.low, "high": arc.high},
        },
        "crop": {"low": (subject.low - margin - origin).tolist(), "high": (subject.high + margin - origin).tolist()},
        "unit": scene.unit,
        "up": scene.up.tolist(),
        "cameras": [_camera(view, origin) for view in scene.views],
        "world": None if scene.world is None else scene.world.to_json(),
    }


def _camera(view: PageView, origin: np.ndarray) -> dict[str, Any]:
    camera = view.camera
    translation = camera.rotation @ origin + camera.T_cam_world[:3, 3]
    intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    size = {"w": camera.width, "h": camera.height}
    return {"name": view.name, **size, **intrinsics, "R": camera.rotation.flatten().tolist(), "t": translation.tolist()}
