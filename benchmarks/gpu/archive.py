"""Pack the files of a part into one small archive: results first; omitted files are listed."""

from __future__ import annotations

import io
import sys
import tarfile
from collections.abc import Sequence
from pathlib import Path

LIMIT_BYTES = 12 << 20
# In this order. Of a run folder, pack figures and report, not splats, checkpoints and images.
WANTED = ("*.json", "*.txt", "metrics.json", "report.html", "*.csv", "*.json.gz")
LEFT_OUT = "left_out.txt"


def chosen(folder: Path) -> list[Path]:
    """Return the files to pack, the most important first; paths with a hidden folder or file are skipped."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    files = [path for path in files if not any(part.startswith(".") for part in path.relative_to(folder).parts)]
    found: dict[Path, None] = {}
    for pattern in WANTED:
        found.update(dict.fromkeys(sorted((f for f in files if f.match(pattern)), key=lambda f: f.stat().st_size)))
    return list(found)


def pack(folder: Path, archive: Path, limit_bytes: int = LIMIT_BYTES) -> list[str]:
    """Write the archive atomically; return the omitted files, which are also listed in the archive."""
    temporary = archive.with_name(archive.name + ".part")
    left_out: list[str] = []
    with temporary.open("wb") as file, tarfile.open(fileobj=file, mode="w:gz") as tar:
        for path in chosen(folder):
            name, size = path.relative_to(folder).as_posix(), path.stat().st_size
            # assume no compression: reports embed compressed images
            if file.tell() + size > limit_bytes:
                left_out.append(f"{name} ({size} bytes)")
                continue
            tar.add(path, name)
        text = "".join(f"{line}\n" for line in left_out).encode()
        entry = tarfile.TarInfo(LEFT_OUT)
        entry.size = len(text)
        if text:
            tar.addfile(entry, io.BytesIO(text))
    temporary.rename(archive)
    return left_out


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``python -m benchmarks.gpu.archive FOLDER ARCHIVE``."""
    folder, archive = map(Path, sys.argv[1:] if arguments is None else arguments)
    for name in pack(folder, archive):
        print(f"not in {archive.name}: {name}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
