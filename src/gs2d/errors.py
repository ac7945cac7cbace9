"""Every error that gs2d raises on purpose.

::

    Gs2dError                  a user can mend it: the command line prints one line and exits with 2
    ├── DataError              a data set, image, mesh or PLY file is missing, broken or of another kind
    ├── RecipeError            a recipe, stage or override that cannot be trained as written
    ├── ProtocolError          a protocol that does not fit the scene
    ├── BackendError           the asked-for backend cannot run on this machine
    ├── ShapeError             a tensor of another shape or dtype than the function takes
    ├── RunError               a run folder that is missing, taken, or of another run
    ├── DiskError              a file could not be written (full disk, no permission)
    └── DivergedError          training produced NaN or infinity

A message is one line and says what was expected, what was found, and what to do.
"""

from __future__ import annotations


class Gs2dError(Exception):
    """Base of all errors that a user can mend; the ends of lines in what a message quotes become spaces."""

    def __init__(self, *args: object) -> None:
        super().__init__(*(" ".join(arg.splitlines()) if isinstance(arg, str) else arg for arg in args))


class DataError(Gs2dError):
    """A data set, image, mesh or PLY file is missing, broken or of another kind."""


class UnusableViewError(DataError):
    """The pose or the camera of one image is no number; readers skip that image and report it."""


class RecipeError(Gs2dError):
    """A recipe, stage or override that cannot be trained as written."""


class ProtocolError(Gs2dError):
    """A protocol that does not fit the scene."""


class BackendError(Gs2dError):
    """The asked-for backend cannot run on this machine."""


class ShapeError(Gs2dError, ValueError):
    """A tensor of another shape or dtype than the function takes."""


class RunError(Gs2dError):
    """A run folder that is missing, taken, or of another run."""


class DiskError(Gs2dError):
    """A file could not be written; ``errno`` is the system's number of the reason, where it gave one."""

    def __init__(self, message: str, errno: int | None = None) -> None:
        super().__init__(message)
        self.errno = errno


class DivergedError(Gs2dError):
    """Training produced NaN or infinity."""


class PluginWarning(UserWarning):
    """A package offers something that gs2d cannot take; it is left out, and the message says why."""
