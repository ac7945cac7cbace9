"""The scripts of the repository that users see: what `make` prints while pip installs."""

from __future__ import annotations

import importlib.util
from pathlib import Path

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


def test_large_downloads_of_pip_are_shown_with_their_sizes_and_their_sum() -> None:
    spec = importlib.util.spec_from_file_location("pip_install", SCRIPTS / "pip_install.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    output = """Collecting torch (from -r .venv/requirements.txt (line 4))
  Downloading torch-2.9.1-cp311-cp311-manylinux_2_28_x86_64.whl.metadata (30 kB)
Downloading https://files.example/torch-2.9.1-cp311-cp311-manylinux_2_28_x86_64.whl (899.8 MB)
Using cached numpy-2.4.6-cp311-cp311-manylinux_2_28_x86_64.whl (16.6 MB)
Installing collected packages: numpy, torch
"""
    total, lines = 0.0, []
    for line in output.splitlines():
        text, total = module.shown(line, total)
        lines += [text] if text else []
    assert lines == [
        "  torch-2.9.1: 900 MB (900 MB so far)",
        "  numpy-2.4.6: 17 MB (916 MB so far)",
        "  installing 2 packages",
    ]
