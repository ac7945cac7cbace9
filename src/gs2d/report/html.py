"""The look of the report: small HTML builders, pictures and scales as data URLs.

Style sheet and script lie in ``assets``.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from importlib.resources import files
from types import MappingProxyType
from urllib.parse import quote

import numpy as np
from PIL import Image

from gs2d.core.images import composite, to_uint8

LARGE = """<dialog class="large" aria-label="enlarged picture">
<nav><button class="before" type="button" aria-label="picture before">&lsaquo;</button>
<button class="next" type="button" aria-label="next picture">&rsaquo;</button><p></p>
<button class="close" type="button" aria-label="close">&times;</button></nav>
<div class="stage"></div>
</dialog>"""


def page(title: str, body: Sequence[str]) -> str:
    """Return a whole document that needs nothing from elsewhere; without its script everything is still to be seen."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{_text('report.css')}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(body)
        + f"\n</main>\n{LARGE}\n<script>\n{_text('report.js')}</script>\n</body>\n</html>\n"
    )


def _text(name: str) -> str:
    return (files("gs2d.report") / "assets" / name).read_text(encoding="utf-8")


def escape(text: object) -> str:
    """Text for HTML, also inside attributes."""
    return html.escape(str(text), quote=True)


def missing(text: str) -> str:
    """What is not there, in words."""
    return f'<p class="missing">{escape(text)}</p>'


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """Names and values in columns."""
    return (
        '<dl class="facts">'
        + "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs)
        + "</dl>"
    )


def table(
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    texts: Sequence[int] = (),
    titles: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Return a table of cells that are HTML already: ``<td ...>`` elements, or text.

    Parameters
    ----------
    texts : sequence of int
        The columns of words.
    titles : mapping
        What columns mean, by column: shown where the mouse rests on their names.
    """
    style = [' class="text"' if i in texts else "" for i in range(len(columns))]
    named = [
        f'<abbr title="{escape(titles[column])}">{escape(column)}</abbr>' if column in titles else escape(column)
        for column in columns
    ]
    head = "".join(f"<th{style[i]}>{name}</th>" for i, name in enumerate(named))
    body = "".join(
        "<tr>"
        + "".join(cell if cell.startswith("<td") else f"<td{style[i]}>{cell}</td>" for i, cell in enumerate(row))
        + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def image_tag(image: np.ndarray, caption: str = "", *, alt: str, width: int = 360, full: str | None = None) -> str:
    """Return an image [H, W, 3 or 4] inline as JPEG, at most ``width`` px wide, over white.

    Parameters
    ----------
    full : str, optional
        The same picture in all its pixels, beside the report: what is shown enlarged where it is there.
    """
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{_image(image, alt, width, full)}{below}</figure>"


def wipe(
    images: tuple[np.ndarray, np.ndarray],
    names: tuple[str, str],
    *,
    title: str,
    width: int = 800,
    full: tuple[str, str] | None = None,
) -> str:
    """Return two pictures of one view, one over the other, with a line to be moved by mouse, finger or arrow keys.

    Parameters
    ----------
    images : two ndarrays [H, W, 3 or 4]
        What is shown left of the line, and right of it.
    names : two str
        What they are.
    title : str
        What of.
    width : int
        px at most, of each.
    full : two str, optional
        As for :func:`picture`.
    """
    alts = [f"{name} of {title}" for name in names]
    both = [
        _image(image, alt, width, None if full is None else full[i])
        for i, (image, alt) in enumerate(zip(images, alts, strict=True))
    ]
    before, after = (escape(name) for name in names)
    ratio = images[0].shape[1] / images[0].shape[0]
    return (
        f'<figure class="wipe" data-title="{before} and {after} of {escape(title)}" style="--ratio: {ratio:.4f}">'
        f'<div class="both">{both[0]}{both[1]}'
        f'<span class="tag before">{before}</span><span class="tag after">{after}</span></div>'
        '<input type="range" min="0" max="100" value="50" step="1" '
        f'aria-label="How much of the {before} is shown over the {after}">'
        f"<figcaption>{escape(title)}: {before} left, {after} right"
        '<button class="larger" type="button">enlarge</button></figcaption></figure>'
    )


def _image(image: np.ndarray, alt: str, width: int, full: str | None) -> str:
    beside = "" if full is None else f' data-full="{escape(quote(full))}"'
    return f'<img src="{_jpeg(image, width)}" alt="{escape(alt)}"{beside}>'


def _jpeg(image: np.ndarray, width: int) -> str:
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
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def drawing(svg: str, title: str) -> str:
    """A drawing inline as an image."""
    source = "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode("ascii")
    return f'<figure><figcaption>{escape(title)}</figcaption><img src="{source}" alt="{escape(title)}"></figure>'


def color_bar(colors: np.ndarray, low: str, high: str, text: str) -> str:
    """A colour scale [n, 3] with its two ends and what it shows."""
    stops = ", ".join("#" + "".join(f"{value:02x}" for value in to_uint8(color)) for color in colors)
    return (
        f'<div class="key">{escape(text)}<div class="bar" style="background: linear-gradient(90deg, {stops})"></div>'
        f'<div class="ends"><span>{escape(low)}</span><span>{escape(high)}</span></div></div>'
    )
