"""The machine code in a wheel, which needs only the driver, no compiler.

``scripts/build_cubins.py`` creates it; a source checkout has none. It is used only if it was built from the same
sources for this version of the package, so edited kernels are compiled by NVRTC.
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
PTX = "compute_80"  # for newer and integrated GPUs; the driver translates it
FOLDER, MANIFEST = "cubins", "manifest.json"
# GPUs integrated with a CPU (Xavier, Orin, Thor): their code and that of other GPUs of the same major version are not
# compatible.
INTEGRATED = frozenset({72, 87, 88, 101, 110})


@dataclass(frozen=True)
class Shipped:
    """Shipped machine code.

    Attributes
    ----------
    folder : Path
        Contains one archive per architecture.
    compiler : (int, int)
        CUDA version of the compiler; the driver must support its major version or a newer one.
    architectures : tuple of str
    """

    folder: Path
    compiler: tuple[int, int]
    architectures: tuple[str, ...]

    def architecture_for(self, capability: tuple[int, int]) -> str | None:
        """Return the architecture whose code a device of this compute capability runs, None if there is none."""
        wanted = 10 * capability[0] + capability[1]
        known = [int(arch.removeprefix("sm_")) for arch in self.architectures if arch.startswith("sm_")]
        best = fitting(wanted, known)
        if best is not None:
            return f"sm_{best}"
        texts = [arch for arch in self.architectures if arch.startswith("compute_")]
        return next((text for text in texts if int(text.removeprefix("compute_")) <= wanted), None)

    def code(self, name: str, arch: str) -> bytes | None:
        """Return the code of a source file (``cuda/project.cu``) for an architecture, None if it is not shipped."""
        if arch not in self.architectures:
            return None
        try:
            with zipfile.ZipFile(self.folder / f"{arch}.zip") as archive:
                return archive.read(entry_of(name))
        except (OSError, KeyError, zipfile.BadZipFile):  # damaged: the kernel is compiled
            return None


def fitting(wanted: int, known: list[int]) -> int | None:
    """Return the newest architecture whose code a device (90: capability 9.0) runs, None if there is none."""
    runs = [
        arch
        for arch in known
        if arch == wanted
        or (arch < wanted and arch // 10 == wanted // 10 and arch not in INTEGRATED and wanted not in INTEGRATED)
    ]
    return max(runs, default=None)


def entry_of(name: str) -> str:
    """Return the name in an archive: ``cuda/project.cu`` -> ``project``."""
    return name.rpartition("/")[2].removesuffix(".cu")


def digest_of(sources: Mapping[str, str], options: tuple[str, ...]) -> str:
    """Return the digest of the sources and options of a build."""
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
    """Write an archive per architecture, then the manifest.

    Parameters
    ----------
    names : sequence of str
        Source files (``cuda/project.cu``).
    code_of : callable
        Returns the machine code of a source file for an architecture.
    facts : mapping
        Further entries of the manifest: ``version`` of the package, digest of the ``sources``, version of the compiler.

    Returns
    -------
    int
        Total bytes written.
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
    return size + (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")  # ASCII: one byte per character


@cache
def shipped(version: str, digest: str, folder: Path | None = None) -> Shipped | None:
    """Return the machine code built from these sources for this version of the package, None if there is none."""
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
