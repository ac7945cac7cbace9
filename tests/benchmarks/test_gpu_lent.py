"""The minutes of a GPU that is lent: which Python is taken, what comes home, what is measured first."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
from benchmarks.gpu import __main__ as command

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "benchmarks" / "gpu" / "lent.sh"
BIN = Path(sys.executable).parent


def lent(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """The script, in another folder than the checkout."""
    settings = {**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}", **environment}
    call = ["bash", str(SCRIPT), *arguments]
    return subprocess.run(call, env=settings, cwd="/", capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["0", "1", "2", "3", "4"])
def test_a_dry_run_of_each_part_leaves_two_files_and_no_folder(part: str, tmp_path: Path) -> None:
    """Eight files, none more than two folders down, come home from a machine that is lent."""
    done = lent(part, str(tmp_path), DRY="--dry-run", GS2D_COMMIT="abc", MINUTES="2" if part == "2" else "0")
    assert done.returncode == 0, done.stderr
    found = sorted(tmp_path.rglob("*"))
    assert all(path.is_file() and path.parent == tmp_path for path in found)
    (document,) = [json.loads(path.read_text()) for path in found if path.suffix == ".json"]
    assert document["commit"] == "abc"
    with tarfile.open(tmp_path / f"part_{part}.tar.gz") as tar:
        names = tar.getnames()
    assert "log.txt" in names
    if part == "2":
        assert {Path(name).name for name in names} >= {"metrics.json", "report.html"}
    assert len(found) == 2


@pytest.mark.slow
def test_part_0_goes_the_whole_way(tmp_path: Path) -> None:
    out = tmp_path / "first.json"
    assert command.main(["first", "--dry-run", "--out", str(out)]) == 0
    results = json.loads(out.read_text())["results"]
    assert list(results) == ["machine", "exercise", "parity", "host", "60-32x16-A"]
    assert results["exercise"]["clean"]
    assert results["60-32x16-A"]["surface"]["iteration_ms"] > 0
