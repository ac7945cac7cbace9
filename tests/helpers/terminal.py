"""Run a command on a pseudo-terminal of a given width."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import threading

ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def raw_screen_of(words: list[str], *, columns: int, env: dict[str, str] | None = None, command: str = "gs2d") -> str:
    """Return what `python -m COMMAND WORDS` writes to a terminal (stdout and stderr), including escape sequences."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    plain = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
    chunks: list[bytes] = []

    def read() -> None:
        while True:
            try:
                chunk = os.read(ours, 1 << 16)
            except OSError:  # on Linux: the other end is closed
                return
            if not chunk:
                return
            chunks.append(chunk)

    reader = threading.Thread(target=read)
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", command, *words],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**plain, "TERM": "xterm-256color", **(env or {})},
        )
        os.close(theirs)
        reader.start()
        code = process.wait(timeout=600)
        reader.join(timeout=600)
    finally:
        os.close(ours)
    text = b"".join(chunks).decode("utf-8", "replace").replace("\r\n", "\n")
    assert code == 0, text
    return text
