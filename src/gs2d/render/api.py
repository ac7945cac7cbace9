"""The public rasterizer, and the contract that every backend fulfils. docs/math.md has the formulas.

The contract
============
Each rule has tests in ``tests/render/test_contract_*.py`` that run on every available backend.
Notation: a splat has centre p (camera frame, depth z_c = p.z), tangents t_u, t_v, normal t_w, scales s_u, s_v,
opacity o and colour c. A *pair* is a splat and a pixel. k^2 = 2 ln(o / alpha_min).

 1. *Pixel centres.* Pixel (column i, row j) is sampled at (i + 0.5, j + 0.5). The principal point is general.
 2. *Order.* Splats are blended by increasing z_c; equal z_c by increasing row index.
 3. *Intersection.* The ray of the pixel intersects the splat's plane at p + u s_u t_u + v s_v t_v, at depth z along
    the optical axis; rho3d = u^2 + v^2. If the ray is parallel to the plane or the intersection has z <= 0, there is
    no hit and rho3d is infinite.
 4. *Low-pass filter*, unless there is a Mip filter (24). rho2d = |pixel - c|^2 / lowpass_px^2, where c is the
    projection of p; rho = min(rho3d, rho2d).
    If rho3d <= rho2d, the pair's depth is z. Otherwise it is z_c (``lowpass_depth="center"``), or z (``"plane"``,
    reference only; z_c without a hit).
 5. *Near.* A splat with z_c <= near is culled; a pair with depth < near is skipped. Splats that cross the near plane
    or the camera plane are otherwise drawn like any other (but see 19).
 6. *Alpha.* alpha = o exp(-rho / 2). A pair with alpha < alpha_min is skipped (equivalently rho > k^2: the footprint
    depends on opacity). A splat with o < alpha_min is culled. alpha is then limited to alpha_max; gradients pass the
    limit unchanged.
 7. *Blending and early stop.* T starts at 1. Each pair has weight w = alpha T, then T becomes T (1 - alpha). A pixel
    stops *before* the pair that would reduce T below transmittance_min.
    color = sum w c + T_final background; alpha image = sum w = 1 - T_final.
 8. *Normal* = sum w n in the world frame, not normalised. n is t_w, or -t_w if <t_w, p> > 0: the side that faces the
    camera at the splat's centre. The sign has no gradient.
 9. *Depth.* depth_mean = sum w z / sum w. depth_median is the depth of the last blended pair with incoming T > 0.5;
    its gradient reaches only that depth. Both are 0 where nothing was blended.
10. *Distortion* = sum over pairs i > j of w_i w_j (m_i - m_j)^2, m = far / (far - near) (1 - near / z). Gradients
    reach weights and depths.
11. *Colour* c = SH of degree min(settings.sh_degree, splats.sh_degree) along the unit vector from the camera centre to
    the splat's centre, + 0.5, clamped at 0. Clamped channels have zero gradient. The direction has a gradient. With
    settings.sh_degree = -1, c is sh0 itself, of any sign, neither shifted nor clamped, and its gradient likewise.
12. *Gradients* reach means, quats, log_scales, opacity_logits, sh0, shN, screen_probe, and the camera's pose (20) and
    intrinsics (21). Settings, radii, thresholds and the order have none.
13. *Screen probe.* screen_probe is zeros, [N, 2] or [N, 4]. Columns 0:2 of its gradient are
    z_c (W/2, H/2) * dL/d(Tu.z, Tv.z), where Tu, Tv are the first rows of the splat-to-pixel map
    (x z, y z, z) = (Tu, Tv, Tw) (u, v, 1): the densification signal of 2DGS. Only pairs with rho3d <= rho2d count.
    Columns 2:4 are the same with the absolute value taken per pixel before the sum over pixels (AbsGS).
14. *Radii* [N] px. The screen box of a splat is the bounding box of its projected disc rho3d <= k^2, united with the
    low-pass disc |pixel - c| <= lowpass_px k, clipped to the image [0, W] x [0, H]. If the disc reaches the camera
    plane (z_c <= k |(s_u t_u.z, s_v t_v.z)|), the box is the whole image. The radius is half the longer side of the
    box; 0 for culled splats and if the box contains no pixel centre.
15. *Empty.* Without splats, or where no splat is blended, colour is the background and all other images are 0.
16. *Non-finite.* A splat with a NaN or infinity in its parameters (SH: the evaluated degree) or a zero quaternion is
    culled: it changes no pixel, and has radius 0 and zero gradients.
17. *Splat errors.* e_i = sum over pixels inside the image with rho <= error_cutoff^2 (3, 4, 5 apply; opacity and 6 do
    not) of sum over channels |c_i - image|. Pixels where mask is False do not count. With ``occlusion``, a pixel counts
    only if it has not stopped (7) at or before this splat. No gradients. Culled splats have e_i = 0; the opacity culls
    no splat here.
18. *Gradient rows.* With ``gradient_rows`` (bool [N]), all other splats and their rows of screen_probe have zero
    gradients. Images, and the gradients of these rows, have the same bits as without it.
19. *Crossing.* A splat whose disc rho3d <= k^2, k = error_cutoff, reaches the camera plane (z_c <= k |(s_u t_u.z,
    s_v t_v.z)|) is drawn like any other with ``near_plane_policy="draw"``. With "cull" it is culled, for images and
    splat errors alike. With "box" it is visible, and counts in splat errors, only in the 16x16 tiles that the square of
    the official rasterizer touches: centre b and half side h = ceil(max(|b^2 - a|_+^1/2, lowpass_px k)) of the tangent
    of an ellipse (docs/math.md, "Footprint"), although the disc's image is a hyperbola. Its radius is half the longer
    side of these tiles, clipped to the image.
20. *Camera.* A T_cam_world given as a tensor that requires a gradient gets one, [4, 4]: its inner product with a change
    of T_cam_world along a rigid motion is the derivative of the loss. It is undefined for other changes (scale, shear).
    Images and all other gradients have the same bits. ``gradient_rows`` (18) would drop the contribution of the other
    splats, and is refused.
21. *Intrinsics.* A camera's tensor ``intrinsics`` that requires a gradient gets the derivative of the loss by fx, fy,
    cx and cy, [4], for fixed pixel centres. Images and all other gradients have the same bits. ``gradient_rows`` is
    refused as in 20.
22. *Depth by transmittance*, only with settings.with_transmittance_depth. The opacity of each pair is spread over a
    depth interval around its depth: T(z) = prod (1 - alpha_i F((z / z_i - 1) / kappa)) over the blended pairs, in any
    order. F(x) = (2 + 3 x - x^3) / 4 within [-1, 1], 0 before and 1 behind; kappa = depth_width_px / sqrt(fx fy).
    depth_transmittance is the z with 1 - T(z) = alpha / 2, where alpha is the pixel of the alpha image; 0 where nothing
    was blended. Its gradient reaches alpha and depth of every blended pair (implicit function), with -dT/dz bounded
    below by 0.05 alpha / (kappa z); kappa has none.
23. *Range.* Values whose squares overflow float32 are excluded, alike on every backend. A splat is culled, as in 16, if
    a coordinate of p or a scale exceeds 1e9 world units, if the absolute coefficients of its colour (SH: the evaluated
    degree) sum to more than 1e15, or if no component of its quaternion reaches 1e-15, which counts as a zero
    quaternion. A scale below 1e-18 world units counts as 1e-18. Longer quaternions are normalised, and an opacity logit
    may be any finite number.
24. *Mip filter*, only with settings.mip_px = sigma > 0; it replaces 4. A Gaussian of sigma px on the screen, mapped to
    the splat's plane at its centre, is added to the splat's Gaussian: with J = d(u, v) / d(pixel) at the centre and
    L L^T = I + sigma^2 J J^T, the axes (s_u t_u, s_v t_v) become (s_u t_u, s_v t_v) L and the opacity o / det L. All
    other rules see these axes and this opacity; in 13, L does not depend on Tu and Tv. A splat with det L > 1e4 is
    culled.
25. *Rays.* A camera with ``rays`` (``gs2d.render.rays.ray_map``) has in each pixel that unit ray r from its centre,
    instead of a pinhole's. Depth is then distance: z is |hit - camera centre| and z_c is |p|, in all rules. In 4,
    rho2d = density |p/|p| - r|^2 / lowpass_px^2, density = pixels per steradian around the pixel: a disc of directions
    with the same area in pixels. Pixels without a ray show the background. In 13, p moves along two axes at right
    angles to it, by 1/fx and 1/fy of the pinhole's Tu.z and Tv.z. In 14, the radius is the larger of sqrt(fx fy) times
    the chord of the angle of the sphere of radius k max(s_u, s_v) around p, and lowpass_px k, at most half the longer
    side; 0 if that is outside the cone around all rays. In 24, sigma is mip_px / sqrt(fx fy) radians around each
    centre. 19 is "draw", and fx, fy, cx and cy have no other effect. On the reference backend rays have gradients.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.core.sh import MAX_DEGREE, sh_degree_of
from gs2d.core.splats import Splats
from gs2d.errors import BackendError, ShapeError
from gs2d.render.backends import Backend, get_backend
from gs2d.render.pose_gradient import attach_pose_grad, with_world_normals
from gs2d.render.rays import MAX_DENSITY
from gs2d.render.reference_contributors import first_contributors as first_of
from gs2d.render.types import (
    MAX_COLOR,
    NEAR_PLANE_POLICIES,
    PLAIN_COLORS,
    Contributors,
    Features,
    RasterSettings,
    RenderOutput,
)


def rasterize(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 (frozen)
    *,
    backend: str | Backend = "auto",
    screen_probe: Tensor | None = None,
    gradient_rows: Tensor | None = None,
) -> RenderOutput:
    """Render all images of one view, differentiably (the contract is in this module's docstring).

    Parameters
    ----------
    splats : Splats
        N splats, float32, or float64 for the reference backend.
    camera : Camera
        A ``pose`` or ``intrinsics`` that requires a gradient gets one (rules 20, 21).
    settings : RasterSettings
    backend : str or Backend
        "auto" (by the device of the splats), "cpu", "cuda" or "reference" (``gs2d.render.backends``).
    screen_probe : Tensor [N, 2] or [N, 4], optional
        Zeros with ``requires_grad``; its gradient is the densification signal (rule 13). Only the CPU checks that it
        is zero.
    gradient_rows : Tensor [N] bool, optional
        Splats with gradients; all others get zeros (rule 18), and the cpu backend skips their work.

    Returns
    -------
    RenderOutput
        Images in the dtype and on the device of the splats.

    Raises
    ------
    ShapeError
        If a tensor has another shape or dtype, or a setting is out of range.
    BackendError
        If the backend cannot run here, or does not support these inputs.
    """
    _check_types(splats, camera, settings, screen_probe=screen_probe, gradient_rows=gradient_rows)
    chosen = backend if isinstance(backend, Backend) else get_backend(backend, splats.device.type)
    settings, camera = _checked_view(splats, camera, settings, chosen, screen_probe)
    if gradient_rows is not None and (camera.pose is not None or camera.intrinsics is not None):
        raise ShapeError(
            "gradient_rows must be None if the camera has gradients, which are sums over all splats, got rows; "
            "leave out one of the two"
        )
    if camera.pose is not None:
        splats = attach_pose_grad(splats, camera.pose, settings.sh_degree)
        output = chosen.rasterize(splats, camera, settings, screen_probe)
        return with_world_normals(output, camera.pose)
    if gradient_rows is None:
        return chosen.rasterize(splats, camera, settings, screen_probe)
    check_shapes({"means": (splats.means, "N 3"), "gradient_rows": (gradient_rows, "N")})
    if gradient_rows.dtype != torch.bool or gradient_rows.device != splats.device:
        raise ShapeError(
            f"gradient_rows must be bool on {splats.device} (True = has gradients), got {gradient_rows.dtype} "
            f"on {gradient_rows.device}"
        )
    return chosen.rasterize(splats, camera, settings, screen_probe, gradient_rows)


def rasterize_features(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    features: Features,
    *,
    backend: Backend,
    screen_probe: Tensor | None = None,
) -> RenderOutput:
    """Render splats with further plain channels: :func:`rasterize` with a colour image [H, W, 3 + F].

    The settings have ``sh_degree`` -1 and no depth by transmittance. Rules 16 and 23 include these channels: a splat is
    culled if a channel is not finite or their absolute values sum to more than 1e15.
    """
    _check_types(splats, camera, settings, screen_probe=screen_probe)
    settings, camera = _checked_view(splats, camera, settings, backend, screen_probe)
    if not bool(features.background.isfinite().all()):
        raise ShapeError("the background of all channels must be finite, got NaN or an infinity")
    drawn = features.values.detach().abs().sum(dim=1) <= MAX_COLOR  # False for NaN
    splats = replace(splats, opacity_logits=torch.where(drawn, splats.opacity_logits, torch.nan))
    if camera.pose is None:
        return backend.rasterize_features(splats, camera, settings, features, screen_probe)
    splats = attach_pose_grad(splats, camera.pose, settings.sh_degree)
    output = backend.rasterize_features(splats, camera, settings, features, screen_probe)
    return with_world_normals(output, camera.pose)


def _checked_view(
    splats: Splats, camera: Camera, settings: RasterSettings, backend: Backend, screen_probe: Tensor | None
) -> tuple[RasterSettings, Camera]:
    """Validate one view; return the settings for these splats, and the camera without gradients if grad is disabled."""
    settings = _checked(splats, settings, backend)
    _check_rays(splats, camera, settings, backend)
    if settings.with_transmittance_depth and not settings.depth_width(camera) < 0.5:
        raise ShapeError(
            "RasterSettings.depth_width_px must be less than half the focal length "
            f"({camera.fx:g} x {camera.fy:g} px), got {settings.depth_width_px!r}"
        )
    if screen_probe is not None:
        columns = screen_probe.shape[1] if screen_probe.dim() == 2 else 0
        if columns not in (2, 4):
            raise ShapeError(f"screen_probe must be [N, 2] or [N, 4], got {list(screen_probe.shape)}")
        check_shapes({"means": (splats.means, "N 3"), "screen_probe": (screen_probe, f"N {columns}")})
        if screen_probe.dtype != splats.dtype or screen_probe.device != splats.device:
            raise ShapeError(
                f"screen_probe must be {splats.dtype} on {splats.device} like the splats, "
                f"got {screen_probe.dtype} on {screen_probe.device}"
            )
        # On a GPU the check would make the host wait in every iteration.
        if screen_probe.device.type == "cpu" and bool((screen_probe.detach() != 0).any()):
            raise ShapeError("screen_probe must be all zeros (its gradient is what matters), got other values")
    if not torch.is_grad_enabled() and (camera.pose is not None or camera.intrinsics is not None):
        camera = replace(camera, pose=None, intrinsics=None)
    return settings, camera


def _check_rays(splats: Splats, camera: Camera, settings: RasterSettings, backend: Backend) -> None:
    """Raise an error if a camera has rays that this backend cannot render with these settings (rule 25)."""
    rays = camera.rays
    if rays is None:
        return
    if not backend.takes_rays:
        raise BackendError(f"backend {backend.name!r} renders pinhole cameras only, got rays: use cpu or reference")
    check_dense("rays", rays)
    check_shapes({"Camera.rays, a gs2d.render.rays.ray_map,": (rays, f"{camera.height} {camera.width} 4")})
    if (rays.dtype, rays.device) != (splats.dtype, splats.device):
        raise ShapeError(
            f"rays must be {splats.dtype} on {splats.device} like the splats, got {rays.dtype} on {rays.device}"
        )
    if rays.requires_grad and torch.is_grad_enabled() and not backend.ray_gradients:
        raise BackendError(
            f"backend {backend.name!r} has no gradients of rays: detach them, or use backend='reference'"
        )
    x, y, z, density = rays.detach().unbind(dim=2)
    away = (x * x + y * y + z * z - (density < MAX_DENSITY).to(x)).abs()  # of the squared length, 0 without a ray
    if not (rays.is_contiguous() and bool((away < 1e-3).all()) and bool((density > 0).all())):  # False for NaN
        raise ShapeError("Camera.rays must be contiguous and of unit length: make them with gs2d.render.rays.ray_map")
    if settings.near_plane_policy != "draw" or camera.intrinsics is not None:
        raise ShapeError(
            "a camera with rays has no camera plane and no gradient of intrinsics: set near_plane_policy='draw' and "
            "intrinsics=None"
        )


def splat_errors(
    splats: Splats,
    camera: Camera,
    image: Tensor,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 (frozen)
    *,
    backend: str | Backend = "auto",
    mask: Tensor | None = None,
    occlusion: bool = False,
) -> Tensor:
    """Compute the inner sum of the paper's E_i (Eq. 8) for one view: the colour error of each splat's footprint.

    Parameters
    ----------
    splats, camera, settings, backend
        As for :func:`rasterize`.
    image : Tensor [H, W, 3]
        Target image in [0, 1], with the dtype of the splats.
    mask : Tensor [H, W] bool, optional
        False = ignore this pixel.
    occlusion : bool
        Count a pixel only until it has stopped; not in the paper.

    Returns
    -------
    Tensor [N]
        Sum over pixels and channels of ``|c_i - image|``; no gradient.

    Raises
    ------
    ShapeError, BackendError
        As for :func:`rasterize`.
    """
    _check_types(splats, camera, settings, image=image, mask=mask)
    chosen = backend if isinstance(backend, Backend) else get_backend(backend, splats.device.type)
    settings = _checked(splats, settings, chosen)
    _check_rays(splats, camera, settings, chosen)
    H, W = camera.height, camera.width
    arrays: dict[str, tuple[Tensor, str]] = {"image": (image, f"{H} {W} 3")}
    if mask is not None:
        arrays["mask"] = (mask, f"{H} {W}")
        if mask.dtype != torch.bool or mask.device != splats.device:
            raise ShapeError(
                f"mask must be bool (False = ignore) on {splats.device}, got {mask.dtype} on {mask.device}"
            )
    check_shapes(arrays)
    if (image.dtype, image.device) != (splats.dtype, splats.device):
        raise ShapeError(
            f"image must be {splats.dtype} on {splats.device} like the splats, in [0, 1], got {image.dtype} on "
            f"{image.device}"
        )
    return chosen.splat_errors(splats, camera, image, settings, mask, occlusion)


def splat_sums(
    splats: Splats,
    camera: Camera,
    values: Tensor,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 (frozen)
    *,
    backend: str | Backend = "auto",
) -> tuple[Tensor, Tensor]:
    """Sum the values of pixels for each splat, weighted as the splat is blended into the pixel.

    The weight of a splat in a pixel is w of rule 7, the factor of its colour. A blended image is linear
    in the colours, so these sums are the gradient of its scalar product with ``values``: one pass forward and back.
    Divided by the weights, they are the mean over the pixels that show a splat: so labels or features of images become
    labels or features of splats.

    Parameters
    ----------
    splats, camera, settings, backend
        As for :func:`rasterize`; ``sh_degree`` and ``background`` are ignored.
    values : Tensor [H, W, D]
        Finite values of any sign, with dtype and device of the splats.

    Returns
    -------
    sums : Tensor [N, D]
        Sum of weight times value; no gradient.
    weights : Tensor [N]
        Sum of the weights, px; 0 for splats that no pixel shows.

    Raises
    ------
    ShapeError, BackendError
        As for :func:`rasterize`.

    Examples
    --------
    >>> sums, weights = gs2d.splat_sums(splats, camera, features)  # doctest: +SKIP
    >>> lifted = sums / weights.clamp(min=1e-6)[:, None]  # doctest: +SKIP
    """
    check_dense("values", values)
    check_shapes({"values": (values, f"{camera.height} {camera.width} _")})
    if (values.dtype, values.device) != (splats.dtype, splats.device) or not bool(values.isfinite().all()):
        raise ShapeError(
            f"values must be finite {splats.dtype} on {splats.device} like the splats, got {values.dtype} on "
            f"{values.device}{'' if bool(values.isfinite().all()) else ' with NaN or infinity'}"
        )
    chosen = backend if isinstance(backend, Backend) else get_backend(backend, splats.device.type)
    settings = replace(settings, sh_degree=PLAIN_COLORS, background=(0.0, 0.0, 0.0), with_distortion=False)
    camera = replace(camera, pose=None, intrinsics=None)  # the result has no gradient
    ones = torch.ones_like(values[..., :1])
    target = torch.cat([values.detach(), *[ones] * max(3 - values.shape[-1], 1)], dim=2)  # [H, W, 3 or more]
    with torch.enable_grad():
        colors = torch.zeros((len(splats), target.shape[-1]), dtype=splats.dtype, device=splats.device)
        colors.requires_grad_()
        plain = replace(splats.detach(), sh0=colors[:, None, :3], shN=splats.shN.detach()[:, :0])
        features = Features(colors[:, 3:], torch.zeros_like(target[0, 0, 3:]))
        if target.shape[-1] == 3:
            image = rasterize(plain, camera, settings, backend=chosen).color
        else:
            image = rasterize_features(plain, camera, settings, features, backend=chosen).color
        (sums,) = torch.autograd.grad(image, colors, grad_outputs=target)
    return sums[:, : values.shape[-1]], sums[:, values.shape[-1]]


def first_contributors(
    splats: Splats,
    camera: Camera,
    points: Tensor,
    count: int = 8,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 (frozen)
) -> Contributors:
    """Return the first splats that are blended into points of an image, differentiably.

    For some points: each is compared with every splat, in plain torch on the device of the splats. Weights, depth,
    normals and uv have gradients by the splats; the camera gets none.

    Parameters
    ----------
    splats, camera, settings
        As for :func:`rasterize`.
    points : Tensor [P, 2]
        (x, y), px; the centre of the first pixel is (0.5, 0.5). Dtype and device of the splats.
    count : int
        K.

    Returns
    -------
    Contributors
        ``ids``, ``weights``, ``depth``, ``normal`` and ``uv``, each with a leading [P, K].

    Raises
    ------
    ShapeError
        As for :func:`rasterize`, or if ``count`` is not positive.
    """
    _check_types(splats, camera, settings, points=points)
    check_shapes({"points": (points, "P 2")})
    if (points.dtype, points.device) != (splats.dtype, splats.device) or count < 1:
        raise ShapeError(
            f"first_contributors needs points of {splats.dtype} on {splats.device} like the splats and a positive "
            f"count, got {points.dtype} on {points.device} and {count}"
        )
    if camera.rays is not None:
        raise ShapeError("first_contributors takes points of a pinhole image, got a camera with rays")
    camera = replace(camera, pose=None, intrinsics=None)
    settings, camera = _checked_view(splats, camera, settings, get_backend("reference"), None)
    return first_of(splats, camera, points, count, settings)


def check_dense(name: str, tensor: object) -> None:
    """Raise ShapeError for anything but a dense torch tensor."""
    if not isinstance(tensor, Tensor):
        raise ShapeError(f"{name} must be a torch tensor, got {type(tensor).__name__}; use torch.as_tensor")
    if tensor.layout != torch.strided:
        raise ShapeError(f"{name} must be a dense tensor, got the layout {tensor.layout}; use its to_dense()")


_OPTIONAL = ("screen_probe", "gradient_rows", "mask")


def _check_types(splats: object, camera: object, settings: object, **tensors: object) -> None:
    """Raise ShapeError for arguments of a wrong type, such as swapped ones, and for a camera with a stale pose."""
    for name, value, kind in (
        ("splats", splats, Splats),
        ("camera", camera, Camera),
        ("settings", settings, RasterSettings),
    ):
        if not isinstance(value, kind):
            raise ShapeError(f"{name} must be a gs2d {kind.__name__}, got {type(value).__name__}")
    for name, tensor in {**vars(splats), **tensors}.items():
        if tensor is None and name in _OPTIONAL:
            continue
        check_dense(name, tensor)
    assert isinstance(camera, Camera)
    if not camera.is_at_pose:
        raise ShapeError(
            "the camera's pose tensor has changed since the camera was created (by an optimizer?); create a camera "
            "with the new pose: replace(camera, T_cam_world=camera.pose)"
        )
    if not camera.has_its_intrinsics:
        raise ShapeError(
            "the camera's intrinsics tensor has changed since the camera was created (by an optimizer?); create a "
            "camera with the new intrinsics"
        )


def _checked(splats: Splats, settings: RasterSettings, backend: Backend) -> RasterSettings:
    """Validate splats and settings; return the settings with the SH degree limited to that of the splats."""
    check_shapes(
        {
            "means": (splats.means, "N 3"),
            "quats": (splats.quats, "N 4"),
            "log_scales": (splats.log_scales, "N 2"),
            "opacity_logits": (splats.opacity_logits, "N"),
            "sh0": (splats.sh0, "N 1 3"),
            "shN": (splats.shN, "N _ 3"),
        }
    )
    held = sh_degree_of(1 + splats.shN.shape[1])
    for name, tensor in splats.items():
        if tensor.dtype != splats.dtype or tensor.dtype not in (torch.float32, torch.float64):
            raise ShapeError(f"{name} must be float32 or float64 like means ({splats.dtype}), got {tensor.dtype}")
        if tensor.device != splats.device:
            raise ShapeError(f"{name} must be on {splats.device} like means, got {tensor.device}")
    check_settings(settings)
    if settings.lowpass_depth not in backend.lowpass_depths:
        raise BackendError(
            f"only the reference backend supports lowpass_depth={settings.lowpass_depth!r}, got backend "
            f"{backend.name!r}: use backend='reference' or lowpass_depth='center'"
        )
    return replace(settings, sh_degree=min(settings.sh_degree, held))


def check_settings(s: RasterSettings) -> None:
    """Raise ShapeError for invalid settings."""

    def require(condition: bool, field: str, rule: str) -> None:
        if not condition:
            raise ShapeError(f"RasterSettings.{field} must be {rule}, got {getattr(s, field)!r}")

    require(math.isfinite(s.near) and s.near > 0, "near", "positive")
    require(math.isfinite(s.far) and s.far > s.near, "far", f"larger than near ({s.near})")
    require(0 < s.alpha_min < 1, "alpha_min", "in (0, 1)")
    require(s.alpha_min <= s.alpha_max < 1, "alpha_max", f"in [alpha_min, 1) = [{s.alpha_min:.6g}, 1)")
    require(0 < s.transmittance_min < 0.5, "transmittance_min", "in (0, 0.5)")
    require(math.isfinite(s.error_cutoff) and s.error_cutoff > 0, "error_cutoff", "positive")
    require(math.isfinite(s.lowpass_px) and s.lowpass_px > 0, "lowpass_px", "positive")
    require(math.isfinite(s.mip_px) and s.mip_px >= 0, "mip_px", "0 or positive")
    if s.sh_degree == PLAIN_COLORS:
        require(len(s.background) == 3 and all(map(math.isfinite, s.background)), "background", "3 finite numbers")
    else:
        require(len(s.background) == 3 and all(0 <= b <= 1 for b in s.background), "background", "3 numbers in [0, 1]")
        require(0 <= s.sh_degree <= MAX_DEGREE, "sh_degree", f"0 to {MAX_DEGREE} (-1: plain colours)")
    require(math.isfinite(s.depth_width_px) and s.depth_width_px > 0, "depth_width_px", "positive")
    require(s.lowpass_depth in ("center", "plane"), "lowpass_depth", "'center' or 'plane'")
    require(s.near_plane_policy in NEAR_PLANE_POLICIES, "near_plane_policy", "'draw', 'cull' or 'box'")
