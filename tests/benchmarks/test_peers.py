"""The comparison with peers, without any peer: its arithmetic, its file, its errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from benchmarks import peers

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.kernels.library import available_variants
from gs2d.render.cpu_backend import CpuBackend
from gs2d.render.types import RasterSettings


class Twin:
    """A peer that is our own rasterizer."""

    name = "twin"

    def __init__(self, path: Path, splats: Splats, camera: Camera) -> None:
        self.leaves = Splats(**{name: t.clone().requires_grad_() for name, t in splats.items()})
        self.camera = camera

    def forward(self) -> Any:
        return CpuBackend().rasterize(self.leaves, self.camera, RasterSettings(sh_degree=3))

    def backward(self, rendered: Any) -> None:
        rendered.color.sum().backward()

    def color(self, rendered: Any) -> torch.Tensor:
        return torch.as_tensor(rendered.color)

    def pairs(self, rendered: Any) -> int:
        return 16 * 16


@pytest.mark.skipif(not available_variants(), reason="the native library was not built")
def test_the_file_holds_both_times_their_ratio_and_that_the_same_was_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers, "PEERS", {"opensplat": Twin})
    monkeypatch.setattr(peers, "WORKLOADS", {"opensplat": ((2000, 16), (1000, 48))})
    file = tmp_path / "deep" / "peers.json"
    words = ["--opensplat", "any.so", "--only", "2k", "--threads", "1", "--repeats", "2", "--out", str(file)]
    threads = torch.get_num_threads()
    assert peers.main(words) == 0
    assert torch.get_num_threads() == threads
    (row,) = json.loads(file.read_text())["rows"]
    assert (row["peer"], row["workload"], row["threads"]) == ("opensplat", "room-2k-16x16", 1)
    assert (row["peer_ms"]["repeats"], row["ours_ms"]["repeats"]) == (2, 2 * peers.OURS_PER_PEER)
    assert row["ratio"]["best"] == pytest.approx(row["peer_ms"]["best"] / row["ours_ms"]["best"], rel=0.05)
    assert row["pairs_per_pixel"]["peer"] == 1
    assert row["mean_color_difference"] == 0
