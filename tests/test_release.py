"""The wheel that is released: from `scripts/build_release.sh`, installed where there is nothing else."""

from __future__ import annotations

import subprocess
import sys
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
