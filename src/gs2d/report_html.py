"""The look of the report: style sheet, small HTML builders, pictures and scales as data URLs."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from gs2d.images import composite, to_uint8

STYLE = """
:root { color-scheme: light dark; --ink: #1d2129; --soft: #5f6773; --line: #dfe2e7; --page: #fbfbfa; --card: #ffffff;
  --accent: #b3246f; --good: #1e7a46; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaee; --soft: #9aa2ae; --line: #30353d; --page: #14171b;
  --card: #1b1f25; --accent: #ff6db5; --good: #69d093; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.55 system-ui, -apple-system, "Segoe UI",
  Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 2.8rem 1.6rem 5rem; }
h1 { font-size: 2.1rem; line-height: 1.15; letter-spacing: -0.02em; margin: 0 0 .35rem; }
h2 { font-size: 1.25rem; letter-spacing: -0.01em; margin: 3rem 0 .8rem; }
h3 { font-size: .95rem; font-weight: 600; margin: 1.8rem 0 .5rem; overflow-wrap: anywhere; }
h3 small { font-weight: 400; color: var(--soft); }
p { max-width: 76ch; margin: .5rem 0; } ul { max-width: 90ch; padding-left: 1.2rem; margin: .5rem 0; }
.lead { font-size: 1.12rem; line-height: 1.5; border-left: 3px solid var(--accent); padding: .1rem 0 .1rem 1rem;
  margin: 1.2rem 0 1.6rem; }
.lead b { color: var(--good); } .soft, figcaption, .missing { color: var(--soft); font-size: .87rem; }
.eyebrow { color: var(--accent); font-weight: 600; font-size: .8rem; letter-spacing: .08em; text-transform: uppercase; }
.missing { border: 1px dashed var(--line); border-radius: 8px; padding: .6rem .8rem; margin: .5rem 0; }
dl.facts { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: .7rem 1.4rem;
  margin: .9rem 0 1.2rem; }
dl.facts dt { color: var(--soft); font-size: .78rem; } dl.facts dd { margin: 0; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; min-width: 100%; }
th, td { text-align: right; padding: .42rem .65rem; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { font-weight: 600; font-size: .8rem; color: var(--soft); }
th:first-child, td:first-child, th.text, td.text { text-align: left; }
td.text { white-space: normal; color: var(--soft); font-size: .87rem; min-width: 9rem; }
td.best { font-weight: 650; color: var(--good); }
td .why { display: block; color: var(--soft); font-size: .72rem; white-space: normal;
  max-width: 16rem; margin-left: auto; }
figure { margin: 0; } img { display: block; width: 100%; height: auto; border-radius: 6px; background: #fff; }
.hero, .meshes { display: grid; grid-template-columns: repeat(auto-fit, minmax(13rem, 1fr)); gap: .9rem; }
.meshes { grid-template-columns: repeat(auto-fit, minmax(18rem, 1fr)); margin-top: 1rem; }
.pair { display: grid; gap: .9rem; }
figcaption { padding: .3rem .1rem 0; }
.views { display: grid; gap: .5rem; align-items: start; min-width: 46rem; }
.views > .head { font-size: .8rem; font-weight: 600; color: var(--soft); text-align: center; }
.views > .row, .views > .key { align-self: center; }
.views > .row { font-size: .8rem; font-weight: 600; color: var(--soft); }
.views figcaption { text-align: center; padding: .15rem 0 0; font-size: .78rem; }
.key { color: var(--soft); font-size: .8rem; padding: 0 .6rem; }
.bar { height: 10px; border-radius: 5px; margin: .3rem 0; }
.ends { display: flex; justify-content: space-between; }
.curves { display: grid; grid-template-columns: repeat(auto-fit, minmax(25rem, 1fr)); gap: 1rem; }
.curves figure { background: var(--card); border: 1px solid var(--line); border-radius: 10px;
  padding: .7rem .8rem .3rem; }
.curves img { background: none; border-radius: 0; }
.curves figcaption { font-weight: 600; color: var(--ink); padding: 0 0 .3rem; }
details { margin-top: .8rem; } summary { cursor: pointer; color: var(--soft); }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .8rem; overflow: auto;
  font-size: .8rem; max-height: 30rem; }
@media (max-width: 40rem) { .curves { grid-template-columns: 1fr; } }
"""


def page(title: str, body: Sequence[str]) -> str:
    """A whole document without scripts and without anything from elsewhere."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(body)
        + "\n</main>\n</body>\n</html>\n"
    )


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


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, texts: Sequence[int] = ()) -> str:
    """A table of cells that are HTML already: ``<td ...>`` elements, or text; ``texts`` are the columns of words."""
    style = [' class="text"' if i in texts else "" for i in range(len(columns))]
    head = "".join(f"<th{style[i]}>{escape(column)}</th>" for i, column in enumerate(columns))
    body = "".join(
        "<tr>"
        + "".join(cell if cell.startswith("<td") else f"<td{style[i]}>{cell}</td>" for i, cell in enumerate(row))
        + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def picture(image: np.ndarray, caption: str = "", *, alt: str, width: int = 360) -> str:
    """An image [H, W, 3 or 4] inline as JPEG, at most ``width`` px wide, over white."""
    source = _jpeg(image, width)
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img src="{source}" alt="{escape(alt)}">{below}</figure>'


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
