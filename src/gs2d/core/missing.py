"""What is said of a path that leads nowhere: what was probably meant, or where it was looked for."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

_ALIKE = 0.6  # of difflib's ratio, from which a name is proposed


def where_it_ends(path: Path) -> str:
    """Return "; did you mean scans/chair?", or "; there is no chair in /home/me/scans", of a path that is not there.

    Parameters
    ----------
    path : Path
        Relative to the working folder, or absolute.
    """
    missing, rest = path, Path()
    while missing.parent != missing and not missing.parent.exists():
        missing, rest = missing.parent, missing.name / rest
    try:
        names = sorted(os.listdir(missing.parent))
    except OSError:  # a file where a folder is needed, or one that may not be read
        return "; check the path"
    close = difflib.get_close_matches(missing.name.casefold(), [name.casefold() for name in names], 1, _ALIKE)
    for name in names:
        if name.casefold() in close:
            meant = missing.parent / name / rest
            return f"; did you mean {meant}?" if meant.exists() else f"; did you mean {missing.parent / name}?"
    return f"; there is no {missing.name} in {missing.parent.resolve()}"
