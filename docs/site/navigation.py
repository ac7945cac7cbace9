"""The order of the pages, read from docs/README.md: its headings are the parts of the site, its links their pages.

It needs no Sphinx: a test of `make test` asks it which pages are missing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HOME = "README.md"
CONTENTS = "docs/README.md"
_HEADING = re.compile(r"^## (.+)$", re.M)
_LINK = re.compile(r"\]\(([^)#\s]+\.md)(?:#[^)]*)?\)")
_CODE = re.compile(r"^(```+).*?^\1", re.M | re.S)


def pages() -> list[str]:
    """Return all pages of the site, paths from the root of the repository."""
    found = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    return sorted(path.relative_to(ROOT).as_posix() for path in found)


def parts(page: str) -> list[tuple[str, list[str]]]:
    """Return the headings of a page and, below each, the pages that it links to, each page once."""
    text = _CODE.sub("", (ROOT / page).read_text(encoding="utf-8"))
    starts = [*_HEADING.finditer(text)]
    ends = [*(start.start() for start in starts[1:]), len(text)]
    seen: set[str] = {HOME, CONTENTS, page}
    found = []
    for start, end in zip(starts, ends, strict=True):
        below = []
        for target in _LINK.findall(text[start.end() : end]):
            path = _from_root(page, target)
            if path is not None and path not in seen:
                seen.add(path)
                below.append(path)
        if below:
            found.append((start[1].strip(), below))
    return found


def _from_root(page: str, target: str) -> str | None:
    """Return where a link of a page leads, from the root; None where that is no page of ours."""
    if "://" in target:
        return None
    try:
        path = (ROOT / page).parent.joinpath(target).resolve().relative_to(ROOT).as_posix()
    except ValueError:
        return None
    return path if (ROOT / path).is_file() else None


def subpages() -> dict[str, list[tuple[str, list[str]]]]:
    """Return the pages that have pages of their own below them: the README.md of a folder in docs."""
    return {page: parts(page) for page in pages() if page.startswith("docs/") and page.endswith("/README.md")}


def missing() -> list[str]:
    """Return the pages to which the navigation does not lead."""
    trees = subpages()
    listed = [path for tree in trees.values() for _, below in tree for path in below]
    return sorted(set(pages()) - {HOME, CONTENTS, *listed})


def toctrees(page: str) -> Iterator[str]:
    """Yield what is added to a page so that the site's navigation has its parts."""
    source = CONTENTS if page == HOME else page
    folder = "docs/" + page.removeprefix("docs/").rpartition("/")[0]
    deeper = {path for name, tree in subpages().items() if name != CONTENTS for _, below in tree for path in below}
    for title, below in parts(source):
        own = [path for path in below if (path.startswith(folder) if page != HOME else path not in deeper)]
        entries = "\n".join("/" + path.removesuffix(".md") for path in own)
        caption = f":caption: {title}\n" if page == HOME else ""
        if own:
            yield f"\n```{{toctree}}\n:hidden:\n{caption}\n{entries}\n```\n"
    if page == HOME:
        yield "\n```{toctree}\n:hidden:\n\n/" + CONTENTS.removesuffix(".md") + "\n```\n"
