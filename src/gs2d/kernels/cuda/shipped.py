"""The machine code that a wheel brings: with it neither a compiler nor its libraries are needed, the driver alone.

``scripts/build_cubins.py`` puts it there; a source checkout has none. It is taken where it was made of these very
sources for this version of the package: whoever edits a kernel gets what NVRTC makes of it.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

__all__ = [
    "FOLDER",
    "INTEGRATED",
    "MANIFEST",
    "PTX",
    "SHIPPED",
    "Shipped",
    "digest_of",
    "fitting",
    "shipped",
    "write_archives",
]

SHIPPED = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")
PTX = "compute_80"  # for GPUs to come and those in one chip with a CPU; the driver translates it
FOLDER, MANIFEST = "cubins", "manifest.json"
# GPUs in one chip with a CPU (Xavier, Orin, Thor): their code runs on no other GPU of the same major version, nor any
# other's on them.
INTEGRATED = frozenset({72, 87, 88, 101, 110})


@dataclass(frozen=True)
class Shipped:
    """What lies beside this file.

    Attributes
    ----------
    folder : Path
        One archive for each architecture.
    compiler : (int, int)
        Version of CUDA's, whose code a driver of that major version or a newer one takes.
    architectures : tuple of str
    """

    folder: Path
    compiler: tuple[int, int]
    architectures: tuple[str, ...]

    def architecture_for(self, capability: tuple[int, int]) -> str | None:
        """Return whose code a device of this compute capability runs; None: there is none for it."""
        wanted = 10 * capability[0] + capability[1]
        known = [int(arch.removeprefix("sm_")) for arch in self.architectures if arch.startswith("sm_")]
        best = fitting(wanted, known)
        if best is not None:
            return f"sm_{best}"
        texts = [arch for arch in self.architectures if arch.startswith("compute_")]
        return next((text for text in texts if int(text.removeprefix("compute_")) <= wanted), None)

    def code(self, name: str, arch: str) -> bytes | None:
        """Return the code of a source file (``cuda/project.cu``) for an architecture; None where it is not here."""
        if arch not in self.architectures:
            return None
        try:
            with zipfile.ZipFile(self.folder / f"{arch}.zip") as archive:
                return archive.read(entry_of(name))
        except (OSError, KeyError, zipfile.BadZipFile):  # damaged: it is compiled
            return None


def fitting(wanted: int, known: list[int]) -> int | None:
    """Return the newest of some architectures whose code a device (90: capability 9.0) runs; None: of none."""
    runs = [
        arch
        for arch in known
        if arch == wanted
        or (arch < wanted and arch // 10 == wanted // 10 and arch not in INTEGRATED and wanted not in INTEGRATED)
    ]
    return max(runs, default=None)


def entry_of(name: str) -> str:
    """``cuda/project.cu`` -> ``project``, the name in an archive."""
    return name.rpartition("/")[2].removesuffix(".cu")


def digest_of(sources: Mapping[str, str], options: tuple[str, ...]) -> str:
    """Return what the sources and options of a build are known by."""
    digest = hashlib.sha256()
    for part in (*options, *(text for pair in sorted(sources.items()) for text in pair)):
        data = part.encode()
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()


def write_archives(
    folder: Path,
    architectures: Sequence[str],
    names: Sequence[str],
    code_of: Callable[[str, str], bytes],
    facts: Mapping[str, object],
) -> int:
    """Write an archive for each architecture and the manifest, which comes last.

    Parameters
    ----------
    names : sequence of str
        Source files (``cuda/project.cu``).
    code_of : callable
        Machine code of a source file for an architecture.
    facts : mapping
        What it says beside the architectures: ``version`` of the package, ``sources``, and the compiler's.

    Returns
    -------
    int
        Bytes of all that was written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MANIFEST).unlink(missing_ok=True)
    size = 0
    for arch in architectures:
        path = folder / f"{arch}.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            for name in names:
                archive.writestr(zipfile.ZipInfo(entry_of(name)), code_of(name, arch), zipfile.ZIP_DEFLATED, 9)
        size += path.stat().st_size
    text = json.dumps({**facts, "architectures": list(architectures)}, indent=1)
    return size + (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")  # as many characters as bytes


@cache
def shipped(version: str, digest: str, folder: Path | None = None) -> Shipped | None:
    """Return what was made of these sources for this version of the package; None where there is no such thing."""
    if folder is None:
        folder = Path(str(resources.files("gs2d.kernels.cuda"))) / FOLDER
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        if (manifest["version"], manifest["sources"]) != (version, digest):
            return None
        major, minor = manifest["cuda"]
        return Shipped(folder, (int(major), int(minor)), tuple(manifest["architectures"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
