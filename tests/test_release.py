"""The wheel that is released: from `scripts/build_release.sh`, installed where there is nothing else."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import gs2d

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_the_wheel_runs_the_demo_in_an_empty_environment_without_a_compiler() -> None:
    wheels = sorted((ROOT / "dist").glob(f"2dgs_r-{gs2d.__version__}-py3-none-manylinux_*_x86_64.whl"))
    if not wheels:
        pytest.skip("no wheel in dist/: scripts/build_release.sh")
    script = str(ROOT / "scripts" / "check_release.sh")
    done = subprocess.run([script, str(wheels[-1]), sys.executable], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f"gs2d {gs2d.__version__}" in done.stdout


def test_the_conda_recipe_needs_what_pyproject_needs() -> None:
    """Names differ: conda has torch as pytorch, and matplotlib without a window system as matplotlib-base."""
    recipe = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    run = recipe.split("\n  run:\n")[1].split("\n\n")[0]
    listed = {line.strip().removeprefix("- ").replace(" ", "") for line in run.splitlines()}
    names = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
    wanted = {re.sub(r"^[\w-]+", lambda name: names.get(name[0], name[0]), line) for line in project["dependencies"]}
    assert listed == wanted | {f"python{project['requires-python']}"}
    assert f'version: "{gs2d.__version__}"' in recipe
