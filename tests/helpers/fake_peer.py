"""A stand-in for the peer's binary: takes its options, uses the processor, writes a PLY and draws views."""

from __future__ import annotations

import sys
from pathlib import Path

SCRIPT = """#!{python}
import os, shutil, sys, time
words = sys.argv[1:]
value = lambda name: words[words.index(name) + 1]
capture, last = words[0], int(value("-n"))
with open(os.path.join(os.path.dirname(sys.argv[0]), "calls.txt"), "a") as log:
    log.write(" ".join(words) + "\\n")
if not os.path.exists(os.path.join(capture, "sparse/0/cameras.bin")):
    sys.exit("Invalid project folder")
first = 1
if "--resume" in words:
    first = int(open(value("--resume"), "rb").read().split(b"iteration ")[1].split()[0]) + 1
while time.process_time() < {seconds} * (last - first + 1):
    pass
for step in range(first, last + 1):
    if "--val-render" in words and step % 10 == 0:
        picture = os.path.join(capture, "images", value("--val-image"))
        shutil.copy(picture, os.path.join(value("--val-render"), "%d.png" % step))
with open(value("-o"), "w") as ply:
    ply.write("ply\\ncomment Generated at iteration %d\\nelement vertex 7\\nend_header\\n" % last)
"""


def fake_peer(folder: Path, *, seconds: float) -> Path:
    """Write the binary; each iteration takes so many seconds of the processor. It draws the photograph itself."""
    folder.mkdir(parents=True, exist_ok=True)
    binary = folder / "opensplat"
    binary.write_text(SCRIPT.format(python=sys.executable, seconds=seconds))
    binary.chmod(0o755)
    return binary


def calls(binary: Path) -> list[list[str]]:
    """How it was called, oldest first."""
    log = binary.parent / "calls.txt"
    return [line.split() for line in log.read_text().splitlines()] if log.exists() else []
