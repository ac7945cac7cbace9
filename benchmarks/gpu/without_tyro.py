"""A stand-in for tyro on machines that have torch and little else: the pipeline's options are annotated with its words.

Nothing of a command line is parsed here, so the words need no meaning.
"""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType
from typing import Any


class _Word:
    """``Positional[X]`` is X; ``arg(...)`` is nothing in particular."""

    def __class_getitem__(cls, item: Any) -> Any:
        return item

    def __init__(self, *_: Any, **__: Any) -> None: ...


def stand_in() -> bool:
    """Put the stand-in where tyro would be; False where tyro is installed."""
    if "tyro" in sys.modules or importlib.util.find_spec("tyro") is not None:
        return False
    package, conf = ModuleType("tyro"), ModuleType("tyro.conf")
    for name in ("Fixed", "OmitArgPrefixes", "Positional", "Suppress", "UseAppendAction", "arg", "subcommand"):
        setattr(conf, name, _Word)
    package.conf = conf  # type: ignore[attr-defined]
    sys.modules |= {"tyro": package, "tyro.conf": conf}
    return True
