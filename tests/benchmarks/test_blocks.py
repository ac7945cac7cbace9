"""The comparison of blocks with one training: its folders, its table, and one run of it, tiny."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.blocks import main, table


def test_the_table_has_a_row_for_each_training() -> None:
    of = {"splats": 40000, "iterations": 4002, "seconds": 61.4, "psnr": 29.555, "psnr_near_seams": 30.78}
    of |= {"f": 0.791, "f_near_seams": 0.849}
    assert table({"whole": of}).splitlines()[-1] == (
        "| whole | 40,000 | 4,002 | 61 | 29.55 dB | 30.78 dB | 0.7910 | 0.8490 |"
    )


@pytest.mark.slow
def test_another_number_of_iterations_of_a_block_is_another_job_beside_the_same_training(tmp_path: Path) -> None:
    options = ["--photographs", "24", "--size", "48", "--grid", "2x1", "--iterations", "120", "--min-views", "4"]
    small = [*options, "--splats", "2000", "--coarse-splats", "1000", "--coarse-side", "24", "--threads", "1"]
    assert main([str(tmp_path), *small]) == 0
    trained = (tmp_path / "whole/splats.ply").stat().st_mtime_ns
    assert main([str(tmp_path), *small, "--block-iterations", "80"]) == 0
    assert (tmp_path / "whole/splats.ply").stat().st_mtime_ns == trained
    for name in ("blocks", "blocks-80"):
        found = json.loads((tmp_path / f"{name}-figures.json").read_text())
        assert set(found) == {"whole", "blocks"}
        assert (tmp_path / f"{name}-seam-0.png").exists()
