"""The methods of mesh extraction, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gs2d.config.registry import Register, Registry
from gs2d.errors import ProtocolError


@dataclass(frozen=True)
class MeshMethod:
    """A method of mesh extraction."""

    extract: Callable[..., Any]  # has the signature of ``gs2d.meshing.extract.extract``
    bounded: bool = True  # False: meshes everything instead of the subject; a box is that of the finest detail
    closes: bool = False  # whether it closes the surface everywhere if ``ExtractOptions.watertight`` is set


MESH_METHODS: Registry[MeshMethod] = Registry(
    "mesh method",
    "gs2d.mesh_methods",
    builtin={"tsdf": "gs2d.meshing.extract"},
    error=ProtocolError,
)
"""Methods of mesh extraction, by name."""


def register_mesh_method(name: str, *, bounded: bool = True, closes: bool = False) -> Callable[[Register], Register]:
    """Return a decorator that registers a method of mesh extraction, for ``gs2d mesh --method NAME``.

    Parameters
    ----------
    name : str
        Must not be taken.
    bounded, closes : bool
        As in ``MeshMethod``.

    Returns
    -------
    callable
        Decorates a function ``(frames, options, *, threads, backend)`` that returns a
        ``gs2d.meshing.extract.Extraction``, as ``gs2d.meshing.extract.extract`` does.
    """

    def registered(extract: Register) -> Register:
        method: Any = extract
        MESH_METHODS.register(name, module=method.__module__)(MeshMethod(method, bounded, closes))
        return extract

    return registered
