"""``gs2d view`` in a process of its own: its page, its memory, and what it says on the terminal."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from pathlib import Path

import torch

from gs2d.core.splats import Splats
from viser_client import Client


def random_splats(count: int) -> Splats:
    generator = torch.Generator().manual_seed(0)
    return Splats(
        means=torch.randn(count, 3, generator=generator),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.full((count, 2), -3.0),
        opacity_logits=torch.zeros(count),
        sh0=torch.rand(count, 1, 3, generator=generator),
        shN=torch.zeros(count, 3, 3),
    )


class Served:
    """``gs2d view`` of a file in a process of its own."""

    def __init__(self, path: Path) -> None:
        words = [sys.executable, "-m", "gs2d", "view", str(path), "--json", "--threads", "1"]
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        lines = []
        for line in self._process.stdout:
            lines.append(line)
            if line == "}\n":
                break
        self.url = str(json.loads("".join(lines))["url"])
        self.said: list[str] = []
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        assert self._process.stderr is not None
        self.said.extend(self._process.stderr)

    def memory(self) -> float:
        """MB that it has."""
        return int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1]) * 4096 / 1e6

    def is_alive(self) -> bool:
        """Whether it still serves: a browser gets the splats."""
        browser = Client(self.url)
        browser.wait(lambda: browser.counts["GaussianSplatsMessage"] > 0)
        browser.close()
        return self._process.poll() is None

    def end(self) -> str:
        """Stop it; returns what it said on the terminal."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        self._process.wait(timeout=120)
        self._thread.join(timeout=20)
        for stream in (self._process.stdout, self._process.stderr):
            assert stream is not None
            stream.close()
        return "".join(self.said)
