"""The rasterizer's benchmark runs and writes what it promises."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from gs2d.kernels.library import Library

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "raster.py"


def test_the_benchmark_writes_machine_versions_times_and_probe(native64: Library, tmp_path: Path) -> None:
    path = tmp_path / "out" / "raster.json"
    source = str(Path(sys.modules["gs2d"].__path__[0]).parent)
    command = [sys.executable, str(SCRIPT), "--splats", "300", "--repeats", "1", "--threads", "1", "--json", str(path)]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "PYTHONPATH": source}, timeout=120)
    result = json.loads(path.read_text())
    (row,) = result["rows"]
    assert {"cpu", "python", "torch", "system"} <= result["machine"].keys()
    assert (row["splats"], row["size"], row["threads"]) == (300, 64, 1)
    assert min(row[key] for key in ("forward_min", "backward_min", "fma_gflops", "copy_gb_s")) > 0
