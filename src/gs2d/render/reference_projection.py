"""Projection of splats for the reference rasterizer (docs/math.md, "Projection" and "Footprint").

This module works per splat, :mod:`gs2d.render.reference_pairs` per pair of splat and pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from gs2d.core.camera import Camera
from gs2d.core.sh import num_coefficients, sh_to_rgb
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.render.rays import MAX_DENSITY
from gs2d.render.types import (
    MAX_COLOR,
    MAX_SIZE,
    MAX_WIDENING,
    MIN_QUATERNION,
    MIN_SIZE,
    PLAIN_COLORS,
    RasterSettings,
)

TILE = 16  # px; side of the blocks of pixels that share a list of splats
MAX_PAIRS = 1 << 21  # pairs of splat and pixel evaluated at once; bounds the memory


@dataclass(frozen=True)
class ScreenSplats:
    """M splats that can touch the image of one camera, in blending order.

    The splat-to-pixel map (x z, y z, z) = (Tu, Tv, Tw) (u, v, 1) is stored relative to the projected centre c, for
    float32 precision: Au = Tu - c_x Tw and Av = Tv - c_y Tw, whose third components are 0. With rays (rule 25), Au and
    Av are s_u t_u and s_v t_v in the camera frame, and Tw is (0, 0, |p|).
    """

    center: Tensor  # [M, 2] px, c; of a camera with rays [M, 3] world units, p
    Au: Tensor  # [M, 3]
    Av: Tensor  # [M, 3]
    Tw: Tensor  # [M, 3] world units; depth z = Tw . (u, v, 1), so Tw.z = z_c
    opacity: Tensor  # [M]
    color: Tensor  # [M, 3]
    normal: Tensor  # [M, 3] world, facing the camera

    def rows(self, index: Tensor) -> ScreenSplats:
        """Return the splats of an index tensor, in its order."""
        return ScreenSplats(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


@dataclass(frozen=True)
class PixelBlock:
    """A block of pixels and the splats whose boxes reach it."""

    pixels: Tensor  # [P] row-major index into the image
    points: Tensor  # [P, 2] px, pixel centres; of a camera with rays [P, 4], rows of ``Camera.rays``
    splats: Tensor  # [n] index into ScreenSplats, in blending order


def visible_rows(splats: Splats, camera: Camera, settings: RasterSettings, *, for_errors: bool) -> Tensor:
    """Return the rows [M] that rules 5, 6, 16, 19, 23, 24 do not cull, by increasing depth, ties by index (rule 2)."""
    used = splats.detach()
    keep = used.quats.abs().amax(dim=1) >= MIN_QUATERNION
    shN = used.shN[:, : num_coefficients(max(settings.sh_degree, 0)) - 1]
    for tensor in (used.means, used.quats, used.log_scales, used.opacity_logits):
        keep &= tensor.isfinite().flatten(1).all(dim=1) if tensor.dim() > 1 else tensor.isfinite()
    keep &= (used.sh0.abs().sum(dim=(1, 2)) + shN.abs().sum(dim=(1, 2))) <= MAX_COLOR  # comparisons with NaN are False
    keep &= (used.scales <= MAX_SIZE).all(dim=1)
    at = _to_camera(used.means, camera)
    keep &= (at.abs() <= MAX_SIZE).all(dim=1)
    depth = at[:, 2] if camera.rays is None else at.norm(dim=1)
    keep &= depth > settings.near
    rows = keep.nonzero()[:, 0]
    screen = project(used, rows, camera, settings)
    keep = screen.opacity * MAX_WIDENING >= used.opacities[rows]
    if settings.near_plane_policy == "cull":
        slant = screen.Tw[:, :2].square().sum(dim=1)  # the squared depth range of one sigma
        keep &= screen.Tw[:, 2] ** 2 > settings.error_cutoff**2 * slant
    if not for_errors:
        keep &= screen.opacity >= settings.alpha_min
    rows = rows[keep]
    return rows[depth[rows].sort(stable=True).indices]


def project(splats: Splats, rows: Tensor, camera: Camera, settings: RasterSettings) -> ScreenSplats:
    """Project ``rows`` [M] of :func:`visible_rows` to a camera, with the Mip filter if there is one; differentiable."""
    means = splats.means[rows]
    frames = quats_to_matrices(splats.quats[rows])  # [M, 3, 3], columns t_u, t_v, t_w in the world
    scales = splats.log_scales[rows].exp().clamp(min=MIN_SIZE)  # [M, 2] world units
    R = torch.as_tensor(camera.rotation, dtype=means.dtype, device=means.device)

    p = _to_camera(means, camera)  # [M, 3] world units
    tangents = torch.einsum("ij,mjk->mik", R, frames[:, :, :2] * scales[:, None, :])  # [M, 3, 2], s_u t_u and s_v t_v
    H = torch.cat([tangents, p[:, :, None]], dim=2)  # [M, 3, 3]: x_cam = H (u, v, 1)
    Tw = H[:, 2]
    # c - (cx, cy) = f p.xy / p.z, hence Tu - c_x Tw = fx H_x - (c_x - cx) H_z
    offset = p[:, :2] / p[:, 2:]  # [M, 2]
    fixed = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    intrinsics = (fixed if camera.intrinsics is None else camera.intrinsics).to(means)  # [4]
    focal, principal = intrinsics[:2], intrinsics[2:]
    Au = focal[0] * (H[:, 0] - offset[:, :1] * H[:, 2])
    Av = focal[1] * (H[:, 1] - offset[:, 1:] * H[:, 2])
    third = torch.tensor(
        [1.0, 1.0, 0.0], dtype=means.dtype, device=means.device
    )  # exact zeros instead of rounding errors

    to_splat = means - torch.as_tensor(camera.center, dtype=means.dtype, device=means.device)
    directions = to_splat / to_splat.norm(dim=1, keepdim=True)
    degree = min(settings.sh_degree, splats.sh_degree)
    if degree == PLAIN_COLORS:
        color = splats.sh0[rows][:, 0]
    else:
        color = sh_to_rgb(splats.sh0[rows], splats.shN[rows], directions, degree)
    normal = frames[:, :, 2]
    away = (normal * to_splat).sum(dim=1).detach() > 0  # rule 8
    center, Au, Av = focal * offset + principal, Au * third, Av * third
    if camera.rays is not None:
        center, Au, Av, Tw = p, H[:, :, 0], H[:, :, 1], pad(p.norm(dim=1, keepdim=True), (2, 0))
    screen = ScreenSplats(
        center=center,
        Au=Au,
        Av=Av,
        Tw=Tw,
        opacity=splats.opacity_logits[rows].sigmoid(),
        color=color,
        normal=torch.where(away[:, None], -normal, normal),
    )
    return _mip_filtered(screen, settings.mip_px, camera) if settings.mip_px > 0 else screen


def _mip_filtered(screen: ScreenSplats, sigma: float, camera: Camera) -> ScreenSplats:
    """Apply the Mip filter of rule 24, ``sigma`` px (docs/math.md, "Mip filter")."""
    if camera.rays is None:
        a, b, p = torch.stack([screen.Au, screen.Av, screen.Tw], dim=1).unbind(dim=2)
    else:
        a, b, p, sigma = screen.Au, screen.Av, screen.center, sigma / math.sqrt(camera.fx * camera.fy)
    volume = (a * torch.linalg.cross(b, p)).sum(dim=1)
    # To first order, (u, v) = z_c (row0, row1) . d for an offset d from the centre; both rows are at right angles to p.
    row0, row1 = (torch.linalg.cross(*pair) / volume[:, None] for pair in ((b, p), (p, a)))
    s2 = (sigma * screen.Tw[:, 2]) ** 2
    uu, uv, vv = ((x * y).sum(dim=1) for x, y in ((row0, row0), (row0, row1), (row1, row1)))
    det = 1 + s2 * (uu + vv) + (s2 * screen.Tw[:, 2] / volume) ** 2  # without cancellation: row0 x row1 = p / volume
    l11 = (1 + s2 * uu).sqrt()
    l21, l22 = s2 * uv / l11, det.sqrt() / l11
    axes = {"Au": l11[:, None] * a + l21[:, None] * b, "Av": l22[:, None] * b}
    if camera.rays is None:
        axes = dict(zip(("Au", "Av", "Tw"), torch.stack([*axes.values(), p], dim=2).unbind(dim=1), strict=True))
    return replace(screen, opacity=screen.opacity / (l11 * l22), **axes)


def screen_boxes(screen: ScreenSplats, cutoff_squared: Tensor, camera: Camera, settings: RasterSettings) -> Tensor:
    """Return the screen boxes of rule 14 for the disc rho3d <= k^2 = ``cutoff_squared`` [M], clipped to the image.

    They are x_min, y_min, x_max and y_max, [M, 4] float64, px. Empty boxes have max < min.
    """
    k2 = cutoff_squared.detach().double()
    if camera.rays is not None:  # the whole image; no splat is left out that a ray may reach
        limits = torch.tensor([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, camera.width, camera.height]).to(k2).reshape(2, 4)
        return limits[_reach(screen, k2, camera.rays, settings)[0].long()]
    exact = _boxes(screen, k2, camera, settings)
    if settings.near_plane_policy != "box":
        return exact
    k2 = torch.full_like(k2, settings.error_cutoff**2)
    crosses = _dot(k2, screen.Tw.detach().double(), screen.Tw.detach().double()) >= 0
    return torch.where(crosses[:, None], _square_boxes(screen, k2, camera, settings), exact)


def _reach(screen: ScreenSplats, k2: Tensor, rays: Tensor, settings: RasterSettings) -> tuple[Tensor, Tensor]:
    """Return which splats the rays of a camera may reach [M], and the chord [M] of the angle of each splat's sphere.

    A chord is the distance of two unit vectors. The sphere around a disc has the radius k max(s_u, s_v).
    """
    p, sizes = (t.detach().double() for t in (screen.center, torch.stack([screen.Au, screen.Av], dim=1).norm(dim=2)))
    ratio = (k2.sqrt() * sizes.amax(dim=1) / p.norm(dim=1)).clamp(max=1)
    chord = torch.where(ratio < 1, ratio * (2 / (1 + (1 - ratio**2).sqrt())).sqrt(), 2.0)
    shown = rays.detach().double()[rays[..., 3] < MAX_DENSITY]  # [P, 4]
    if not len(shown):
        return torch.zeros_like(ratio, dtype=torch.bool), chord
    axis = normalize(shown[:, :3].sum(dim=0), dim=0)
    around = (shown[:, :3] - axis).norm(dim=1).max()
    disc = settings.clamp_px * k2.sqrt() / shown[:, 3].min().sqrt()
    return (normalize(p, dim=1) - axis).norm(dim=1) <= around + torch.maximum(chord, disc) + 1e-6, chord


def ray_radii(screen: ScreenSplats, cutoff_squared: Tensor, camera: Camera, settings: RasterSettings) -> Tensor:
    """Return the radii [M] px of a camera with rays, of splats that a ray may reach (rule 25)."""
    assert camera.rays is not None
    k2 = cutoff_squared.detach().double()
    chord = _reach(screen, k2, camera.rays, settings)[1]
    radii = torch.maximum(math.sqrt(camera.fx * camera.fy) * chord, settings.clamp_px * k2.sqrt())
    return radii.clamp(max=max(camera.width, camera.height) / 2)


def _boxes(screen: ScreenSplats, k2: Tensor, camera: Camera, settings: RasterSettings) -> Tensor:
    """Return the boxes [M, 4] of rule 14, clipped to the image; all of it if the disc reaches the camera plane."""
    center, Au, Av, Tw = (t.detach().double() for t in (screen.center, screen.Au, screen.Av, screen.Tw))
    # The line x = X on the screen is (Au - X Tw) . (u, v, 1) = 0 in the disc's plane. It is tangent to |(u, v)| = k if
    # k^2 |(Au - X Tw).uv|^2 = ((Au - X Tw).1)^2, a quadratic in X: d (X^2 - 2 b X + a) = 0; the same for y.
    d = _dot(k2, Tw, Tw)  # < 0 while the whole disc is in front of the camera
    crosses = d >= 0
    safe = torch.where(crosses, -torch.ones_like(d), d)
    low, high = [], []
    for axis, A in enumerate((Au, Av)):
        b, a = _dot(k2, A, Tw) / safe, _dot(k2, A, A) / safe
        half = (b * b - a).clamp(min=0).sqrt()
        disc = settings.clamp_px * k2.sqrt()
        low.append(center[:, axis] + torch.minimum(b - half, -disc))
        high.append(center[:, axis] + torch.maximum(b + half, disc))
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64, device=d.device)
    lower = torch.where(crosses[:, None], torch.zeros_like(size), torch.stack(low, dim=1).clamp(min=0))
    upper = torch.where(crosses[:, None], size, torch.minimum(torch.stack(high, dim=1), size))
    return torch.cat([lower, upper], dim=1)


def _square_boxes(screen: ScreenSplats, k2: Tensor, camera: Camera, settings: RasterSettings) -> Tensor:
    """Return the tiles [M, 4] px of rule 19, "box", clipped to the image; without tiles max < min."""
    center, Au, Av, Tw = (t.detach().double() for t in (screen.center, screen.Au, screen.Av, screen.Tw))
    d = _dot(k2, Tw, Tw)
    middle = torch.stack([_dot(k2, A, Tw) / d for A in (Au, Av)], dim=1)  # [M, 2]
    squares = middle.square() - torch.stack([_dot(k2, A, A) / d for A in (Au, Av)], dim=1)
    half = squares.amax(dim=1).clamp(min=1e-4).sqrt().maximum(settings.clamp_px * k2.sqrt())
    middle = middle + center
    bounded = middle.abs().sum(dim=1) + half < 1e9  # not if the disc only touches the plane
    first = torch.where(bounded[:, None], middle - 0.5 - half.ceil()[:, None], 0.0)  # pixel centres at integers
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64, device=d.device)
    end = torch.where(bounded, 2 * half.ceil() + TILE - 1, 0.0)[:, None]
    lower, upper = (TILE * (side / TILE).clamp(min=0).floor() for side in (first, first + end))
    none = (upper <= lower).any(dim=1) | (lower >= size).any(dim=1)
    return torch.where(none[:, None], size.new_tensor([1.0, 1.0, 0.0, 0.0]), torch.cat([lower, upper.minimum(size)], 1))


def _dot(k2: Tensor, A: Tensor, B: Tensor) -> Tensor:
    """Compute <A, B> = k^2 (A.u B.u + A.v B.v) - A.1 B.1 [M] (docs/math.md, "Footprint")."""
    return k2 * (A[:, :2] * B[:, :2]).sum(dim=1) - A[:, 2] * B[:, 2]


def contains_pixel(boxes: Tensor) -> Tensor:
    """Whether a clipped box contains a pixel centre [M] bool."""
    first = (boxes[:, :2] - 0.5).ceil() + 0.5
    return (first <= boxes[:, 2:]).all(dim=1)


def blocks(boxes: Tensor, camera: Camera, dtype: torch.dtype) -> Iterator[PixelBlock]:
    """Yield blocks of pixels that together cover every pixel in a box.

    Boxes are widened slightly, so that rounding does not drop a pair that passes the exact tests. A block has at most
    ``MAX_PAIRS`` pairs, but at least one pixel.
    """
    widened = boxes + torch.tensor([-1e-2, -1e-2, 1e-2, 1e-2], dtype=boxes.dtype, device=boxes.device)
    for y in range(0, camera.height, TILE):
        y_end = min(y + TILE, camera.height)
        row = ((widened[:, 1] <= y_end - 0.5) & (widened[:, 3] >= y + 0.5)).nonzero()[:, 0]
        for x in range(0, camera.width, TILE):
            x_end = min(x + TILE, camera.width)
            ids = row[(widened[row, 0] <= x_end - 0.5) & (widened[row, 2] >= x + 0.5)]
            if len(ids) == 0:
                continue
            i = torch.arange(x, x_end, device=boxes.device)
            j = torch.arange(y, y_end, device=boxes.device)
            pixels = (j[:, None] * camera.width + i).reshape(-1)
            points = torch.stack([pixels % camera.width, pixels // camera.width], dim=1).to(dtype) + 0.5
            if camera.rays is not None:
                points = camera.rays.reshape(-1, 4)[pixels]
            step = max(1, MAX_PAIRS // len(ids))
            for start in range(0, len(pixels), step):
                yield PixelBlock(pixels[start : start + step], points[start : start + step], ids)


def cutoff_squared(opacity: Tensor, settings: RasterSettings) -> Tensor:
    """Return k^2 = 2 ln(o / alpha_min), the rho at which alpha equals alpha_min."""
    return 2 * (opacity.log() - math.log(settings.alpha_min))


def _to_camera(points: Tensor, camera: Camera) -> Tensor:
    """Transform world points [N, 3] to the camera frame."""
    T = torch.as_tensor(camera.T_cam_world, dtype=points.dtype, device=points.device)
    return points @ T[:3, :3].T + T[:3, 3]
