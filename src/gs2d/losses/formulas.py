"""The training losses in plain torch, for any dtype and device: the reference of the native operations.

Conventions (``docs/math.md``): images are [H, W, C]; a mask is bool [H, W] with False = ignore this pixel. Means run
over the valid pixels only; the mean over no pixels is 0. The rendering at an ignored pixel changes no value and gets no
gradient.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError

EDGES = ("undefined", "camera")
WINDOW_RADIUS = 5  # px: 11 taps
WINDOW_SIGMA = 1.5  # px
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
FLAT_RADIUS = 3  # px: windows of 7 x 7, as those that views are compared by
SMOOTH_REACH = 2  # px between compared normals: the noise of neighbouring pixels is the same
SMOOTH_BEND = 0.01  # radians: smaller bends count quadratically
FLAT_CONTRAST = 0.02  # standard deviation in [0, 1]: three times the noise of a photograph in daylight


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mean of ``values`` [H, W] or [H, W, C] over the pixels where ``mask`` [H, W] is True or None."""
    if mask is None:
        return values.mean()
    valid = mask if values.dim() == 2 else mask[..., None]
    channels = values.numel() // max(mask.numel(), 1)
    count = torch.clamp(mask.sum() * channels, min=1)
    return torch.where(valid, values, torch.zeros_like(values)).sum() / count


def fill_ignored(rendered: Tensor, filler: Tensor, mask: Tensor | None) -> Tensor:
    """Return ``rendered`` [H, W] or [H, W, C] with the values of ``filler`` at ignored pixels, even for NaN there."""
    if mask is None:
        return rendered
    return torch.where(mask if rendered.dim() == 2 else mask[..., None], rendered, filler)


def l1(rendered: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean absolute difference over valid pixels and channels."""
    return masked_mean((fill_ignored(rendered, target, mask) - target).abs(), mask)


def l2(rendered: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean squared difference over valid pixels and channels."""
    return masked_mean((fill_ignored(rendered, target, mask) - target).square(), mask)


def gaussian_window(dtype: torch.dtype = torch.float64, device: torch.device | None = None) -> Tensor:
    """Return the 11 normalised weights of the SSIM window: exp(-k^2 / (2 sigma^2)), k = -5..5."""
    k = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=torch.float64)
    weights = torch.exp(-(k**2) / (2 * WINDOW_SIGMA**2))
    return (weights / weights.sum()).to(dtype=dtype, device=device)


def blur(image: Tensor) -> Tensor:
    """Blur an image [H, W, C] with the Gaussian window; zero outside the image."""
    channels = image.shape[2]
    window = gaussian_window(image.dtype, image.device)
    planes = image.permute(2, 0, 1)[None]  # [1, C, H, W]
    rows = window.view(1, 1, 1, -1).expand(channels, 1, 1, -1)
    columns = window.view(1, 1, -1, 1).expand(channels, 1, -1, 1)
    planes = F.conv2d(planes, rows, padding=(0, WINDOW_RADIUS), groups=channels)
    planes = F.conv2d(planes, columns, padding=(WINDOW_RADIUS, 0), groups=channels)
    return planes[0].permute(1, 2, 0)


def ssim_map(rendered: Tensor, target: Tensor) -> Tensor:
    """Return the SSIM of every pixel and channel [H, W, C] (Wang et al. 2004; constants of the official 2DGS code)."""
    mu_x, mu_y = blur(rendered), blur(target)
    var_x = blur(rendered * rendered) - mu_x * mu_x
    var_y = blur(target * target) - mu_y * mu_y
    cov = blur(rendered * target) - mu_x * mu_y
    numerator = (2 * mu_x * mu_y + SSIM_C1) * (2 * cov + SSIM_C2)
    return numerator / ((mu_x * mu_x + mu_y * mu_y + SSIM_C1) * (var_x + var_y + SSIM_C2))


def ssim(rendered: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean SSIM over valid pixels and channels; ignored pixels hold the target's value."""
    return masked_mean(ssim_map(fill_ignored(rendered, target, mask), target), mask)


def normals_from_depth(
    depth: Tensor, camera: Camera, mask: Tensor | None = None, *, edges: str = "undefined"
) -> Tensor:
    """Return surface normals of a depth map, by central differences of back-projected points.

    N = normalise((P[y+1] - P[y-1]) x (P[x+1] - P[x-1])), with P the world point of each pixel centre. For positive
    depths N faces the camera: before normalisation, its dot product with the ray of the pixel is
    -(z[x+1] + z[x-1]) (z[y+1] + z[y-1]) / (fx fy).

    Parameters
    ----------
    depth : Tensor [H, W] world units
        Depth along the optical axis, or along ``camera.rays``; 0 where nothing was hit.
    camera : Camera
    mask : Tensor [H, W] bool, optional
        False = ignore the pixel: neither it nor its neighbours have a normal.
    edges : "undefined" or "camera"
        Next to an empty pixel, N is undefined, or the empty pixel counts as the camera centre, as in the official 2DGS
        code. N is then undefined only if both horizontal or both vertical neighbours are empty.

    Returns
    -------
    Tensor [H, W, 3]
        Unit normals in the world frame; 0 where undefined, and on the one-pixel border. Differentiable in ``depth`` and
        in learned ``intrinsics`` of the camera; its pose is constant.

    Raises
    ------
    ShapeError
        If ``depth`` or ``mask`` does not have the camera's size, or ``edges`` is unknown.

    Examples
    --------
    >>> import torch
    >>> import gs2d
    >>> camera = gs2d.Camera(4, 3, 5.0, 5.0, 2.0, 1.5, torch.eye(4).numpy())
    >>> normals_from_depth(torch.full((3, 4), 2.0), camera)[1, 1]  # a wall across the optical axis
    tensor([ 0.,  0., -1.])
    """
    size = f"{camera.height} {camera.width}"
    check_shapes({"depth": (depth, size)} | ({} if mask is None else {"mask": (mask, size)}))
    if edges not in EDGES:
        raise ShapeError(f"edges must be {' or '.join(map(repr, EDGES))}, got {edges!r}")
    height, width = depth.shape
    if min(height, width) < 3:
        return torch.zeros_like(depth)[..., None].expand(-1, -1, 3)
    valid = torch.ones_like(depth, dtype=torch.bool) if mask is None else mask
    hit = ~(depth <= 0) & valid  # NaN counts as a hit: it must reach the loss
    z = torch.where(hit, depth, torch.zeros_like(depth))  # 0 is the camera centre
    i = torch.arange(width, dtype=depth.dtype, device=depth.device)
    j = torch.arange(height, dtype=depth.dtype, device=depth.device)
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    if camera.intrinsics is not None:
        fx, fy, cx, cy = camera.intrinsics.to(depth)
    x = ((i + 0.5 - cx) / fx).expand(height, width)
    y = ((j + 0.5 - cy) / fy)[:, None].expand(height, width)
    points = torch.stack([x * z, y * z, z], dim=-1)  # camera frame; the rotation to the world is applied last
    if camera.rays is not None:
        points = camera.rays[..., :3].to(depth) * z[..., None]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    if edges == "camera":
        defined = valid[2:, 1:-1] & valid[:-2, 1:-1] & valid[1:-1, 2:] & valid[1:-1, :-2]
        defined = defined & (hit[2:, 1:-1] | hit[:-2, 1:-1]) & (hit[1:-1, 2:] | hit[1:-1, :-2])
    else:
        defined = hit[2:, 1:-1] & hit[:-2, 1:-1] & hit[1:-1, 2:] & hit[1:-1, :-2]
    defined = (defined & valid[1:-1, 1:-1])[..., None]
    product = torch.linalg.cross(down, right)
    product = torch.where(defined, product, torch.ones_like(product))  # a zero vector has no finite gradient
    normals = torch.where(defined, F.normalize(product, dim=-1, eps=0.0), torch.zeros_like(product))
    rotation = torch.as_tensor(camera.rotation, dtype=depth.dtype, device=depth.device)
    return F.pad(normals @ rotation, (0, 0, 1, 1, 1, 1))  # rows n^T R = (R^T n)^T


def normal_consistency(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    camera: Camera,
    mask: Tensor | None = None,
    *,
    edges: str = "undefined",
    weights: Tensor | None = None,
    per_splat: bool = False,
) -> Tensor:
    """Return the mean of 1 - alpha <normal, N>, alpha detached, N from ``depth`` (form of the official 2DGS code).

    A pixel with undefined N (border, not hit, ignored neighbour) contributes 1. ``edges`` is that of
    :func:`normals_from_depth`. ``weights`` [H, W] are constant factors of the pixels; the sum is still divided by the
    number of pixels. With ``per_splat``, it is the mean of sum_i w_i (1 - <n_i, N>) = alpha - <normal, N>, nothing
    detached (the paper's Eq. 7), and a pixel with undefined N contributes 0.
    """
    surface = normals_from_depth(depth, camera, mask, edges=edges)
    normal, alpha = (fill_ignored(image, torch.zeros_like(image), mask) for image in (normal, alpha))
    agreement = (normal * surface).sum(dim=-1)
    values = alpha - agreement if per_splat else 1 - alpha.detach() * agreement
    values = values if weights is None else weights.detach() * values
    if per_splat:
        values = torch.where((surface.detach() != 0).any(dim=-1), values, torch.zeros_like(values))
    return masked_mean(values, mask)


def object_weights(alpha: Tensor, silhouette: Tensor | None = None) -> Tensor:
    """Return pixel weights [H, W] that restrict a loss to the object.

    They are 1 where the alpha of the image is above 1/2, else 0. For images without alpha, they are the rendered
    ``alpha``, as a constant.
    """
    return alpha.detach() if silhouette is None else (silhouette > 0.5).to(alpha.dtype)


@torch.no_grad()
def flatness(image: Tensor) -> Tensor:
    """Return how little texture an image [H, W, 3] in [0, 1] has around each pixel, as bytes [H, W] uint8.

    255 exp(-v / s^2), rounded, with v the variance of the grey image in a window of 7 x 7 px (smaller at the border)
    and s ``FLAT_CONTRAST``. A byte per pixel can be kept for each image.
    """
    grey = image.mean(dim=-1)[None, None]

    def mean(values: Tensor) -> Tensor:
        side = 2 * FLAT_RADIUS + 1
        values = F.avg_pool2d(values, (1, side), 1, (0, FLAT_RADIUS), count_include_pad=False)
        return F.avg_pool2d(values, (side, 1), 1, (FLAT_RADIUS, 0), count_include_pad=False)

    variance = (mean(grey * grey) - mean(grey).square()).clamp_min(0)[0, 0]
    return (255 * torch.exp(-variance / FLAT_CONTRAST**2)).round().to(torch.uint8)


def normal_smoothness(normal: Tensor, alpha: Tensor, flatness: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean of f (sqrt(|n - n'|^2 + d^2) - d) over pixels and their neighbours to the right and below.

    Neighbours are ``SMOOTH_REACH`` px apart, n is ``normal`` [H, W, 3], sum w n in the world frame, and d is
    ``SMOOTH_BEND``. f is the smaller :func:`flatness` / 255 of both pixels; 0 where the rendered ``alpha``, a constant,
    is at most 1/2. It is the total variation of the normals where the image does not say what the surface is: planes
    stay planes, edges are sharp, and highlights make no pits.
    """
    normal = fill_ignored(normal, torch.zeros_like(normal), mask)
    weights = (alpha.detach() > 0.5) * (flatness.to(normal.dtype) / 255)
    weights = fill_ignored(weights, torch.zeros_like(weights), mask)
    values = torch.zeros_like(weights)
    for axis in (0, 1):
        difference = normal - _shifted(normal, axis)
        bend = (difference.square().sum(dim=-1) + SMOOTH_BEND**2).sqrt() - SMOOTH_BEND
        values = values + torch.minimum(weights, _shifted(weights, axis)) * bend
    return masked_mean(values, mask)


def _shifted(image: Tensor, axis: int) -> Tensor:
    """Return the values that are ``SMOOTH_REACH`` px further along an axis; 0 outside the image."""
    moved = image.narrow(axis, min(SMOOTH_REACH, image.shape[axis]), max(image.shape[axis] - SMOOTH_REACH, 0))
    return torch.cat([moved, torch.zeros_like(image).narrow(axis, 0, image.shape[axis] - moved.shape[axis])], dim=axis)


def flat_weights(flat: Tensor, factor: float, dtype: torch.dtype) -> Tensor:
    """Return pixel weights [H, W] from 1 (texture) to ``factor`` (none), from the bytes of :func:`flatness`."""
    return 1 + (factor - 1) * (flat.to(dtype) / 255)


def silhouette(alpha: Tensor, target_alpha: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean of |alpha - target_alpha| over valid pixels.

    It also removes splats in the colour of the background, which colour losses cannot see.
    """
    return masked_mean((fill_ignored(alpha, target_alpha, mask) - target_alpha).abs(), mask)
