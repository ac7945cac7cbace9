"""The comparison with peers, without any peer: its arithmetic, its file, its errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from benchmarks import peers
from benchmarks.peer_adapters import accumulate_along_rays, in_front, weights_along_rays
from benchmarks.workload import room_workload

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.kernels.library import available_variants, load
from gs2d.render.cpu import rasterize_with
from gs2d.render.types import RasterSettings


def test_weights_along_rays_are_alpha_times_what_the_samples_before_let_through() -> None:
    # ray 0: 0.5, then 0.5 of what is left, then 0.9 of a quarter; ray 2 begins anew; ray 1 has none
    alphas = torch.tensor([0.5, 0.5, 0.9, 0.2, 0.5])
    rays = torch.tensor([0, 0, 0, 2, 2])
    weights, before = weights_along_rays(alphas, ray_indices=rays, n_rays=3)
    torch.testing.assert_close(before, torch.tensor([1, 0.5, 0.25, 1, 0.8]))
    torch.testing.assert_close(weights, torch.tensor([0.5, 0.25, 0.225, 0.2, 0.4]))
    sums = accumulate_along_rays(weights, torch.tensor([[1.0], [2.0], [0.0], [1.0], [1.0]]), ray_indices=rays, n_rays=3)
    torch.testing.assert_close(sums, torch.tensor([[1.0], [0.0], [0.6]]))
    assert accumulate_along_rays(weights, None, ray_indices=rays, n_rays=3)[:, 0].tolist() == pytest.approx(
        [0.975, 0, 0.6]
    )


def test_splats_behind_the_near_plane_are_kept_from_the_peers() -> None:
    workload = room_workload(8, 16, 16)
    splats, camera = workload.splats.clone(), workload.cameras[0]
    splats.means[3] = torch.as_tensor(camera.center - camera.rotation[2])
    assert torch.equal(in_front(splats, camera).means, splats.means[torch.arange(8) != 3])


class Twin:
    """A peer that is our own rasterizer."""

    name = "twin"

    def __init__(self, path: Path, splats: Splats, camera: Camera) -> None:
        self.leaves = Splats(**{name: t.clone().requires_grad_() for name, t in splats.items()})
        self.camera = camera

    def forward(self) -> Any:
        return rasterize_with(load(), self.leaves, self.camera, RasterSettings(sh_degree=3))

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


def test_a_path_with_no_peer_is_a_mistake_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--only", "20k", "--out", str(tmp_path / "peers.json")]
    for option in ("--opensplat", "--gsplat"):
        assert peers.main([option, str(tmp_path / "nothing"), *out]) == 2
        assert capsys.readouterr().err.startswith("error: ")
    with pytest.raises(SystemExit):
        peers.main([])
    assert "--opensplat LIBRARY" in capsys.readouterr().err
