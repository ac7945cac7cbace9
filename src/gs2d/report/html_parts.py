"""HTML of the report: templates, and images and drawings as data URLs.

Templates, style sheet and scripts are in ``templates``; ``macros.html`` has the shared macros.
"""

from __future__ import annotations

import base64
import functools
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import jinja2
import numpy as np
from markupsafe import Markup, escape
from PIL import Image

from gs2d.config.grades import GRADES
from gs2d.core.image_arrays import composite, to_uint8
from gs2d.core.text import name_bytes


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images of one view with a movable line between them."""

    images: tuple[np.ndarray, np.ndarray]  # [H, W, 3 or 4], left and right of the line
    names: tuple[str, str]
    title: str
    # Paths of the full-size images relative to the report; shown when the pair is enlarged.
    full: tuple[str, str]
    width: int = 800  # largest width in the report, px

    @property
    def ratio(self) -> float:
        """Return width over height."""
        return self.images[0].shape[1] / self.images[0].shape[0]


def render(template: str, **values: Any) -> Markup:
    """Render a template of ``templates``. Text is escaped, :class:`Markup` is not."""
    return Markup(environment().get_template(template).render(values).strip("\n"))


def macro(template: str, name: str, *values: Any, **named: Any) -> Markup:
    """Return the result of a macro of a template."""
    return Markup(getattr(environment().get_template(template).module, name)(*values, **named))


@functools.cache
def environment() -> jinja2.Environment:
    """Return the template environment: values are escaped, undefined names are errors."""
    env = jinja2.Environment(
        loader=jinja2.PackageLoader("gs2d.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    env.filters["code"] = _with_code
    env.globals |= {"GRADES": GRADES, "hexes": _hexes, "jpeg": _jpeg, "quoted": _quoted, "svg_source": _svg_source}
    return env


def page(title: str, body: Sequence[str]) -> str:
    """Return a self-contained document with the HTML parts of ``body``."""
    return environment().get_template("page.html").render(title=title, body=[Markup(part) for part in body])


def missing(text: str) -> Markup:
    """Return a box with a text about missing content."""
    return macro("macros.html", "missing", text)


def image_tag(image: np.ndarray, *, alt: str, width: int) -> Markup:
    """Return an image [H, W, 3 or 4] inline as JPEG, at most ``width`` px wide, over white."""
    return macro("macros.html", "figure", image, "", alt, width)


def drawing(svg: str, title: str) -> Markup:
    """Return a drawing inline as an image."""
    return macro("macros.html", "drawing", svg, title)


def _with_code(text: str) -> Markup:
    """Return text as HTML with its commands in backticks as code."""
    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))


def _quoted(path: object) -> str:
    """Return a path percent-encoded for a URL; bytes that are not UTF-8 are kept."""
    return quote(name_bytes(str(path)))


def _jpeg(image: np.ndarray, width: int) -> Markup:
    pixels = to_uint8(image)
    if pixels.shape[2] == 4:
        pixels = to_uint8(composite(pixels, (1.0, 1.0, 1.0)))
    shrunk = Image.fromarray(np.ascontiguousarray(pixels))
    if shrunk.width > width:
        size = (width, max(round(shrunk.height * width / shrunk.width), 1))
        shrunk = shrunk.resize(size, Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    # Not `optimize`: then the whole file must fit a buffer of one byte a pixel, and noise at this quality takes 1.7.
    shrunk.save(buffer, format="JPEG", quality=88, subsampling=0)
    return Markup("data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii"))


def _svg_source(svg: str) -> Markup:
    return Markup("data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode("ascii"))


def _hexes(colors: np.ndarray) -> list[str]:
    return ["#" + "".join(f"{value:02x}" for value in to_uint8(color)) for color in colors]
