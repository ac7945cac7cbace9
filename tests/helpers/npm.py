"""Pinned npm packages that read gs2d's files in tests."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import pytest

VERSIONS = {"gltf-validator": "2.0.0-dev.3.10", "@playcanvas/splat-transform": "3.7.0"}


def package(name: str) -> Path:
    """Return the folder of a package, installed for this test run; skip if npm cannot install it."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        pytest.skip("there is no npm on this machine")
    failure = _installed(name)
    if failure:
        pytest.skip(f"npm could not install {name}: {failure}")
    return _home() / "node_modules" / name


@cache
def _home() -> Path:
    home = Path(tempfile.mkdtemp(prefix="gs2d-npm-"))
    (home / "package.json").write_text('{"private": true}')
    return home


@cache
def _installed(name: str) -> str:
    """Return why a package could not be installed, or "" on success."""
    words = ["npm", "install", "--ignore-scripts", "--no-audit", "--no-fund", f"{name}@{VERSIONS[name]}"]
    try:
        done = subprocess.run(words, cwd=_home(), capture_output=True, text=True, timeout=240)
    except subprocess.TimeoutExpired:
        return "no answer within 240 s"
    return "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no words"])[-1][:200]


def forget() -> None:
    """Remove the installed packages."""
    if _home.cache_info().currsize:
        shutil.rmtree(_home(), ignore_errors=True)
    _home.cache_clear()
    _installed.cache_clear()


def node(script: str, *words: str) -> str:
    """Run JavaScript in the packages' folder and return its output."""
    done = subprocess.run(["node", "-e", script, *words], cwd=_home(), capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def splat_transform(*words: str | Path) -> str:
    """Convert splats with splat-transform on the CPU; return its output."""
    program = package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    done = subprocess.run(
        ["node", str(program), "-q", "-w", "-g", "cpu", *map(str, words)], capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-1000:]
    return done.stdout
