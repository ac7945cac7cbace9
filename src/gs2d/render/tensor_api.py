"""The rasterizer for plain tensors and batches of cameras, also as the torch operator ``gs2d::rasterize_2dgs``.

The operator is for captured graphs (``torch.compile``, ``torch.export``). Its backward pass renders again, because a
graph holds tensors but not the state of the kernels. Otherwise :func:`rasterize_2dgs` calls
:func:`gs2d.render.api.rasterize` for each camera, or :func:`gs2d.render.api.rasterize_features` with more than three
channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.core.splats import Splats
from gs2d.errors import BackendError, ShapeError
from gs2d.render.api import check_dense, rasterize, rasterize_features
from gs2d.render.backends import Backend, get_backend
from gs2d.render.rays import ray_map
from gs2d.render.types import PLAIN_COLORS, Features, RasterSettings, RenderOutput

COLORS = 3  # channels in ``sh0``
MIN_SCALE = 1e-18  # world units; limit of the kernels: only the low-pass filter draws a smaller disc
MIN_OPACITY, MAX_OPACITY = 1e-30, 1 - 2.0**-20  # limits with finite logits; splats below alpha_min are not drawn
CONSTANTS = (
    "near",
    "far",
    "alpha_min",
    "alpha_max",
    "transmittance_min",
    "error_cutoff",
    "lowpass_px",
    "mip_px",
)


class Rasterization(NamedTuple):
    """Images of C cameras and radii of N splats, as defined in the contract (``gs2d.render.api``)."""

    colors: Tensor  # [C, H, W, D], blended channels over the background
    alphas: Tensor  # [C, H, W, 1]
    normals: Tensor  # [C, H, W, 3], world frame, facing the camera, summed by weight and not normalised
    depth_mean: Tensor  # [C, H, W, 1] world units, divided by alpha; 0 where nothing was hit
    depth_median: Tensor  # [C, H, W, 1] world units; 0 where nothing was hit
    distortion: Tensor  # [C, H, W, 1], squared differences of mapped depth
    radii: Tensor  # [C, N] px, half the longer side of each box; 0 for splats that touch no pixel; no gradient


class SplatTensors(NamedTuple):
    """N splats as tensors with gsplat's names, shapes and units: activated values, not parameters.

    Attributes
    ----------
    means : Tensor [N, 3]
        Centres, world units. float32, or float64 with the reference backend; other tensors have the same dtype.
    quats : Tensor [N, 4]
        Rotations (w, x, y, z) of any length; the splat's normal is the third column of the matrix.
    scales : Tensor [N, 2] or [N, 3]
        Standard deviations along the first two columns, world units, not their logarithms. A third is ignored.
    opacities : Tensor [N]
        In [0, 1], not logits.
    colors : Tensor [N, D] or [C, N, D]; with ``sh_degree`` [N, K, 3] or [C, N, K, 3]
        D features of any sign, blended unchanged; or SH coefficients as in rule 11 (0.5 is added, negative colours
        become 0), in the order of the official code: by degree, then red, green, blue.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


class CameraTensors(NamedTuple):
    """C pinhole cameras of one image size as tensors with gsplat's names and shapes.

    Attributes
    ----------
    viewmats : Tensor [C, 4, 4]
        World to camera, OpenCV axes (x right, y down, z forward), any dtype. The gradient is defined for rigid motions
        (rule 20), not for scale and shear.
    Ks : Tensor [C, 3, 3]
        Intrinsics, px, without skew; pixel (0, 0) is centred at (0.5, 0.5). Gradients reach fx, fy, cx and cy.
    width, height : int
        px, of all C images.
    """

    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int


def rasterize_2dgs(
    splats: SplatTensors,
    cameras: CameraTensors,
    *,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    screen_probe: Tensor | None = None,
    rays: Tensor | None = None,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 (frozen)
    backend: str | Backend = "auto",
) -> Rasterization:
    """Render 2D Gaussians given as tensors into C cameras, differentiable in every tensor.

    Names, shapes and units are those of gsplat's ``rasterization_2dgs``, with these differences: splats and cameras are
    one named tuple each, as are the returned images, always with both depths; ``near_plane`` and all other constants
    are fields of ``settings``; splats are low-pass filtered and cut off as in the 2DGS code (no ``eps2d``,
    ``radius_clip`` and ``tile_size``); the distortion is the squared one; ``Ks`` has gradients; the densification
    signal is the gradient of ``screen_probe``. docs/migration.md has the full table.

    Each camera is one call of :func:`gs2d.rasterize`, with the same bits. Further channels share one more pass: 64
    channels take up to 7 times as long as 3 (docs/notebook/performance.md). Under ``torch.compile`` and
    ``torch.export`` this is the operator ``torch.ops.gs2d.rasterize_2dgs``, whose backward pass renders a second time.

    Parameters
    ----------
    splats : SplatTensors
        ``means`` [N, 3], ``quats`` [N, 4], ``scales`` [N, 2], ``opacities`` [N], ``colors`` [N, D] or [N, K, 3].
    cameras : CameraTensors
        ``viewmats`` [C, 4, 4], ``Ks`` [C, 3, 3], ``width`` and ``height``.
    sh_degree : int, optional
        Degree to evaluate, at most that of ``splats.colors``; None: they are plain features.
    backgrounds : Tensor [C, D] or [D], optional
        Background; default 0. In [0, 1] with ``sh_degree``.
    screen_probe : Tensor [C, N, 2] or [C, N, 4], optional
        Zeros that require a gradient, which is the densification signal of 2DGS and AbsGS (rule 13).
    rays : Tensor [C, H, W, 3] or [H, W, 3], optional
        Directions of the pixels in the camera frame, of any length, instead of those of a pinhole: fisheyes, panoramas,
        LiDAR. 0: the pixel has no ray. Depths are distances, and ``Ks`` only sets a scale (rule 25).
    settings : RasterSettings
        The constants; ``background`` and ``sh_degree`` are ignored.
    backend : str or Backend
        As for :func:`gs2d.rasterize`; "auto" uses the device of ``splats.means``.

    Returns
    -------
    Rasterization
        Named tuple ``colors, alphas, normals, depth_mean, depth_median, distortion, radii``, each with a leading C.

    Raises
    ------
    ShapeError
        If a tensor has another shape, dtype or range.
    BackendError
        If the backend cannot run here.

    Examples
    --------
    >>> import torch, gs2d
    >>> means, quats = torch.rand(50, 3) - 0.5, torch.randn(50, 4)
    >>> viewmat = torch.eye(4)
    >>> viewmat[2, 3] = 3.0
    >>> K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    >>> features = torch.randn(50, 8)
    >>> splats = gs2d.SplatTensors(means, quats, torch.full((50, 2), 0.1), torch.full((50,), 0.7), features)
    >>> out = gs2d.rasterize_2dgs(splats, gs2d.CameraTensors(viewmat[None], K[None], width=64, height=48))
    >>> out.colors.shape, out.alphas.shape, out.radii.shape
    (torch.Size([1, 48, 64, 8]), torch.Size([1, 48, 64, 1]), torch.Size([1, 50]))
    """
    if settings.with_transmittance_depth:
        raise ShapeError(
            "rasterize_2dgs has no depth by transmittance, got settings with it: render with gs2d.rasterize, or leave "
            "with_transmittance_depth False"
        )
    viewmats, Ks, width, height = cameras
    tensors = _Tensors(*splats, viewmats, Ks, backgrounds, screen_probe)
    if not torch.compiler.is_compiling():
        for name, tensor in tensors._asdict().items():
            if tensor is not None or name not in ("backgrounds", "screen_probe"):
                check_dense(name, tensor)
    captured = type(splats.means) not in (Tensor, torch.nn.Parameter)  # a subclass that captures graphs
    if torch.compiler.is_compiling() or captured:
        if not isinstance(backend, str):
            raise BackendError(f"a captured graph needs the name of a backend: use backend={backend.name!r}")
        if rays is not None:
            raise BackendError(
                "a captured graph renders pinhole cameras only, got rays: call rasterize_2dgs outside of it"
            )
        constants = [float(getattr(settings, name)) for name in CONSTANTS]
        choices = (settings.lowpass_depth, settings.near_plane_policy, settings.with_distortion, backend)
        degree = PLAIN_COLORS if sh_degree is None else sh_degree
        return Rasterization(*_operator(*tensors, width, height, degree, constants, *choices))
    return _render(tensors, (width, height), sh_degree, settings, backend, rays)


class _Tensors(NamedTuple):
    """The tensors of :func:`rasterize_2dgs`."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor | None
    screen_probe: Tensor | None


class _Numbers(NamedTuple):
    """Arguments of the operator besides tensors, in types that its schema supports."""

    width: int
    height: int
    sh_degree: int  # PLAIN_COLORS: none
    constants: Sequence[float]  # in the order of CONSTANTS
    lowpass_depth: str
    near_plane_policy: str
    with_distortion: bool
    backend: str

    @property
    def settings(self) -> RasterSettings:
        """The constants as settings."""
        constants: dict[str, Any] = dict(zip(CONSTANTS, self.constants, strict=True))
        names = ("lowpass_depth", "near_plane_policy", "with_distortion")
        return RasterSettings(**constants, **{name: getattr(self, name) for name in names})

    def render(self, tensors: _Tensors) -> Rasterization:
        """Render the tensors."""
        degree = None if self.sh_degree == PLAIN_COLORS else self.sh_degree
        return _render(tensors, (self.width, self.height), degree, self.settings, self.backend)


def _render(
    tensors: _Tensors,
    size: tuple[int, int],
    sh_degree: int | None,
    settings: RasterSettings,
    backend: str | Backend,
    rays: Tensor | None = None,
) -> Rasterization:
    """Render each camera with :func:`gs2d.render.api.rasterize`."""
    means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, screen_probe = tensors
    cameras = _cameras(viewmats, Ks, *size)
    if rays is not None:
        check_dense("rays", rays)
        layout = f"{'C ' * (rays.dim() == 4)}{size[1]} {size[0]} 3"
        check_shapes({"rays": (rays, layout), "viewmats": (viewmats, "C 4 4")})
        maps = [ray_map(each) for each in rays] if rays.dim() == 4 else [ray_map(rays)] * len(cameras)
        cameras = [replace(camera, rays=own) for camera, own in zip(cameras, maps, strict=True)]
    count, channels = len(cameras), _check(tensors, sh_degree)
    if screen_probe is not None and screen_probe.shape[:-1] != (count, len(means)):
        raise ShapeError(
            f"screen_probe must be [{count}, {len(means)}, 2] or [{count}, {len(means)}, 4], "
            f"got {list(screen_probe.shape)}"
        )
    behind = _backgrounds(backgrounds, count, channels, means)
    backend = backend if isinstance(backend, Backend) else get_backend(backend, means.device.type)
    with torch.no_grad():
        sizes, covers = scales[:, :2].clamp(min=MIN_SCALE), opacities.clamp(MIN_OPACITY, MAX_OPACITY)
        logs, logits, slopes = sizes.log(), torch.logit(covers), covers * (1 - covers)
    shape = (_Parameter.apply(scales[:, :2], logs, sizes), _Parameter.apply(opacities, logits, slopes))
    per_camera = colors.dim() == (3 if sh_degree is None else 4)
    views = []
    for index, camera in enumerate(cameras):
        own = colors[index] if per_camera else colors
        red, green, blue = (*behind[index, :COLORS].tolist(), 0.0, 0.0)[:COLORS]
        constants = replace(
            settings, background=(red, green, blue), sh_degree=PLAIN_COLORS if sh_degree is None else sh_degree
        )
        splats = Splats(means, quats, *shape, *_coefficients(own, sh_degree))
        probe = None if screen_probe is None else screen_probe[index]
        if channels <= COLORS:
            output = rasterize(splats, camera, constants, backend=backend, screen_probe=probe)
        else:
            further = Features(own[:, COLORS:], behind[index, COLORS:].detach().to(means))
            output = rasterize_features(splats, camera, constants, further, backend=backend, screen_probe=probe)
        views.append(_images(output, behind[index], channels))
    return Rasterization(*(torch.stack(images) for images in zip(*views, strict=True)))


def _images(output: RenderOutput, background: Tensor, channels: int) -> tuple[Tensor, ...]:
    """Return the images of one camera, in the order of Rasterization."""
    color = output.color[..., :channels]
    if background.requires_grad and torch.is_grad_enabled():
        color = _OverBackground.apply(color, output.alpha.detach(), background)
    single = (output.depth_mean, output.depth_median, output.distortion)
    return (color, output.alpha[..., None], output.normal, *(image[..., None] for image in single), output.radii)


def _coefficients(colors: Tensor, sh_degree: int | None) -> tuple[Tensor, Tensor]:
    """Return ``sh0`` [N, 1, 3] and ``shN``: coefficients, or the first three features padded with 0."""
    if sh_degree is not None:
        return colors[:, :1], colors[:, 1:]
    first = torch.nn.functional.pad(colors[:, :COLORS], (0, max(COLORS - colors.shape[1], 0)))
    return first[:, None], first.new_zeros(len(first), 0, COLORS)


def _cameras(viewmats: Tensor, Ks: Tensor, width: int, height: int) -> list[Camera]:
    """Return the cameras; poses and intrinsics that require gradients are passed as tensors."""
    sizes = check_shapes({"viewmats": (viewmats, "C 4 4"), "Ks": (Ks, "C 3 3")})
    if sizes["C"] < 1:
        raise ShapeError("viewmats must hold at least one camera, got [0, 4, 4]")
    poses, matrices = (tensor.detach().to("cpu", torch.float64).numpy() for tensor in (viewmats, Ks))  # one wait each
    if matrices[:, [0, 1, 2, 2], [1, 0, 0, 1]].any() or (matrices[:, 2, 2] != 1).any():
        raise ShapeError("Ks must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: pinhole cameras without skew, got others")
    learn = [tensor.requires_grad and torch.is_grad_enabled() for tensor in (viewmats, Ks)]
    rows, columns = (0, 1, 0, 1), (0, 1, 2, 2)
    numbers = Ks[:, rows, columns] if learn[1] else None  # [C, 4]
    cameras = []
    for index in range(sizes["C"]):
        fx, fy, cx, cy = matrices[index, rows, columns].tolist()
        pose: Any = viewmats[index] if learn[0] else poses[index]
        cameras.append(
            Camera(width, height, fx, fy, cx, cy, pose, intrinsics=None if numbers is None else numbers[index])
        )
    return cameras


def _check(tensors: _Tensors, sh_degree: int | None) -> int:
    """Check what :func:`rasterize` does not check, and return the number of channels."""
    means, quats, scales, opacities, colors, viewmats, *_ = tensors
    third = 3 if scales.dim() == 2 and scales.shape[1] == 3 else 2
    layout = "N D" if sh_degree is None else "N K 3"
    if colors.dim() == len(layout.split()) + 1:
        layout = f"C {layout}"
    sizes = check_shapes(
        {
            "means": (means, "N 3"),
            "quats": (quats, "N 4"),
            "scales": (scales, f"N {third}"),
            "opacities": (opacities, "N"),
            "viewmats": (viewmats, "C 4 4"),
            "colors": (colors, layout),
        }
    )
    if sh_degree is not None and not 0 <= (sh_degree + 1) ** 2 <= sizes["K"]:
        raise ShapeError(f"sh_degree must be within the {sizes['K']} coefficients of colors, got {sh_degree}")
    channels = COLORS if sh_degree is not None else sizes["D"]
    if channels < 1:
        raise ShapeError("colors must have at least one channel, got none")
    if sizes["N"] > 0:  # NaN passes: such splats are not drawn (rule 16)
        least = torch.stack([scales.detach()[:, :2].min(), opacities.detach().min(), -opacities.detach().max()])
        smallest, lowest, highest = least.tolist()
        if smallest < 0:
            raise ShapeError(f"scales must not be negative, got {smallest:.4g}; pass exp of logarithms")
        if lowest < 0 or highest < -1:
            extreme = lowest if lowest < 0 else -highest
            raise ShapeError(f"opacities must be in [0, 1], got {extreme:.4g}; pass the sigmoid of logits")
    return channels


def _backgrounds(backgrounds: Tensor | None, cameras: int, channels: int, like: Tensor) -> Tensor:
    """Return the background of each image [C, D]."""
    if backgrounds is None:
        return like.new_zeros(cameras, channels)
    if backgrounds.dim() == 1:
        backgrounds = backgrounds.expand(cameras, -1)
    if tuple(backgrounds.shape) != (cameras, channels):
        raise ShapeError(
            f"backgrounds must be [C, D] = [{cameras}, {channels}] or [{channels}], got {list(backgrounds.shape)}"
        )
    return backgrounds


class _Parameter(torch.autograd.Function):
    """The parameters of activated values within limits.

    The gradient is divided by ``slope``, the derivative of the activation. Values beyond a limit have the gradient at
    the limit, so that they can return; a zero gradient stays zero, also at scale 0.
    """

    @staticmethod
    def forward(ctx: Any, activated: Tensor, parameters: Tensor, slope: Tensor) -> Tensor:
        ctx.save_for_backward(slope)
        return parameters.view_as(parameters)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (slope,) = ctx.saved_tensors
        return torch.where(gradients[0] == 0, 0.0, gradients[0] / slope), None, None


class _OverBackground(torch.autograd.Function):
    """Identity on the image, with a gradient for the background, weighted by 1 - alpha."""

    @staticmethod
    def forward(ctx: Any, color: Tensor, alpha: Tensor, background: Tensor) -> Tensor:
        ctx.save_for_backward(alpha, background.detach())
        return color.view_as(color)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        alpha, background = ctx.saved_tensors
        return gradients[0], None, torch.einsum("ij,ijk->k", 1 - alpha, gradients[0]).to(background)


# The operator -----------------------------------------------------------------------------------------------------

_TENSORS = len(_Tensors._fields)
_ARGUMENTS = (  # explicit, since schemas inferred from annotations differ between torch versions
    "Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor colors, Tensor viewmats, Tensor Ks, "
    "Tensor? backgrounds, Tensor? screen_probe, SymInt width, SymInt height, int sh_degree, float[] constants, "
    "str lowpass_depth, str near_plane_policy, bool with_distortion, str backend"
)
_FORWARD = f"({_ARGUMENTS}) -> ({', '.join(['Tensor'] * len(Rasterization._fields))})"
_BACKWARD = f"(Tensor?[] upstream, bool[] needed, {_ARGUMENTS}) -> Tensor[]"


@torch.library.custom_op("gs2d::rasterize_2dgs", mutates_args=(), schema=_FORWARD)
def _operator(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Render without gradients."""
    with torch.no_grad():
        return tuple(_Numbers(*arguments[_TENSORS:]).render(_Tensors(*arguments[:_TENSORS])))  # type: ignore[return-value]


@_operator.register_fake
def _(*arguments: Any) -> tuple[Tensor, ...]:
    means, colors, viewmats = arguments[0], arguments[4], arguments[5]
    width, height, sh_degree = arguments[_TENSORS : _TENSORS + 3]
    cameras, channels = viewmats.shape[0], COLORS if sh_degree != PLAIN_COLORS else colors.shape[-1]
    shapes = [(cameras, height, width, depth) for depth in (channels, 1, 3, 1, 1, 1)]
    return tuple(means.new_empty(shape) for shape in (*shapes, (cameras, means.shape[0])))


@torch.library.custom_op("gs2d::rasterize_2dgs_backward", mutates_args=(), schema=_BACKWARD)
def _backward_operator(upstream: Sequence[Tensor | None], needed: Sequence[bool], *arguments: Any) -> list[Tensor]:
    """Render again and return the gradients of the tensors marked in ``needed``."""
    tensors, numbers = arguments[:_TENSORS], _Numbers(*arguments[_TENSORS:])
    means = tensors[0]
    stream = torch.cuda.current_stream(means.device) if means.is_cuda else None

    def again() -> list[Tensor]:
        with torch.cuda.stream(stream):  # None has no effect
            return _gradients(upstream, needed, tensors, numbers)

    # Within an operator autograd is disabled in this thread, but not in another one.
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(again).result()


def _gradients(
    upstream: Sequence[Tensor | None],
    needed: Sequence[bool],
    tensors: Sequence[Tensor | None],
    numbers: _Numbers,
) -> list[Tensor]:
    """Return the gradients of the tensors marked in ``needed``; ``upstream`` are those of the images."""
    leaves: list[Any] = [
        None if tensor is None else tensor.detach().requires_grad_(need)
        for tensor, need in zip(tensors, needed, strict=True)
    ]
    learning = [leaf for leaf, need in zip(leaves, needed, strict=True) if need]
    images = numbers.render(_Tensors(*leaves))
    pairs = [(image, g) for image, g in zip(images, upstream, strict=True) if g is not None and image.requires_grad]
    if not pairs:
        return [torch.zeros_like(leaf) for leaf in learning]
    ends, cotangents = [image for image, _ in pairs], [g for _, g in pairs]
    gradients = torch.autograd.grad(ends, learning, cotangents, allow_unused=True)
    return [
        torch.zeros_like(leaf) if gradient is None else gradient.clone()
        for leaf, gradient in zip(learning, gradients, strict=True)
    ]


@_backward_operator.register_fake
def _(upstream: Sequence[Tensor | None], needed: Sequence[bool], *arguments: Any) -> list[Tensor]:
    tensors = arguments[:_TENSORS]
    return [torch.empty_like(tensor) for tensor, need in zip(tensors, needed, strict=True) if need]


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs[:_TENSORS])
    ctx.options = inputs[_TENSORS:]
    ctx.mark_non_differentiable(output[-1])
    ctx.set_materialize_grads(False)


def _backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
    needed = list(ctx.needs_input_grad[:_TENSORS])
    computed = iter(_backward_operator(list(upstream), needed, *ctx.saved_tensors, *ctx.options))
    gradients = tuple(next(computed) if need else None for need in needed)
    return (*gradients, *[None] * len(ctx.options))


_operator.register_autograd(_backward, setup_context=_setup_context)
