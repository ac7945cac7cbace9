"""A page that draws splats exactly, in one file: HTML, WebGL 2 shaders and the splats themselves, for any browser.

It needs no server, no network and no library: it can be mailed, or put on any web space. The files that it is made of
lie in ``web_assets``; its shaders follow the rasterizer's contract (``render/api.py``), with the browser's float32 and
with attributes that are stored as below. ``viewer/server.py`` serves the same page without the splats
(:func:`served_page`), which then fetches them (:func:`splats_answer`) and whatever else the server offers.
"""

from __future__ import annotations

import base64
import html
import json
import math
import os
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.core.files import atomic_write
from gs2d.core.georeference import Georeference
from gs2d.core.splats import Splats
from gs2d.core.text import printable
from gs2d.data.subject import OBJECT, SCENE, Subject
from gs2d.errors import DataError
from gs2d.render.types import MAX_SIZE, NEAR_PLANE_POLICIES, RasterSettings
from gs2d.viewer.server import Answer

# -- where the page opens ----------------------------------------------------------------------------------------------
ROUND = math.radians(100.0)  # a gap between neighbouring directions from which a capture is one-sided
MARGIN = math.radians(12.0)  # beyond the outermost photographs, sideways and down; splats are still believable there
ABOVE = math.radians(20.0)  # beyond the highest photograph
STEEPEST = math.radians(85.0)
GUESSED_SIZE = 0.3  # of half a side of the box, in distances from which it is seen: about what a picture holds
MOST = 0.8  # of the cameras look at an object
AIMED = 0.5  # cosine of the angle at the camera between its axis and what it looks at, at the least


@dataclass(frozen=True, eq=False)
class Arc:
    """Directions from the subject that were photographed, with a margin.

    Attributes
    ----------
    middle : ndarray [3]
        Unit, across what is up: the middle of the arc.
    half : float, rad
        To both sides of it; pi: all round.
    low, high : float, rad
        Above the horizon.
    """

    middle: np.ndarray
    half: float
    low: float
    high: float


def guessed_subject(cameras: Sequence[Camera], center: np.ndarray, unit: float, up: np.ndarray) -> Subject:
    """Return the subject of a capture of which nothing is known but its cameras.

    Parameters
    ----------
    center : ndarray [3] world units
        What the cameras look at.
    unit : float, world units
        About how far away it is seen from.
    up : ndarray [3]
        Unit.
    """
    size = np.full(3, GUESSED_SIZE * unit)
    aims = [float(camera.rotation[2] @ _unit(center - camera.center)) for camera in cameras]
    round_it = sum(aim > AIMED for aim in aims) > MOST * len(aims)
    why = "about what the cameras look at" if round_it else "the cameras look at no common place"
    return Subject(OBJECT if round_it else SCENE, center - size, center + size, center, up, why)


def photographed_arc(cameras: Sequence[Camera], subject: Subject, up: np.ndarray) -> Arc:
    """Return the directions from which a subject was photographed; every direction for a scene."""
    north = _unit(np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0]))
    if subject.kind != OBJECT or not cameras:
        return Arc(north, np.pi, -STEEPEST, STEEPEST)
    east = np.cross(up, north)
    arms = np.array([camera.center for camera in cameras]) - subject.center  # [V, 3]
    rises = np.arctan2(arms @ up, np.hypot(arms @ north, arms @ east))
    low, high = max(rises.min() - MARGIN, -STEEPEST), min(rises.max() + ABOVE, STEEPEST)
    turns = np.sort(np.arctan2(arms @ east, arms @ north))
    gaps = np.diff(np.append(turns, turns[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] < ROUND:
        return Arc(north, np.pi, float(low), float(high))
    half = (2 * np.pi - float(gaps[widest])) / 2
    middle = turns[(widest + 1) % len(turns)] + half  # the arc begins after the widest gap
    return Arc(np.cos(middle) * north + np.sin(middle) * east, half + float(MARGIN), float(low), float(high))


def home_camera(cameras: Sequence[Camera], subject: Subject, arc: Arc, up: np.ndarray) -> int:
    """Return the index of the photograph from whose place the page opens.

    The most usual one: its direction is near the middle of the photographed arc, its height and distance are near the
    median, and the subject is in the middle of its picture. Where there is no subject, the place nearest to all others.
    """
    places = np.array([camera.center for camera in cameras])
    if subject.kind != OBJECT:
        return int(np.linalg.norm(places[:, None] - places[None], axis=2).sum(axis=1).argmin())
    arms = places - subject.center
    away = np.maximum(np.linalg.norm(arms, axis=1), 1e-12)
    rises = np.arcsin(np.clip(arms @ up / away, -1, 1))
    level = arms - (arms @ up)[:, None] * up
    aside = np.arccos(np.clip(level @ arc.middle / np.maximum(np.linalg.norm(level, axis=1), 1e-12), -1, 1))
    axes = np.stack([camera.rotation[2] for camera in cameras])
    off = np.arccos(np.clip(-(axes * arms).sum(axis=1) / away, -1, 1))
    unusual = np.abs(rises - np.median(rises)) + np.abs(np.log(away / np.median(away))) + 2 * off
    if arc.half < np.pi:
        unusual = unusual + aside
    return int(unusual.argmin())


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))


# -- the page ----------------------------------------------------------------------------------------------------------
PARTS = {  # script elements: id -> file, type
    "splat-vert": ("splat.vert", "x-shader/x-vertex"),
    "splat-frag": ("splat.frag", "x-shader/x-fragment"),
    "final-vert": ("final.vert", "x-shader/x-vertex"),
    "final-frag": ("final.frag", "x-shader/x-fragment"),
    "sorter": ("sorter.js", "text/plain"),
}
SCRIPTS = ("camera.js", "viewer.js", "measure.js", "panel.js")  # one script, in this order
SERVED_PARTS = {  # what a served page has besides
    "mesh-vert": ("mesh.vert", "x-shader/x-vertex"),
    "mesh-frag": ("mesh.frag", "x-shader/x-fragment"),
}
SERVED_SCRIPTS = (*SCRIPTS, "served.js")
HINT = (
    '<span class="mouse">Drag to turn, wheel to come closer, ? for more.</span>'
    '<span class="finger">One finger turns, two fingers come closer and shift.</span>'
)
MAX_SPLATS = 5_000_000  # rows of 2048 texels, 3 a splat: what a texture of 8192 rows, which any GPU has, can hold
CLIPPED = 1e-4  # of the SH coefficients of one place may be cut off: the steps of the others are smaller then
SPLATS_AT_ONCE = 1 << 14  # in 64 bits
PIECE = 1 << 20  # bytes that are zipped and written at once
ZIP_LEVEL = 6
WORD_BYTES = 32  # of a splat, without its SH coefficients above degree 0


@dataclass(frozen=True, eq=False)
class Seen:
    """Where the page may be looked at from: a camera and what it is called."""

    name: str
    camera: Camera


@dataclass(frozen=True, eq=False)
class PageScene:
    """What a page shows, except the splats.

    Attributes
    ----------
    title : str
    views : sequence of Seen
        At least one.
    settings : RasterSettings
        As they were trained with.
    focus : ndarray [3] world units
        What the views look at; places are stored relative to it.
    unit : float, world units
        About how far away it is seen from.
    up : ndarray [3]
        Unit.
    subject : Subject or None
        What is shown first and turned about. None: something around the focus.
    world : Georeference or None
        Where the splats are in the world: the page measures in metres. None: in units of the capture.
    """

    title: str
    views: Sequence[Seen]
    settings: RasterSettings
    focus: np.ndarray
    unit: float
    up: np.ndarray
    subject: Subject | None = None
    world: Georeference | None = None


@dataclass(frozen=True)
class Served:
    """What a served page can fetch, and the controls that it has for it.

    Attributes
    ----------
    stages : sequence of str
        Names of splats to choose from.
    has_mesh : bool
    has_images : bool
        Whether the server has the image of each view.
    is_live : bool
        Whether the splats change.
    """

    stages: Sequence[str] = ()
    has_mesh: bool = False
    has_images: bool = False
    is_live: bool = False


@dataclass(frozen=True, eq=False)
class Packed:
    """Splats as the page stores them.

    Attributes
    ----------
    count : int
    origin : ndarray [3] float64
        The means are relative to it, so that float32 keeps their digits.
    degree : int
    scales : list of 15 floats
        What the value 127 of an 8-bit SH coefficient means, by its place (degree 1 to 3, in order).
    words : ndarray [N, 8] uint32
        Per splat: mean (3 x float32), log scales (2 x float16), unit quaternion w x y z (4 x 16-bit signed,
        32767 = 1), SH of degree 0 (3 x float16), opacity (float16).
    harmonics : ndarray [N, 16 * stored] int8
        Per splat its other SH coefficients, coefficient by coefficient in red, green, blue, filled up to 16 bytes.
    """

    count: int
    origin: np.ndarray
    degree: int
    scales: list[float]
    words: np.ndarray
    harmonics: np.ndarray

    @property
    def data(self) -> list[memoryview]:
        """Words, then harmonics, as bytes."""
        return [array.reshape(-1).view(np.uint8).data for array in (self.words, self.harmonics)]

    def zipped(self) -> Iterator[bytes]:
        """Words, then harmonics, as a gzip file, piece by piece."""
        zipper = zlib.compressobj(ZIP_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
        for flat in self.data:
            for start in range(0, len(flat), PIECE):
                yield zipper.compress(flat[start : start + PIECE])
        yield zipper.flush()

    @property
    def facts(self) -> dict[str, Any]:
        """What a page must know to read the data."""
        return {"splats": self.count, "degree": self.degree, "stored": self.stored, "scales": self.scales}

    @property
    def stored(self) -> int:
        """Texels of 16 bytes that the SH coefficients of a splat take."""
        return texels_of(self.degree)


def texels_of(degree: int) -> int:
    """Texels of 16 bytes that hold the coefficients above degree 0."""
    return math.ceil(3 * ((degree + 1) ** 2 - 1) / 16)


@torch.no_grad()
def pack(splats: Splats, origin: np.ndarray, degree: int, alpha_min: float) -> Packed:
    """Splats as the page stores them; those that nobody can see (not finite, fainter than ``alpha_min``) are left out.

    What is computed in 64 bits is computed of some splats at a time, or a run's memory would peak here.

    Raises
    ------
    DataError
        Too many.
    """
    splats = splats.to("cpu")
    rows = _seen_rows(splats, alpha_min)
    count, degree = len(rows), min(degree, splats.sh_degree)
    if count > MAX_SPLATS:
        raise DataError(f"a page holds at most {MAX_SPLATS:,} splats, got {count:,}; train with a smaller max_splats")
    scales = _harmonic_scales(splats, rows, degree)
    words = np.zeros((count, WORD_BYTES // 4), np.uint32)
    harmonics = np.zeros((count, 16 * texels_of(degree)), np.int8)
    for start in range(0, count, SPLATS_AT_ONCE):
        part, to = splats.rows(rows[start : start + SPLATS_AT_ONCE]).to("cpu", torch.float64), slice(start, None)
        _fill_words(words[to][: len(part)], part, origin)
        _fill_harmonics(harmonics[to][: len(part)], part.shN.numpy(), scales, degree)
    return Packed(count, origin, degree, [float(scale) for scale in scales], words, harmonics)


def _seen_rows(splats: Splats, alpha_min: float) -> torch.Tensor:
    """Return indices of the splats that can be seen."""
    seen = splats.opacity_logits.double().sigmoid() >= alpha_min
    seen &= splats.quats.double().norm(dim=1) > 0
    for _, tensor in splats.items():
        if tensor.numel():
            seen &= tensor.reshape(len(tensor), -1).isfinite().all(dim=1)
    if len(splats):  # rule 23 of the rasterizer, as far as it does not depend on where one stands
        seen &= (splats.means.abs().amax(dim=1) <= MAX_SIZE) & (splats.scales.amax(dim=1) <= MAX_SIZE)
    return seen.nonzero().squeeze(1)


def _fill_words(words: np.ndarray, splats: Splats, origin: np.ndarray) -> None:
    words[:, :3] = (splats.means.numpy() - origin).astype(np.float32).view(np.uint32)
    words[:, 3] = _halves(splats.log_scales)
    quats = torch.nn.functional.normalize(splats.quats, dim=1).numpy()
    words[:, 4:6] = np.round(quats * 32767).astype(np.int16).view(np.uint32)
    light = torch.cat([splats.sh0.reshape(len(splats), 3), splats.opacities[:, None]], dim=1)
    words[:, 6], words[:, 7] = _halves(light[:, :2]), _halves(light[:, 2:])


def _halves(pairs: torch.Tensor) -> np.ndarray:
    """Two columns as one column of words of two 16-bit floats."""
    limited = pairs.clamp(-65000, 65000).numpy().astype(np.float16)
    return np.ascontiguousarray(limited).view(np.uint32)[:, 0]


def _harmonic_scales(splats: Splats, rows: torch.Tensor, degree: int) -> np.ndarray:
    """Scales [15] by place."""
    scales = np.zeros(15)
    for place in range((degree + 1) ** 2 - 1 if len(rows) else 0):
        used = splats.shN[:, place].index_select(0, rows).double().numpy()
        scales[place] = np.quantile(np.abs(used), 1 - CLIPPED)
    return scales


def _fill_harmonics(stored: np.ndarray, shN: np.ndarray, scales: np.ndarray, degree: int) -> None:
    places = (degree + 1) ** 2 - 1
    steps = np.where(scales > 0, scales, 1.0)[:places, None]
    stored[:, : 3 * places] = np.clip(np.round(shN[:, :places] / steps * 127), -127, 127).reshape(len(shN), -1)


def write_page(path: str | os.PathLike[str], splats: Splats, scene: PageScene, *, sh_degree: int = 3) -> dict[str, Any]:
    """Write the page.

    Parameters
    ----------
    path : path
    splats : Splats
    scene : PageScene
    sh_degree : int
        Of the stored coefficients at most: 45, 24, 9 or 0 bytes a splat.

    Returns
    -------
    dict
        ``splats`` stored, ``sh_degree``, and ``bytes`` of the file.
    """
    settings = scene.settings
    packed = pack(splats, scene.focus, min(sh_degree, settings.sh_degree), settings.alpha_min)
    before, after = _around_splats(scene, packed.facts, None)
    written = 0
    with atomic_write(Path(path)) as file:
        for piece in _pieces(before, packed, after):
            written += file.write(piece)
    return {"splats": packed.count, "sh_degree": packed.degree, "bytes": written}


def served_page(scene: PageScene, served: Served) -> bytes:
    """Return the page that a server offers: it fetches the splats and what else ``served`` names."""
    nothing = {"splats": 0, "degree": 0, "stored": 0, "scales": [0.0] * 15}
    return b"".join(_around_splats(scene, nothing, served))


def splats_answer(packed: Packed) -> Answer:
    """Return splats as a served page fetches them: the data uncompressed, what describes it as a header."""
    return Answer("application/octet-stream", packed.data, {"X-Splats": json.dumps(packed.facts, allow_nan=False)})


def _around_splats(scene: PageScene, splats: Mapping[str, Any], served: Served | None) -> tuple[bytes, bytes]:
    """Return the page before and after the splats."""
    subject = scene.subject
    if subject is None:
        subject = guessed_subject([view.camera for view in scene.views], scene.focus, scene.unit, scene.up)
    background = scene.settings.background
    is_dark = sum(background) < 1.5
    facts = json.dumps({**splats, **_facts(scene, subject), "served": served and asdict(served)}, allow_nan=False)
    parts, scripts = PARTS, tuple(SCRIPTS)
    if served is not None:
        parts, scripts = {**PARTS, **SERVED_PARTS}, tuple(SERVED_SCRIPTS)
    values = {
        "title": html.escape(printable(scene.title)),
        "count": f"{splats['splats']:,}",
        "network": "" if served is None else "; connect-src 'self'; img-src 'self' data:",
        "icon": "" if served is None else '<link rel="icon" href="data:,">\n',  # else browsers ask for one
        "background": "#" + "".join(f"{round(255 * part):02x}" for part in background),
        "ink": "#eee" if is_dark else "#222",
        "onink": "#222" if is_dark else "#fff",
        "paper": "rgba(0,0,0,.55)" if is_dark else "rgba(255,255,255,.75)",
        "panel": "rgba(24,26,30,.93)" if is_dark else "rgba(255,255,255,.95)",
        "hint": HINT,
        "boxrows": "\n".join(_box_row(i) for i in range(3)),
        "boxname": "the subject's box" if subject.kind == OBJECT else "the first box",
        "aboutwhat": "the subject" if subject.kind == OBJECT else "what is in the middle of the picture",
        "facts": facts.replace("<", "\\u003c"),
        "parts": "\n".join(_part(name, *part) for name, part in parts.items()),
        "viewer": "\n\n".join(map(_text, scripts)),
    }
    before, after = (
        re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], part).encode()
        for part in _text("page.html").split("{{splats}}")
    )
    return before, after


def _pieces(before: bytes, packed: Packed, after: bytes) -> Iterator[bytes]:
    """Yield the page, with the splats as text, piece by piece."""
    yield before
    rest = b""
    for zipped in packed.zipped():
        rest += zipped
        whole = len(rest) // 3 * 3  # bytes that are whole letters
        yield base64.b64encode(rest[:whole])
        rest = rest[whole:]
    yield base64.b64encode(rest)
    yield after


def _text(name: str) -> str:
    return (files("gs2d.viewer") / "web_assets" / name).read_text(encoding="utf-8").strip()


def _part(name: str, file: str, kind: str) -> str:
    return f'<script type="{kind}" id="{name}">\n{_text(file)}\n</script>'


def _box_row(axis: int) -> str:
    """Return the two numbers of the clip box along an axis."""
    name = "xyz"[axis]
    inputs = "".join(
        f'<input type="number" data-side="{side}" data-axis="{axis}" aria-label="{word} {name}">'
        for side, word in (("low", "least"), ("high", "largest"))
    )
    return f'<div class="row"><b class="{name}" aria-hidden="true">{name}</b>{inputs}</div>'


def _facts(scene: PageScene, subject: Subject) -> dict[str, Any]:
    """Return what the page is told about the scene; places are relative to its focus."""
    cameras, settings, origin = [view.camera for view in scene.views], scene.settings, scene.focus
    arc = photographed_arc(cameras, subject, scene.up)
    return {
        "near": settings.near,
        "alphaMin": settings.alpha_min,
        "alphaMax": settings.alpha_max,
        "lowpass": settings.lowpass_px,
        "near_plane_policy": NEAR_PLANE_POLICIES.index(settings.near_plane_policy),
        "crossingCutoff": settings.error_cutoff,
        "background": list(settings.background),
        "origin": origin.tolist(),
        "subject": {
            "object": subject.kind == OBJECT,
            "center": (subject.center - origin).tolist(),
            "low": (subject.low - origin).tolist(),
            "high": (subject.high - origin).tolist(),
            "radius": subject.radius,
            "home": home_camera(cameras, subject, arc, scene.up),
            "arc": {"middle": arc.middle.tolist(), "half": arc.half, "low": arc.low, "high": arc.high},
        },
        "unit": scene.unit,
        "up": scene.up.tolist(),
        "cameras": [_camera(view, origin) for view in scene.views],
        "world": None if scene.world is None else _world(scene.world),
    }


def _world(world: Georeference) -> dict[str, Any]:
    """Return what distances in metres need; a rotation by rows."""
    return {"metres": world.metres_per_unit, "rotation": world.rotation.flatten().tolist()}


def _camera(view: Seen, origin: np.ndarray) -> dict[str, Any]:
    camera = view.camera
    shift = camera.rotation @ origin + camera.T_cam_world[:3, 3]
    lens = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    size = {"w": camera.width, "h": camera.height}
    return {"name": view.name, **size, **lens, "R": camera.rotation.flatten().tolist(), "t": shift.tolist()}
