"""Sphinx: the pages of the repository, where they lie, as a site. `make docs` builds it into build/site.

The source directory is the root of the repository, so that a link means the same on the site and where the repository
is shown; no text is copied. Navigation and the two reference pages are put in while the pages are read.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

SITE = Path(__file__).resolve().parent
sys.path.insert(0, str(SITE))

import navigation  # noqa: E402
import reference  # noqa: E402

import gs2d  # noqa: E402

project = "gs2d"
version = release = gs2d.__version__
copyright = "the gs2d maintainers, Apache-2.0"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = navigation.HOME.removesuffix(".md")
include_patterns = navigation.pages()
exclude_patterns = ["docs/site"]
nitpicky = False
highlight_language = "none"
smartquotes = False  # two hyphens are an option

myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]

autodoc_typehints = "none"  # the docstrings have shapes and units
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_preprocess_types = False

html_theme = "furo"
html_title = f"gs2d {version}"
html_static_path = ["style.css"]
html_css_files = ["style.css"]
html_copy_source = False
html_show_sphinx = False

_GENERATED = {"docs/reference/commands": reference.commands, "docs/reference/python": reference.python}
_FIRST_PAGE = """<!doctype html><meta charset="utf-8"><title>gs2d</title>
<meta http-equiv="refresh" content="0; url=README.html"><a href="README.html">gs2d</a>
"""


def _complete(app: Any, name: str, source: list[str]) -> None:
    """Put in what is generated, and the navigation of pages that have pages below them."""
    page = f"{name}.md"
    if name in _GENERATED:
        before, mark, after = source[0].partition("<!-- generated -->")
        if not mark:
            raise RuntimeError(f"{page} must have the line <!-- generated -->")
        source[0] = f"{before}{_GENERATED[name]()}{after}"
    if page == navigation.HOME or (page in navigation.subpages() and page != navigation.CONTENTS):
        source[0] += "".join(navigation.toctrees(page))


def _first_page(app: Any, error: Exception | None) -> None:
    if error is None and app.builder.name == "html":
        Path(app.outdir, "index.html").write_text(_FIRST_PAGE, encoding="utf-8")


def setup(app: Any) -> None:
    """Say what happens when."""
    app.connect("source-read", _complete)
    app.connect("build-finished", _first_page)
