"""The peers of benchmarks/gpu, driven with stand-ins that have their interfaces and draw with the reference.

The stand-ins check arguments as the packages do (gsplat 1.4.0 to 1.6.0, hbb1/diff-surfel-rasterization e0ed020: names,
shapes, frames; facts of their interfaces, none of their code), and give outputs in their layouts. So a wrong argument
fails, and a wrong convention gives another image than the reference's own.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from benchmarks.gpu import peers
from benchmarks.gpu.peers import FAR, NEAR, PEERS, Peer, PeerIteration, activated
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import BackendError
from gs2d.losses.reference import normals_from_depth
from gs2d.render import reference
from gs2d.render.types import RasterSettings, RenderOutput
from render_scenes import random_camera, random_splats

SETTINGS = RasterSettings(near=NEAR)


def drawn(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, camera: Camera, degree: int
) -> RenderOutput:
    """The reference's images of activated parameters."""
    splats = Splats(
        means=means,
        quats=quats,
        log_scales=scales.log(),
        opacity_logits=opacities.logit(),
        sh0=sh[:, :1],
        shN=sh[:, 1:],
    )
    return reference.rasterize(splats, camera, replace(SETTINGS, sh_degree=degree))


def a_gsplat(version: str) -> ModuleType:
    """gsplat's ``rasterization_2dgs``; 1.6 leaves the batch dimension of the depth normals."""

    def rasterization_2dgs(
        means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
        width: int, height: int, near_plane: float = 0.01, far_plane: float = 1e10, radius_clip: float = 0.0,
        eps2d: float = 0.3, sh_degree: int | None = None, packed: bool = False, tile_size: int = 16,
        backgrounds: Tensor | None = None, render_mode: str = "RGB", sparse_grad: bool = False, absgrad: bool = False,
        distloss: bool = False, depth_mode: str = "expected",
    ) -> tuple[Any, ...]:  # fmt: skip
        n = len(means)
        assert sh_degree is not None
        assert (sh_degree + 1) ** 2 <= colors.shape[1]
        shapes = [tuple(x.shape) for x in (means, quats, scales, opacities, colors, viewmats, Ks)]
        assert shapes == [(n, 3), (n, 4), (n, 3), (n,), (n, colors.shape[1], 3), (1, 4, 4), (1, 3, 3)]
        assert all(x.dtype == torch.float32 for x in (means, quats, scales, opacities, colors, viewmats, Ks))
        assert (near_plane, far_plane, render_mode, distloss) == (NEAR, FAR, "RGB+ED", False)
        fx, fy, cx, cy = (float(Ks[0, i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        camera = Camera(width, height, fx, fy, cx, cy, viewmats[0].double().numpy())
        out = drawn(means, quats, scales[:, :2], opacities, colors, camera, sh_degree)
        images = torch.cat([out.color, out.depth_mean[..., None]], dim=2)[None]
        depth_normals = normals_from_depth(out.depth_mean, camera)
        depth_normals = depth_normals[None] if version.startswith("1.6") else depth_normals
        planes = out.distortion[None, ..., None], out.depth_median[None, ..., None]
        return images, out.alpha[None, ..., None], out.normal[None], depth_normals, *planes, {"width": width}

    module = ModuleType("gsplat")
    module.__dict__.update(rasterization_2dgs=rasterization_2dgs, __version__=version)
    return module


class GaussianRasterizationSettings(NamedTuple):
    """Of the official package, in its order."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool
    debug: bool


class GaussianRasterizer(torch.nn.Module):
    """Of the official package: matrices are transposed, the principal point is the middle, normals the camera's."""

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.s = raster_settings

    def forward(
        self, means3D: Tensor, means2D: Tensor, opacities: Tensor, shs: Tensor | None = None,
        colors_precomp: Tensor | None = None, scales: Tensor | None = None, rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        s, n = self.s, len(means3D)
        assert shs is not None
        assert scales is not None
        assert rotations is not None
        assert colors_precomp is cov3D_precomp is None
        assert [tuple(x.shape) for x in (means3D, means2D, opacities, scales, rotations)] == [
            (n, 3), (n, 3), (n, 1), (n, 2), (n, 4)]  # fmt: skip
        assert means2D.requires_grad
        assert (s.sh_degree + 1) ** 2 == shs.shape[1]
        assert (s.scale_modifier, s.prefiltered, s.debug) == (1.0, False, False)
        assert all(x.is_contiguous() for x in (s.viewmatrix, s.projmatrix, s.bg, s.campos))
        pose = s.viewmatrix.T.double()
        # the projection of z-depths to [0, 1] between near and far, x and y to [-1, 1]
        P = torch.tensor([[1 / s.tanfovx, 0, 0, 0], [0, 1 / s.tanfovy, 0, 0],
                          [0, 0, FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)], [0, 0, 1, 0]]).double()  # fmt: skip
        torch.testing.assert_close(s.projmatrix.T.double(), P @ pose, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(s.campos.double(), -pose[:3, :3].T @ pose[:3, 3], atol=1e-5, rtol=1e-5)
        fx, fy = 0.5 * s.image_width / s.tanfovx, 0.5 * s.image_height / s.tanfovy
        middle = (s.image_width / 2, s.image_height / 2)
        camera = Camera(s.image_width, s.image_height, fx, fy, *middle, pose.numpy())
        out = drawn(means3D, rotations, scales, opacities[:, 0], shs, camera, s.sh_degree)
        normal = out.normal @ s.viewmatrix[:3, :3]  # rows: R n
        depth = out.depth_mean * out.alpha
        planes = torch.cat([torch.stack([depth, out.alpha]), normal.permute(2, 0, 1),
                            torch.stack([out.depth_median, out.distortion])])  # fmt: skip
        return out.color.permute(2, 0, 1), out.radii.int(), planes


def the_official() -> ModuleType:
    module = ModuleType("diff_surfel_rasterization")
    parts = (GaussianRasterizationSettings, GaussianRasterizer)
    module.__dict__.update({part.__name__: part for part in parts})
    return module


@pytest.fixture
def case() -> tuple[Splats, Camera]:
    """Splats and a camera whose principal point is the middle, which the official package cannot move."""
    rng = np.random.default_rng(3)
    camera = random_camera(rng)
    camera = Camera(33, 26, camera.fx, camera.fy, 16.5, 13.0, camera.T_cam_world)
    return random_splats(rng, camera, 30).to(dtype=torch.float32), camera


def a_peer(monkeypatch: pytest.MonkeyPatch, name: str, version: str) -> Peer:
    module = a_gsplat(version) if name == "gsplat" else the_official()
    monkeypatch.setattr(peers, "_module", lambda wanted: {module.__name__: module}[wanted])
    return PEERS[name]()


KINDS = [("gsplat", "1.4.0"), ("gsplat", "1.5.3"), ("gsplat", "1.6.0"), ("official", "?")]


@pytest.mark.parametrize(("name", "version"), KINDS)
def test_a_peer_is_given_the_scene_and_its_images_are_understood(
    monkeypatch: pytest.MonkeyPatch, case: tuple[Splats, Camera], name: str, version: str
) -> None:
    splats, camera = case
    found = a_peer(monkeypatch, name, version)
    assert (found.name, found.version) == (name, version)
    images = found.render(activated(dict(splats.items())), camera)
    expected = reference.rasterize(splats, camera, SETTINGS)
    assert float(expected.alpha.mean()) > 0.1
    for got, wanted in (
        (images.color, expected.color),
        (images.normal, expected.normal),
        (images.alpha, expected.alpha),
        (images.depth_normal, normals_from_depth(expected.depth_mean, camera)),
    ):
        assert got.shape == wanted.shape
        close = torch.isclose(got, wanted, atol=1e-3).float().mean()  # but for decisions at a threshold
        assert float(close) > 0.99


@pytest.mark.parametrize(("name", "version"), KINDS)
def test_an_iteration_with_a_peer_moves_every_parameter_towards_the_target(
    monkeypatch: pytest.MonkeyPatch, case: tuple[Splats, Camera], name: str, version: str
) -> None:
    splats, camera = case
    target = reference.rasterize(splats, camera, SETTINGS).color.clamp(0, 1)
    start = splats.clone()
    start.sh0 += 0.3
    trainer = PeerIteration(a_peer(monkeypatch, name, version), start, [target])
    before = {key: leaf.detach().clone() for key, leaf in trainer.leaves.items()}
    losses = []
    for _ in range(3):
        losses.append(float(trainer.loss(trainer.forward(camera), 0).detach()))
        trainer.step(camera, 0)
    assert losses[0] > losses[1] > losses[2]
    for key, leaf in trainer.leaves.items():
        assert leaf.isfinite().all(), key
        assert not torch.equal(leaf.detach(), before[key]), key


def test_cameras_are_brought_to_the_device_once(monkeypatch: pytest.MonkeyPatch, case: tuple[Splats, Camera]) -> None:
    """As in the peers' own trainers: copying them in every iteration would be our making, not theirs."""
    splats, camera = case
    for name, version in KINDS[2:]:
        found = a_peer(monkeypatch, name, version)
        made: list[Camera] = []
        monkeypatch.setattr(peers, "_pose", lambda c, d, make=peers._pose, made=made: (made.append(c), make(c, d))[1])
        for view in (camera, camera, camera.resized(20, 20), camera):
            found.render(activated(dict(splats.items())), view)
        assert len(made) == 2
        monkeypatch.undo()


def test_a_gsplat_without_2dgs_is_refused_with_the_version_that_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("gsplat")
    module.__dict__["__version__"] = "1.3.0"
    monkeypatch.setattr(peers, "_module", lambda name: module)
    with pytest.raises(BackendError, match=r"gsplat 1\.3\.0 has no rasterization_2dgs; install gsplat 1\.4"):
        peers.gsplat()
