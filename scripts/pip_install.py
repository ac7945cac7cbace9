"""Run `pip install` with the given arguments; print one line per large download and per step, and all errors.

pip alone prints either nothing for minutes, or hundreds of lines.
"""

from __future__ import annotations

import re
import subprocess
import sys

LARGE = 10.0  # MB; smaller downloads take no time that one would notice
UNITS = {"kB": 1e-3, "MB": 1.0, "GB": 1e3}
FILE = re.compile(r"\s*(?:Downloading|Using cached) (\S+) \(([\d.]+) (kB|MB|GB)\)")


def shown(line: str, total: float) -> tuple[str, float]:
    """Return what to print for a line of pip ("": nothing), and the sum of the downloads so far, MB."""
    if match := FILE.match(line):
        size = float(match[2]) * UNITS[match[3]]
        total += size
        name = "-".join(match[1].rpartition("/")[2].split("-")[:2])
        return (f"  {name}: {size:,.0f} MB ({total:,.0f} MB so far)" if size >= LARGE else "", total)
    if line.startswith("Installing collected packages:"):
        return f"  installing {line.count(',') + 1} packages", total
    return ("  " + line.strip() if line.startswith(("Building wheel", "ERROR")) else "", total)


def main() -> int:
    """Run pip; return its exit code."""
    words = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--progress-bar", "off"]
    total = 0.0
    with subprocess.Popen([*words, *sys.argv[1:]], stdout=subprocess.PIPE, text=True) as pip:
        assert pip.stdout is not None
        for line in pip.stdout:
            text, total = shown(line, total)
            if text:
                print(text, flush=True)
    return pip.returncode


if __name__ == "__main__":
    sys.exit(main())
