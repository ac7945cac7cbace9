"""``rasterize_2dgs``: batches of cameras and channels on plain tensors, bit-identical to ``rasterize``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from fake_backends import altered
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import ShapeError
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend, get_backend
from gs2d.render.tensor_api import CONSTANTS, CameraTensors, Rasterization, SplatTensors, rasterize_2dgs
from gs2d.render.types import PLAIN_COLORS, RasterSettings, RenderOutput
from render_scenes import IMAGES, random_camera, random_splats

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds", "screen_probe")
SIZE = (18, 14)


class Scene:
    """The same scene as gsplat-style tensors and as gs2d types."""

    def __init__(self, seed: int = 0, cameras: int = 2, channels: int = 3, count: int = 12) -> None:
        rng = np.random.default_rng(seed)
        first = replace(random_camera(rng), width=SIZE[0], height=SIZE[1], fx=17.0, fy=19.0, cx=9.5, cy=6.25)
        first = replace(first, T_cam_world=first.T_cam_world.astype(np.float32))  # same precision as the tensors
        self.cameras = [first]
        for _ in range(cameras - 1):
            T = first.T_cam_world.copy()
            T[:3, 3] += rng.normal(size=3) * 0.1
            T = T.astype(np.float32)
            self.cameras.append(replace(first, T_cam_world=T, fx=first.fx + 1.5, cx=first.cx - 1.25))
        splats = random_splats(rng, first, count, ("plain", "opaque", "huge")).to(torch.float32)
        self.means, self.quats = splats.means, splats.quats
        self.scales, self.opacities = splats.scales, splats.opacities
        self.sh = torch.cat([splats.sh0, splats.shN], dim=1)
        self.colors = torch.tensor(rng.normal(size=(count, channels)), dtype=torch.float32)
        self.viewmats = torch.tensor(np.stack([c.T_cam_world for c in self.cameras]))
        self.Ks = torch.tensor(np.stack([c.K for c in self.cameras]))
        self.backgrounds = torch.tensor(rng.random((cameras, channels)), dtype=torch.float32)
        self.screen_probe = torch.zeros(cameras, count, 2)

    def learning(self, *names: str, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
        """Return the arguments; those named (all by default) are leaves that require a gradient."""
        found = {name: getattr(self, name).to(dtype) for name in NAMES}
        return {name: t.clone().requires_grad_(name in (names or NAMES)) for name, t in found.items()}

    def splats(self, sh0: Tensor, shN: Tensor | None = None) -> Splats:
        shN = sh0.new_zeros(len(sh0), 0, 3) if shN is None else shN
        return Splats(self.means, self.quats, self.scales.log(), torch.logit(self.opacities), sh0, shN)


def render(arguments: dict[str, Any], **options: Any) -> Rasterization:
    splats = SplatTensors(**{name: arguments[name] for name in SplatTensors._fields})
    cameras = CameraTensors(arguments["viewmats"], arguments["Ks"], *SIZE)
    grouped = {*SplatTensors._fields, *CameraTensors._fields}
    others = {name: value for name, value in arguments.items() if name not in grouped}
    return rasterize_2dgs(splats, cameras, **others, **options)


def contraction(out: Rasterization, seed: int = 0) -> Tensor:
    """Return a randomly weighted sum over all images."""
    g = torch.Generator().manual_seed(seed)
    return sum(((image * torch.randn(image.shape, generator=g)).sum() for image in out[:-1]), torch.zeros(()))


def same_images(out: Rasterization, index: int, expected: RenderOutput) -> None:
    """Check that a camera's images equal those of ``rasterize`` bit for bit; colours are checked by the caller."""
    for ours, theirs in zip(Rasterization._fields[1:-1], IMAGES[1:], strict=True):
        image = getattr(out, ours)[index]
        assert torch.equal(image, getattr(expected, theirs).reshape(image.shape)), ours
    assert torch.equal(out.radii[index], expected.radii)


def test_the_bits_are_those_of_one_view_at_a_time(backend: Backend) -> None:
    scene = Scene(channels=5)
    out = render(scene.learning(), backend=backend)
    assert [tuple(image.shape) for image in out] == [
        *[(2, SIZE[1], SIZE[0], depth) for depth in (5, 1, 3, 1, 1, 1)],
        (2, 12),
    ]
    filled = torch.cat([scene.colors, torch.zeros(12, 1)], dim=1)
    for index, camera in enumerate(scene.cameras):
        for start in (0, 3):
            background = (*scene.backgrounds[index, start : start + 3].tolist(), 0.0)[:3]
            settings = RasterSettings(sh_degree=PLAIN_COLORS, background=background)
            one = rasterize(scene.splats(filled[:, None, start : start + 3]), camera, settings, backend=backend)
            found = out.colors[index, ..., start : start + 3]
            assert torch.equal(found, one.color[..., : found.shape[2]])
        same_images(out, index, one)


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_harmonics_are_those_of_rule_11(backend: Backend, degree: int) -> None:
    scene = Scene()
    given = {**scene.learning("means"), "colors": scene.sh, "screen_probe": None}
    out = render(given, sh_degree=degree, backend=backend)
    for index, camera in enumerate(scene.cameras):
        settings = RasterSettings(sh_degree=degree, background=tuple(scene.backgrounds[index].tolist()))
        one = rasterize(scene.splats(scene.sh[:, :1], scene.sh[:, 1:]), camera, settings, backend=backend)
        assert torch.equal(out.colors[index], one.color)
        same_images(out, index, one)


def test_gradients_are_sums_over_cameras_and_channels_of_those_of_rasterize(cpu: Backend) -> None:
    scene = Scene(channels=4)
    given = scene.learning()
    contraction(render(given, backend=cpu)).backward()
    leaves = scene.learning()
    total, g = torch.zeros(()), torch.Generator().manual_seed(0)
    weights = [torch.randn(2, SIZE[1], SIZE[0], depth, generator=g) for depth in (4, 1, 3, 1, 1, 1)]
    colors = torch.cat([leaves["colors"], torch.zeros(12, 2)], dim=1)
    for index in range(2):
        K, behind = leaves["Ks"][index], [*scene.backgrounds[index].tolist(), 0.0, 0.0]
        intrinsics = K[[0, 1, 0, 1], [0, 1, 2, 2]]
        camera = Camera(*SIZE, *intrinsics.tolist(), leaves["viewmats"][index], intrinsics=intrinsics)  # type: ignore[arg-type,misc]
        for start in (0, 3):
            sh0 = colors[:, None, start : start + 3]
            shape = (leaves["means"], leaves["quats"], leaves["scales"].log(), torch.logit(leaves["opacities"]))
            splats = Splats(*shape, sh0, sh0.new_zeros(12, 0, 3))
            r, g, b = behind[start : start + 3]
            settings = RasterSettings(sh_degree=PLAIN_COLORS, background=(r, g, b))
            probe = leaves["screen_probe"][index]
            out = rasterize(splats, camera, settings, backend=cpu, screen_probe=probe)
            weight = weights[0][index, ..., start : start + 3]
            total = total + (out.color[..., : weight.shape[2]] * weight).sum()
            if start == 0:
                for name, image_weight in zip(IMAGES[1:], weights[1:], strict=True):
                    image = getattr(out, name)
                    total = total + (image * image_weight[index].reshape(image.shape)).sum()
    total.backward()
    for name in set(NAMES) - {"backgrounds"}:
        found, expected = given[name].grad, leaves[name].grad
        assert found is not None
        assert expected is not None
        assert expected.any()
        assert_close(found, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()), msg=name)


def test_every_tensor_has_the_gradient_of_finite_differences() -> None:
    scene = Scene(channels=4, count=5)
    names = ("means", "quats", "scales", "opacities", "colors", "backgrounds")
    given = scene.learning(*names, dtype=torch.float64)
    chosen = tuple(given[name] for name in names)

    def images(*tensors: Tensor) -> Tensor:
        out = render({**given, **dict(zip(names, tensors, strict=True)), "screen_probe": None}, backend="reference")
        return torch.cat([out.colors.flatten()[::7], out.normals.flatten()[::11], out.depth_mean.flatten()[::13]])

    assert torch.autograd.gradcheck(images, chosen, eps=1e-6, atol=1e-4, rtol=1e-3, fast_mode=True)


def three_at_a_time(backend: Backend) -> Backend:
    """Return a backend that renders only three channels per pass."""
    return altered(backend, rasterize_features=partial(Backend.rasterize_features, backend))


@pytest.mark.parametrize("channels", [1, 5, 33])
def test_channels_of_one_pass_are_those_of_three_at_a_time(backend: Backend, channels: int) -> None:
    scene = Scene(channels=channels)
    one_pass, parts = scene.learning(), scene.learning()
    found, expected = render(one_pass, backend=backend), render(parts, backend=three_at_a_time(backend))
    assert torch.equal(found.colors[..., :3], expected.colors[..., :3])
    for ours, theirs in zip(found, expected, strict=True):
        assert_close(ours, theirs, rtol=1e-5, atol=1e-6)
    contraction(found).backward()
    contraction(expected).backward()
    for name in NAMES:
        ours, theirs = one_pass[name].grad, parts[name].grad
        assert ours is not None
        assert theirs is not None
        assert theirs.any()
        assert_close(ours, theirs, rtol=1e-4, atol=1e-5 * float(theirs.abs().max()), msg=name)


def test_an_empty_scene_of_many_channels_is_its_background(backend: Backend) -> None:
    given = Scene(channels=9, count=12).learning()
    names = ("means", "quats", "scales", "opacities", "colors")
    empty = {**given, **{name: given[name].detach()[:0].requires_grad_() for name in names}}
    empty["screen_probe"] = torch.zeros(2, 0, 2)
    out = render(empty, backend=backend)
    assert torch.equal(out.colors, given["backgrounds"].detach()[:, None, None].expand_as(out.colors))
    contraction(out).backward()
    assert all(empty[name].grad is not None and empty[name].grad.shape == empty[name].shape for name in names)


def test_the_absolute_signal_is_that_of_all_channels(backend: Backend) -> None:
    scene, signals = Scene(channels=8), []
    for dtype, chosen in ((torch.float32, backend), (torch.float64, get_backend("reference"))):
        given = scene.learning("screen_probe", dtype=dtype)
        given["screen_probe"] = torch.zeros(2, 12, 4, dtype=dtype, requires_grad=True)
        render(given, backend=chosen).colors.square().sum().backward()
        signals.append(given["screen_probe"].grad)
    found, expected = signals
    assert found is not None
    assert expected is not None
    assert expected[..., 2:].any()
    assert_close(found.double(), expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


@pytest.mark.parametrize("value", [torch.nan, torch.inf, 2e15])
def test_one_channel_beyond_the_range_culls_the_splat(backend: Backend, value: float) -> None:
    scene = Scene(channels=5)
    given = scene.learning()
    with torch.no_grad():
        given["colors"][3, 4] = value
    out = render(given, backend=backend)
    without = {**scene.learning(), "opacities": scene.opacities.clone()}
    without["opacities"][3] = 0.0
    expected = render(without, backend=backend)
    assert torch.equal(out.colors, expected.colors)
    assert torch.equal(out.radii, expected.radii)
    contraction(out).backward()
    for name in ("means", "quats", "scales", "opacities", "colors"):
        gradient = given[name].grad
        assert gradient is not None
        assert gradient.isfinite().all(), name
        assert not gradient[3].any(), name


def test_the_probe_has_the_densification_signal_of_each_camera(cpu: Backend) -> None:
    scene = Scene(channels=3)
    for columns in (2, 4):
        given = scene.learning("screen_probe")
        given["screen_probe"] = torch.zeros(2, 12, columns, requires_grad=True)
        render(given, backend=cpu).colors.square().sum().backward()
        for index, camera in enumerate(scene.cameras):
            probe = torch.zeros(12, columns, requires_grad=True)
            r, g, b = scene.backgrounds[index].tolist()
            settings = RasterSettings(sh_degree=PLAIN_COLORS, background=(r, g, b))
            one = rasterize(scene.splats(scene.colors[:, None]), camera, settings, backend=cpu, screen_probe=probe)
            one.color.square().sum().backward()
            assert given["screen_probe"].grad is not None
            assert probe.grad is not None
            assert probe.grad.any()
            assert torch.equal(given["screen_probe"].grad[index], probe.grad)


def test_the_ends_of_opacity_and_scale_are_drawn_and_learn(backend: Backend) -> None:
    one = {
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.tensor([[0.4, 0.4]], requires_grad=True),
        "opacities": torch.tensor([1.0], requires_grad=True),
        "colors": torch.ones(1, 1),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[10.0, 0, 9.5], [0, 10, 7.5], [0, 0, 1]]]),
    }
    out = render(one, backend=backend)
    assert float(out.alphas.detach().max()) == pytest.approx(0.99, abs=1e-5)
    out.alphas.sum().backward()
    x, y = torch.arange(18) - 9, torch.arange(14) - 7  # px; the disc has a radius of 2 px
    falloff = torch.exp(-(x[None] ** 2 + y[:, None] ** 2) / 8.0)
    assert float(one["opacities"].grad) == pytest.approx(float(falloff.sum()), rel=2e-2)  # type: ignore[arg-type]
    nothing = render({**one, "opacities": torch.zeros(1, requires_grad=True)}, backend=backend)
    assert not nothing.alphas.any()
    dot = torch.zeros(1, 2, requires_grad=True)
    drawn = render({**one, "scales": dot}, backend=backend)
    drawn.alphas.sum().backward()
    assert float(drawn.alphas.detach().max()) > 0.3  # from the low-pass filter
    assert dot.grad is not None
    assert dot.grad.isfinite().all()


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "logits": ({"opacities": torch.full((12,), -2.0)}, r"opacities must be in \[0, 1\], got -2; pass the sigmoid"),
    "above one": ({"opacities": torch.full((12,), 1.5)}, r"opacities must be in \[0, 1\], got 1.5"),
    "log scales": ({"scales": torch.full((12, 2), -3.0)}, "scales must not be negative, got -3; pass exp"),
    "one camera": ({"viewmats": torch.eye(4)}, "viewmats"),
    "skew": ({"Ks": torch.ones(2, 3, 3)}, "pinhole cameras without skew"),
    "no camera": ({"viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)}, "at least one camera"),
    "background": ({"backgrounds": torch.zeros(2, 3)}, r"backgrounds must be \[C, D\] = \[2, 5\] or \[5\]"),
    "probe": ({"screen_probe": torch.zeros(12, 2)}, r"screen_probe must be \[2, 12, 2\] or"),
    "infinite background": ({"backgrounds": torch.full((5,), torch.inf)}, "background"),
    "degree": ({"sh_degree": 2, "colors": torch.zeros(12, 4, 3)}, "within the 4 coefficients of colors, got 2"),
    "no channels": ({"colors": torch.zeros(12, 0)}, "at least one channel"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mistake_is_named_with_its_remedy(cpu: Backend, case: str) -> None:
    change, message = BAD[case]
    given = {**Scene(channels=5).learning("means"), **change}
    with pytest.raises(ShapeError, match=message):
        render(given, backend=cpu)


# The operator -----------------------------------------------------------------------------------------------------
def operands(scene: Scene, dtype: torch.dtype = torch.float32, backend: str = "cpu") -> tuple[Any, ...]:
    """Return the operator's arguments; no opacity is near a threshold."""
    constants = [float(getattr(RasterSettings(), name)) for name in CONSTANTS]
    tensors = scene.learning(dtype=dtype).values()
    return (*tensors, *SIZE, PLAIN_COLORS, constants, "center", "draw", True, backend)


@pytest.mark.usefixtures("cpu")
def test_the_operator_passes_opcheck() -> None:
    found = torch.library.opcheck(torch.ops.gs2d.rasterize_2dgs, operands(Scene(channels=4)))
    assert set(found.values()) == {"SUCCESS"}


@pytest.mark.parametrize(("backend", "dtype"), [("cpu", torch.float32), ("reference", torch.float64)])
@pytest.mark.usefixtures("cpu")
def test_the_operator_has_the_bits_of_the_function_and_of_its_gradients(backend: str, dtype: torch.dtype) -> None:
    scene = Scene(channels=4)
    results = []
    for function in (torch.ops.gs2d.rasterize_2dgs, None):
        arguments = operands(scene, dtype, backend)
        given = dict(zip(NAMES, arguments, strict=False))
        out = function(*arguments) if function else render(given, backend=backend)
        contraction(Rasterization(*out)).backward()
        results.append([*(image.detach() for image in out), *(given[name].grad for name in NAMES)])
    for ours, theirs in zip(*results, strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.usefixtures("cpu")
def test_a_compiled_loss_is_one_graph_with_the_same_bits() -> None:
    scene = Scene(channels=4)

    def loss(given: dict[str, Tensor]) -> Tensor:
        out = render(given, backend="cpu")
        return (out.colors - 0.5).abs().mean() + out.distortion.mean() + out.normals[..., 0].mean()

    plain, compiled = scene.learning(), scene.learning()
    loss(plain).backward()
    torch._dynamo.reset()
    torch.compile(loss, fullgraph=True, backend="aot_eager")(compiled).backward()
    for name in NAMES:
        assert compiled[name].grad is not None, name
        assert_close(compiled[name].grad, plain[name].grad, rtol=1e-5, atol=1e-7)


@pytest.mark.usefixtures("cpu")
def test_an_exported_program_keeps_the_operator_and_draws_other_scenes() -> None:
    class Model(torch.nn.Module):
        def forward(self, given: dict[str, Tensor]) -> Tensor:
            return render({**given, "screen_probe": None}, backend="cpu").colors * 2

    first, second = ({n: t.detach() for n, t in Scene(seed, channels=4).learning().items()} for seed in (0, 1))
    program = torch.export.export(Model(), (first,))
    targets = [str(node.target) for node in program.graph.nodes]
    assert targets.count("gs2d.rasterize_2dgs.default") == 1
    assert torch.equal(program.module()(second), Model()(second))
