"""The fusion benchmark runs, and its sphere is where it should be."""

from __future__ import annotations

from benchmarks.fuse import run


def test_the_fusion_benchmark_reports_every_step_of_a_small_run() -> None:
    result = run(views=20, size=64, resolution=60, threads=1)
    steps = ["sample", "limits", "noise", "blocks", "fuse", "components", "evidence"]
    assert list(result.seconds) == steps
    assert result.faces > 5000
    assert result.volume_mib > 0
    assert result.worst_radius_error_voxels < 1.0
