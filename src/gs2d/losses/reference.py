"""The training losses in plain torch: any dtype and device, to be read beside the docs, judge of the native operations.

Conventions (``docs/math.md``): images are [H, W, C]; a mask is bool [H, W] with False = ignore this pixel. Means
run over the valid pixels only (the mean over no pixel at all is 0). What was rendered at an ignored pixel has no
influence on any value and receives no gradient.
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


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of ``values`` [H, W] or [H, W, C] over the pixels where ``mask`` [H, W] is True (all pixels for None)."""
    if mask is None:
        return values.mean()
    valid = mask if values.dim() == 2 else mask[..., None]
    channels = values.numel() // max(mask.numel(), 1)
    count = torch.clamp(mask.sum() * channels, min=1)
    return torch.where(valid, values, torch.zeros_like(values)).sum() / count


def fill_ignored(rendered: Tensor, filler: Tensor, mask: Tensor | None) -> Tensor:
    """Return ``rendered`` [H, W] or [H, W, C] with the filler's value at ignored pixels (whatever is there)."""
    if mask is None:
        return rendered
    return torch.where(mask if rendered.dim() == 2 else mask[..., None], rendered, filler)


def l1(rendered: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean absolute difference over valid pixels and channels."""
    return masked_mean((fill_ignored(rendered, target, mask) - target).abs(), mask)


def l2(rendered: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean squared difference over valid pixels and channels."""
    return masked_mean((fill_ignored(rendered, target, mask) - target).square(), mask)


def gaussian_window(dtype: torch.dtype = torch.float64, device: torch.device | None = None) -> Tensor:
    """Return the 11 normalised weights of the SSIM window: exp(-k^2 / (2 sigma^2)), k = -5..5."""
    k = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=torch.float64)
    weights = torch.exp(-(k**2) / (2 * WINDOW_SIGMA**2))
    return (weights / weights.sum()).to(dtype=dtype, device=device)


def blur(image: Tensor) -> Tensor:
    """Return the separable Gaussian window over [H, W, C], zero outside the image."""
    channels = image.shape[2]
    window = gaussian_window(image.dtype, image.device)
    planes = image.permute(2, 0, 1)[None]  # [1, C, H, W]
    rows = window.view(1, 1, 1, -1).expand(channels, 1, 1, -1)
    columns = window.view(1, 1, -1, 1).expand(channels, 1, -1, 1)
    planes = F.conv2d(planes, rows, padding=(0, WINDOW_RADIUS), groups=channels)
    planes = F.conv2d(planes, columns, padding=(WINDOW_RADIUS, 0), groups=channels)
    return planes[0].permute(1, 2, 0)


def ssim_map(rendered: Tensor, target: Tensor) -> Tensor:
    """SSIM of every pixel and channel [H, W, C] (Wang et al. 2004; window, padding, constants of the official 2DGS)."""
    mu_x, mu_y = blur(rendered), blur(target)
    var_x = blur(rendered * rendered) - mu_x * mu_x
    var_y = blur(target * target) - mu_y * mu_y
    cov = blur(rendered * target) - mu_x * mu_y
    numerator = (2 * mu_x * mu_y + SSIM_C1) * (2 * cov + SSIM_C2)
    return numerator / ((mu_x * mu_x + mu_y * mu_y + SSIM_C1) * (var_x + var_y + SSIM_C2))


def ssim(rendered: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean SSIM over valid pixels and channels; ignored pixels hold the target's value."""
    return masked_mean(ssim_map(fill_ignored(rendered, target, mask), target), mask)


def normals_from_depth(
    depth: Tensor, camera: Camera, mask: Tensor | None = None, *, edges: str = "undefined"
) -> Tensor:
    """Surface normals of a depth image, by central differences of back-projected points.

    N = normalise((P[y+1] - P[y-1]) x (P[x+1] - P[x-1])), with P the world point of each pixel centre. For positive
    depths this always faces the camera: its dot product with the pixel's own ray is
    -(z[x+1] + z[x-1]) (z[y+1] + z[y-1]) / (fx fy) before normalising, so no flip is needed.

    Parameters
    ----------
    depth : Tensor [H, W] world units
        Depth along the optical axis; 0 where nothing was hit.
    camera : Camera
    mask : Tensor [H, W] bool, optional
        False = ignore the pixel: neither it nor its neighbours have a normal.
    edges : "undefined" or "camera"
        What a neighbour that was not hit does: N is undefined, or the neighbour lies at the camera's centre, as in the
        official 2DGS code. N is then undefined only where both neighbours across, or both above and below, are empty.

    Returns
    -------
    Tensor [H, W, 3]
        Unit normals in the world frame; 0 where undefined, and on the one-pixel border.
        Differentiable in ``depth``, and in the camera's ``intrinsics`` where they learn; its pose is a constant.

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
    known = torch.ones_like(depth, dtype=torch.bool) if mask is None else mask
    hit = ~(depth <= 0) & known  # NaN counts as a hit: it must reach the loss
    z = torch.where(hit, depth, torch.zeros_like(depth))  # 0 is the camera's centre
    i = torch.arange(width, dtype=depth.dtype, device=depth.device)
    j = torch.arange(height, dtype=depth.dtype, device=depth.device)
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    if camera.intrinsics is not None:
        fx, fy, cx, cy = camera.intrinsics.to(depth)
    x = ((i + 0.5 - cx) / fx).expand(height, width)
    y = ((j + 0.5 - cy) / fy)[:, None].expand(height, width)
    points = torch.stack([x * z, y * z, z], dim=-1)  # camera frame; the rotation to the world is applied last
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    if edges == "camera":
        defined = known[2:, 1:-1] & known[:-2, 1:-1] & known[1:-1, 2:] & known[1:-1, :-2]
        defined = defined & (hit[2:, 1:-1] | hit[:-2, 1:-1]) & (hit[1:-1, 2:] | hit[1:-1, :-2])
    else:
        defined = hit[2:, 1:-1] & hit[:-2, 1:-1] & hit[1:-1, 2:] & hit[1:-1, :-2]
    defined = (defined & known[1:-1, 1:-1])[..., None]
    product = torch.linalg.cross(down, right)
    product = torch.where(defined, product, torch.ones_like(product))  # 0 has no direction, and no finite gradient
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
) -> Tensor:
    """Mean of 1 - alpha <normal, N>, alpha detached, N from ``depth`` (the form of the official 2DGS code).

    Where N is undefined (border, not hit, ignored neighbour) the pixel contributes the constant 1. ``edges`` is that of
    :func:`normals_from_depth`. With ``weights`` [H, W], constants, each pixel's part is multiplied by its weight; the
    sum is divided by the count of pixels all the same.
    """
    surface = normals_from_depth(depth, camera, mask, edges=edges)
    normal, alpha = (fill_ignored(image, torch.zeros_like(image), mask) for image in (normal, alpha))
    return masked_mean(_weighted(1 - alpha.detach() * (normal * surface).sum(dim=-1), weights), mask)


def object_weights(alpha: Tensor, silhouette: Tensor | None = None) -> Tensor:
    """Return the weight [H, W] of each pixel where a loss is asked of the object alone: 1 on it, 0 beside it.

    By the alpha of the photograph (``silhouette``); where it has none the weight is the rendered ``alpha``, a constant.
    """
    return alpha.detach() if silhouette is None else (silhouette > 0.5).to(alpha.dtype)


def edge_weights(image: Tensor, power: float, mask: Tensor | None = None) -> Tensor:
    """Return the weight (1 - g) ** power [H, W] of each pixel: less where the photograph has an edge.

    g is the larger of the central differences across and down, each the mean over channels, divided by the largest of
    the photograph [H, W, C]; 0 on the one-pixel border and beside ignored pixels.
    """
    height, width = image.shape[:2]
    if min(height, width) < 3:
        return image.new_ones(height, width)
    planes = image.permute(2, 0, 1).contiguous()  # twice as fast as channels last
    across = (planes[:, 1:-1, 2:] - planes[:, 1:-1, :-2]).abs().mean(dim=0)
    down = (planes[:, 2:, 1:-1] - planes[:, :-2, 1:-1]).abs().mean(dim=0)
    if mask is not None:
        across = torch.where(mask[1:-1, 2:] & mask[1:-1, :-2], across, torch.zeros_like(across))
        down = torch.where(mask[2:, 1:-1] & mask[:-2, 1:-1], down, torch.zeros_like(down))
    gradient = torch.maximum(across, down)
    gradient = gradient / gradient.max().clamp(min=torch.finfo(image.dtype).tiny)
    return F.pad((1 - gradient) ** power, (1, 1, 1, 1), value=1.0)


def _weighted(values: Tensor, weights: Tensor | None) -> Tensor:
    return values if weights is None else weights.detach() * values


def normal_consistency_per_splat(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    camera: Camera,
    mask: Tensor | None = None,
    *,
    edges: str = "undefined",
    weights: Tensor | None = None,
) -> Tensor:
    """Mean of sum_i w_i (1 - <n_i, N>) = alpha - <normal, N>, nothing detached (the paper's Eq. 7).

    Where N is undefined the pixel contributes 0: there is nothing to be consistent with. ``edges`` and ``weights`` are
    those of :func:`normal_consistency`.
    """
    surface = normals_from_depth(depth, camera, mask, edges=edges)
    normal, alpha = (fill_ignored(image, torch.zeros_like(image), mask) for image in (normal, alpha))
    defined = (surface.detach() != 0).any(dim=-1)
    value = _weighted(alpha - (normal * surface).sum(dim=-1), weights)
    return masked_mean(torch.where(defined, value, torch.zeros_like(value)), mask)


def distortion(distortion_map: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean of the rendered distortion map over valid pixels."""
    return masked_mean(distortion_map, mask)


def silhouette(alpha: Tensor, target_alpha: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean of |alpha - target_alpha| over valid pixels: what is empty in the photograph stays empty.

    Colour alone cannot see a splat that has the colour of the background.
    """
    return masked_mean((fill_ignored(alpha, target_alpha, mask) - target_alpha).abs(), mask)
