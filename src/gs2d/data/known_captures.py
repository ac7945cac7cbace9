"""The extension point for captures of published data sets: their protocol, and which of their files are missing."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from gs2d.config.protocols import GENERIC, get_protocol
from gs2d.config.protocols import Protocol as CaptureProtocol
from gs2d.config.registry import Registry
from gs2d.data.readers.capture_readers import READERS


class KnownCaptures(Protocol):
    """Recognises the captures of one or more data sets. An instance is registered in :data:`DATA_SETS`."""

    def protocol(self, root: Path, scene_format: str) -> str | None:
        """Return the name of the protocol of a capture, or None if the capture is unknown."""

    def missing(self, root: Path) -> tuple[str, ...]:
        """Return one line for each missing file of a capture; () if the capture is complete or unknown."""


DATA_SETS: Registry[KnownCaptures] = Registry("data set", "gs2d.data_sets")


def protocol_for(scene_format: str) -> CaptureProtocol:
    """Return the default protocol of a capture format: the one that its reader names."""
    reader = READERS.get(scene_format)() if scene_format in READERS else None
    return get_protocol(getattr(reader, "protocol", GENERIC.name))


def protocol_of(root: Path, scene_format: str) -> CaptureProtocol:
    """Return the protocol that ``--protocol auto`` selects: that of the data set, else that of the capture format."""
    names = (captures.protocol(root, scene_format) for _, captures in DATA_SETS.working())
    name = next((name for name in names if name is not None), None)
    return protocol_for(scene_format) if name is None else get_protocol(name)


def missing_lines(root: Path) -> tuple[str, ...]:
    """Return one line for each missing file of a capture of a known data set; () for any other capture."""
    return tuple(line for _, captures in DATA_SETS.working() for line in captures.missing(root))
