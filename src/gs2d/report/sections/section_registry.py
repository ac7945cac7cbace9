"""Registry of the sections of the report."""

from __future__ import annotations

from collections.abc import Callable

from gs2d.config.registry import Registry
from gs2d.errors import RunError
from gs2d.report.run_record import RunRecord

Section = Callable[[RunRecord], str | None]
"""Returns the HTML of a section, or None if it is empty; its attribute `title` is the heading."""

_BUILTIN = (  # in the order of the page; each is a module of this package
    *("verdict", "results", "views", "training", "capture"),
    *("learned", "files", "settings"),
)
SECTIONS: Registry[Section] = Registry(
    "report section",
    "gs2d.sections",
    builtin={name: f"gs2d.report.sections.{name}_section" for name in _BUILTIN},
    error=RunError,
)
"""Names of sections, in the order of the page; those of contrib and of packages follow."""


def register_section(name: str, *, title: str) -> Callable[[Section], Section]:
    """Return a decorator that registers a section of ``report.html``.

    Parameters
    ----------
    name : str
        Name of the section; must be unique.
    title : str
        Heading.

    Returns
    -------
    callable
        Decorates a function that takes the run (``gs2d.report.run_record.RunRecord``) and returns HTML, or None if
        there is nothing to show. Text from files must be escaped. If the function raises, the report shows the error
        in place of the section.

    Examples
    --------
    >>> import gs2d
    >>> @gs2d.register_section("seed", title="Seed")
    ... def seed(run):
    ...     return f"<p>Trained with seed {run.definition['seed']}.</p>"
    """

    def registered(section: Section) -> Section:
        section.title = title  # type: ignore[attr-defined]
        return SECTIONS.register(name)(section)

    return registered
