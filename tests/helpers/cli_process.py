"""Run gs2d commands one after another in one process, which imports everything only once.

Run as a program (``python cli_process.py``), it reads one JSON object per line (``words``, ``cwd``) and writes one
(``code``, ``out``, ``err``).
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple


class Result(NamedTuple):
    """Exit code and output of a command."""

    returncode: int
    stdout: str
    stderr: str


class CliProcess:
    """Runs commands in a process whose import path starts with the configured folders."""

    def __init__(self, *folders: Path) -> None:
        path = os.pathsep.join(map(str, folders))
        environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def __call__(self, *words: object, code: int = 0, cwd: Path | None = None) -> Result:
        """Run ``gs2d WORDS`` and check that it exits with ``code``."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({"words": list(map(str, words)), "cwd": str(cwd or Path.cwd())}) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        result = Result(answer["code"], answer["out"], answer["err"])
        assert result.returncode == code, result.stdout + result.stderr
        return result

    def close(self) -> None:
        """Stop the process."""
        self._process.communicate(timeout=60)


def serve() -> None:
    """Run commands from stdin until it closes."""
    from gs2d.cli import run

    answers = sys.stdout
    for line in sys.stdin:
        request = json.loads(line)
        out, err = io.StringIO(), io.StringIO()
        with contextlib.chdir(request["cwd"]), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = run(request["words"])
        answers.write(json.dumps({"code": code, "out": out.getvalue(), "err": err.getvalue()}) + "\n")
        answers.flush()


if __name__ == "__main__":
    serve()
