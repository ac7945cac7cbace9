"""The one public rasterizer, and the contract that every backend keeps. docs/math.md holds the formulas.

The contract
============
Each number has tests in ``tests/render/test_contract_*.py`` that run on every available backend.
Notation: a splat has centre p (camera frame, depth z_c = p.z), tangents t_u, t_v, normal t_w, scales s_u, s_v,
opacity o and colour c; a *pair* is a splat and a pixel; k^2 = 2 ln(o / alpha_min).

 1. *Pixel centres.* Pixel (column i, row j) is sampled at (i + 0.5, j + 0.5). The principal point is general.
 2. *Order.* Splats are blended by increasing z_c; equal z_c by increasing row index.
 3. *Intersection.* The ray of the pixel meets the splat's plane at p + u s_u t_u + v s_v t_v, at depth z along the
    optical axis; rho3d = u^2 + v^2. Where the ray is parallel to the plane or meets it at z <= 0 there is no hit and
    rho3d is infinite.
 4. *Low-pass filter.* rho2d = |pixel - c|^2 / lowpass_px^2, c the projection of p; rho = min(rho3d, rho2d). Where
    rho3d <= rho2d the pair's depth is z; where the filter wins it is z_c (``lowpass_depth="center"``), or z
    (``"plane"``: reference only; z_c where there is no hit).
 5. *Near.* A splat with z_c <= near is culled whole; a pair with depth < near is skipped. Splats that cross the near
    plane or the camera plane are otherwise drawn like any other (but see 19).
 6. *Alpha.* alpha = o exp(-rho / 2). A pair with alpha < alpha_min is skipped (equivalently rho > k^2; the footprint
    follows opacity); a splat with o < alpha_min is culled. alpha is then limited to alpha_max; the limit passes
    gradients unchanged.
 7. *Blending and early stop.* With T = 1 in front, each pair has weight w = alpha T, and then T becomes
    T (1 - alpha). A pixel stops *before* the pair that would bring T below transmittance_min.
    color = sum w c + T_final background; alpha image = sum w = 1 - T_final.
 8. *Normal* = sum w n in the world frame, not normalised. n is t_w, or -t_w where <t_w, p> > 0: the side that faces
    the camera as seen at the splat's centre. The choice carries no gradient.
 9. *Depth.* depth_mean = sum w z / sum w. depth_median = depth of the last blended pair whose incoming T > 0.5; its
    gradient goes to that depth alone. Both are 0 where nothing was blended.
10. *Distortion* = sum over pairs i > j of w_i w_j (m_i - m_j)^2, m = far / (far - near) (1 - near / z). Gradients go
    to weights and depths.
11. *Colour* c = SH of degree min(settings.sh_degree, splats.sh_degree) along the unit vector from the camera centre to
    the splat's centre, + 0.5, clamped at 0; clamped channels have zero gradient. The direction carries gradient.
    With settings.sh_degree = -1 c is sh0 itself, of any sign, neither shifted nor clamped, and so is its gradient.
12. *Gradients* reach means, quats, log_scales, opacity_logits, sh0, shN, screen_probe and the camera's pose (20) and
    intrinsics (21); not settings, radii, nor any threshold or order.
13. *Screen probe.* screen_probe is zeros, [N, 2] or [N, 4]. Columns 0:2 of its gradient are
    z_c (W/2, H/2) * dL/d(Tu.z, Tv.z), where Tu, Tv are the first rows of the splat-to-pixel map
    (x z, y z, z) = (Tu, Tv, Tw) (u, v, 1): the densification signal of 2DGS. Only pairs with rho3d <= rho2d count.
    Columns 2:4 are the same with the absolute value taken per pixel before the sum over pixels (AbsGS).
14. *Radii* [N] px. The screen box of a splat is the bounding box of its projected disc rho3d <= k^2, united with the
    low-pass disc |pixel - c| <= lowpass_px k, clipped to the image [0, W] x [0, H]. If the disc reaches the camera
    plane (z_c <= k |(s_u t_u.z, s_v t_v.z)|) the box is the whole image. The radius is half the longer side of the box;
    0 for culled splats and where the box holds no pixel centre.
15. *Empty.* Without splats, or where no splat blends: the background, and 0 in all other images.
16. *Non-finite.* A splat with a NaN or infinity in its parameters (SH: the evaluated degree), or a zero quaternion, is
    culled: it changes no pixel, has radius 0 and zero gradients.
17. *Splat errors.* e_i = sum over pixels inside the image with rho <= error_cutoff^2 (3, 4, 5 apply; opacity and 6 do
    not) of sum over channels |c_i - image|. Pixels where mask is False do not count. With ``occlusion`` a pixel counts
    only while it has not stopped (7) at or before this splat. No gradients. Culled splats have e_i = 0 (a splat is not
    culled for its opacity here).
18. *Gradient rows.* With ``gradient_rows`` (bool [N]) the gradients of every other splat, and of its row of
    screen_probe, are zero; images, and the gradients of these rows, are the same bit for bit as without it.
19. *Crossing.* A splat whose disc rho3d <= k^2, k = error_cutoff, reaches the camera plane (z_c <= k |(s_u t_u.z,
    s_v t_v.z)|) is drawn like any other with ``near_plane_policy="draw"``. With "cull" it is culled whole, for images
    and splat errors alike. With "box" it is seen, and counts in splat errors, only in the 16x16 tiles that the square
    of the official rasterizer touches: centre b and half side h = ceil(max(|b^2 - a|_+^1/2, lowpass_px k)) of the
    line that touches an ellipse (docs/math.md, "Footprint"), although the disc's image is a hyperbola; its radius is
    half the longer side of these tiles, clipped to the image.
20. *Camera.* Where T_cam_world was given as a tensor that requires a gradient it gets one, [4, 4]: its inner product
    with a change of T_cam_world along a rigid motion is the derivative of the loss. Of other changes (of scale, of
    shear) it says nothing. Images and all other gradients are the same bit for bit. ``gradient_rows`` (18) would leave
    out the part of the other splats, and is refused.
21. *Intrinsics.* Where the camera has a tensor ``intrinsics`` that requires a gradient it gets the derivative of the
    loss by fx, fy, cx and cy, [4], the pixels' centres held. Images and all other gradients are the same bit for bit.
    ``gradient_rows`` is refused as in 20.
22. *Depth by transmittance*, only with settings.with_transmittance_depth. The opacity of each pair is spread over a
    little depth around its own: T(z) = prod (1 - alpha_i F((z / z_i - 1) / kappa)) over the blended pairs, in whatever
    order, F(x) = (2 + 3 x - x^3) / 4 within [-1, 1], 0 before and 1 behind, kappa = depth_width_px / sqrt(fx fy).
    depth_transmittance is the z with 1 - T(z) = alpha / 2, alpha the pixel of the alpha image: T = 1/2 where that is 1;
    0 where nothing was blended. Its gradient reaches alpha and depth of every blended pair (implicit function), with
    -dT/dz taken for at least 0.05 alpha / (kappa z); kappa carries none.
23. *Range.* What float32 cannot square is kept out, alike on every backend. A splat is culled, as in 16, where a
    coordinate of p or a scale is beyond 1e9 world units, where the absolute coefficients of its colour (SH: the
    evaluated degree) add up to more than 1e15, and where no component of its quaternion reaches 1e-15, which counts as
    a zero quaternion. A scale below 1e-18 world units counts as 1e-18. A quaternion of any greater length is its
    direction, and an opacity logit may be any finite number.
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
from gs2d.render.types import MAX_COLOR, NEAR_PLANE_POLICIES, PLAIN_COLORS, Features, RasterSettings, RenderOutput

__all__ = ["rasterize", "rasterize_features", "splat_errors"]


def rasterize(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 (frozen)
    *,
    backend: str | Backend = "auto",
    screen_probe: Tensor | None = None,
    gradient_rows: Tensor | None = None,
) -> RenderOutput:
    """Render splats: all images of one view, differentiable (the contract is in this module's docstring).

    Parameters
    ----------
    splats : Splats
        N splats, float32, or float64 for the reference backend.
    camera : Camera
        With a ``pose``, or ``intrinsics``, that requires a gradient, that of the camera is worked out too (20, 21).
    settings : RasterSettings
    backend : str or Backend
        "auto" (by the device of the splats), "cpu", "cuda" or "reference" (``gs2d.render.backends``).
    screen_probe : Tensor [N, 2] or [N, 4], optional
        Zeros with ``requires_grad``; its gradient is the densification signal (rule 13). That it is zeros is checked
        on the CPU only.
    gradient_rows : Tensor [N] bool, optional
        The splats that learn: all others get zero gradients (rule 18), which the cpu backend saves computing.

    Returns
    -------
    RenderOutput
        Images in the dtype and on the device of the splats.

    Raises
    ------
    ShapeError
        If a tensor has another shape or dtype than stated, or a setting is out of range.
    BackendError
        If the backend cannot run here, or not with these inputs.
    """
    _check_types(splats, camera, settings, screen_probe=screen_probe, gradient_rows=gradient_rows)
    chosen = backend if isinstance(backend, Backend) else get_backend(backend, splats.device.type)
    settings, camera = _checked_view(splats, camera, settings, chosen, screen_probe)
    if gradient_rows is not None and (camera.pose is not None or camera.intrinsics is not None):
        raise ShapeError(
            "gradient_rows must be None for a camera that learns, whose gradient is a sum over all splats, got "
            "rows; leave one of the two away"
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

    Rules 16 and 23 include these channels: a splat with one that is not finite, or whose absolute values add up to more
    than 1e15, is culled.

    Parameters
    ----------
    splats, camera, screen_probe
        As for :func:`rasterize`.
    settings : RasterSettings
        With ``sh_degree`` -1 and without depth by transmittance.
    features : Features
    backend : Backend

    Raises
    ------
    ShapeError, BackendError
        As for :func:`rasterize`.
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
    """Validate one view; return the settings for these splats, and the camera, which learns only if gradients do."""
    settings = _checked(splats, settings, backend)
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
        # On a GPU the look would make the host wait in every iteration.
        if screen_probe.device.type == "cpu" and bool((screen_probe.detach() != 0).any()):
            raise ShapeError("screen_probe must be all zeros (its gradient is what matters), got other values")
    if not torch.is_grad_enabled() and (camera.pose is not None or camera.intrinsics is not None):
        camera = replace(camera, pose=None, intrinsics=None)
    return settings, camera


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
    """Compute the inner sum of the paper's E_i (Eq. 8) for one view: each splat's colour error over its footprint.

    Parameters
    ----------
    splats, camera, settings, backend
        As for :func:`rasterize`.
    image : Tensor [H, W, 3]
        The photograph, in [0, 1], same dtype as the splats.
    mask : Tensor [H, W] bool, optional
        False = ignore this pixel.
    occlusion : bool
        Count a pixel only while it has not stopped at or before the splat. The paper does not.

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
    H, W = camera.height, camera.width
    arrays: dict[str, tuple[Tensor, str]] = {"image": (image, f"{H} {W} 3")}
    if mask is not None:
        arrays["mask"] = (mask, f"{H} {W}")
        if mask.dtype != torch.bool:
            raise ShapeError(f"mask must be bool (False = ignore), got {mask.dtype}")
    check_shapes(arrays)
    if image.dtype != splats.dtype:
        raise ShapeError(f"image must be {splats.dtype} like the splats, in [0, 1], got {image.dtype}")
    return chosen.splat_errors(splats, camera, image, settings, mask, occlusion)


def check_dense(name: str, tensor: object) -> None:
    """Raise ShapeError for anything but a torch tensor whose numbers are all there (not sparse)."""
    if not isinstance(tensor, Tensor):
        raise ShapeError(f"{name} must be a torch tensor, got {type(tensor).__name__}; use torch.as_tensor")
    if tensor.layout != torch.strided:
        raise ShapeError(f"{name} must be a dense tensor, got the layout {tensor.layout}; use its to_dense()")


_OPTIONAL = ("screen_probe", "gradient_rows", "mask")


def _check_types(splats: object, camera: object, settings: object, **tensors: object) -> None:
    """One line instead of an AttributeError from within; the order of the arguments is what people get wrong."""
    for name, value, kind in (
        ("splats", splats, Splats),
        ("camera", camera, Camera),
        ("settings", settings, RasterSettings),
    ):
        if not isinstance(value, kind):
            raise ShapeError(f"{name} must be of type gs2d's {kind.__name__}, got {type(value).__name__}")
    for name, tensor in {**vars(splats), **tensors}.items():
        if tensor is None and name in _OPTIONAL:
            continue
        check_dense(name, tensor)
    assert isinstance(camera, Camera)
    if not camera.is_at_pose:
        raise ShapeError(
            "the camera must stand where its pose is, got a pose that has changed since the camera was made (by an "
            "optimizer?); make a camera of the new one: replace(camera, T_cam_world=camera.pose)"
        )
    if not camera.has_its_intrinsics:
        raise ShapeError(
            "the camera must have the fx, fy, cx and cy of its intrinsics, got a tensor that has changed since the "
            "camera was made (by an optimizer?); make a camera of the new ones"
        )


def _checked(splats: Splats, settings: RasterSettings, backend: Backend) -> RasterSettings:
    """Validate splats and settings; return the settings with the SH degree that the splats can hold."""
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
            f"lowpass_depth={settings.lowpass_depth!r} is a setting of the reference backend, got backend "
            f"{backend.name!r}: use backend='reference' or lowpass_depth='center'"
        )
    return replace(settings, sh_degree=min(settings.sh_degree, held))


def check_settings(s: RasterSettings) -> None:
    """Raise for a number or a word that no rasterizer takes."""

    def require(holds: bool, field: str, rule: str) -> None:
        if not holds:
            raise ShapeError(f"RasterSettings.{field} must be {rule}, got {getattr(s, field)!r}")

    require(math.isfinite(s.near) and s.near > 0, "near", "positive")
    require(math.isfinite(s.far) and s.far > s.near, "far", f"larger than near ({s.near})")
    require(0 < s.alpha_min < 1, "alpha_min", "in (0, 1)")
    require(s.alpha_min <= s.alpha_max < 1, "alpha_max", f"in [alpha_min, 1) = [{s.alpha_min:.6g}, 1)")
    require(0 < s.transmittance_min < 0.5, "transmittance_min", "in (0, 0.5)")
    require(math.isfinite(s.error_cutoff) and s.error_cutoff > 0, "error_cutoff", "positive")
    require(math.isfinite(s.lowpass_px) and s.lowpass_px > 0, "lowpass_px", "positive")
    if s.sh_degree == PLAIN_COLORS:
        require(len(s.background) == 3 and all(map(math.isfinite, s.background)), "background", "3 finite numbers")
    else:
        require(len(s.background) == 3 and all(0 <= b <= 1 for b in s.background), "background", "3 numbers in [0, 1]")
        require(0 <= s.sh_degree <= MAX_DEGREE, "sh_degree", f"0 to {MAX_DEGREE} (-1: plain colours)")
    require(math.isfinite(s.depth_width_px) and s.depth_width_px > 0, "depth_width_px", "positive")
    require(s.lowpass_depth in ("center", "plane"), "lowpass_depth", "'center' or 'plane'")
    require(s.near_plane_policy in NEAR_PLANE_POLICIES, "near_plane_policy", "'draw', 'cull' or 'box'")
