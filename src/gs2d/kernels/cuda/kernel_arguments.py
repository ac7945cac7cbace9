"""The structures that the CUDA kernels take, field for field as in the ``.cu`` files; change both."""

from __future__ import annotations

import ctypes

from torch import Tensor

from gs2d.core.splats import ATTRIBUTES, IMAGES

__all__ = [
    "AdamArguments",
    "AdamAttribute",
    "BlendArguments",
    "BlendColorsArguments",
    "BlendVjpArguments",
    "BlurArguments",
    "ClearArguments",
    "DepthArguments",
    "DigitArguments",
    "EmitArguments",
    "ErrorArguments",
    "FeatureArguments",
    "Features",
    "FinishArguments",
    "Gathered",
    "MeanArguments",
    "NormalArguments",
    "OccludedArguments",
    "OrderArguments",
    "Photograph",
    "PhotometricArguments",
    "PhotometricVjpArguments",
    "ProjectArguments",
    "ProjectColorsArguments",
    "ProjectVjpArguments",
    "RangeArguments",
    "RunningArguments",
    "SlotArguments",
    "SortArguments",
    "View",
    "fill",
]

_Field = tuple[str, type]


def fill(arguments: ctypes.Structure, **pointers: Tensor | int | None) -> None:
    """Set the structure's pointers: to tensors, to addresses, or null."""
    for name, pointer in pointers.items():
        setattr(arguments, name, pointer.data_ptr() if isinstance(pointer, Tensor) else pointer)


def _all(kind: type, *names: str) -> tuple[_Field, ...]:
    return tuple((name, kind) for name in names)


def _pointers(*names: str) -> tuple[_Field, ...]:
    return _all(ctypes.c_void_p, *names)


class View(ctypes.Structure):
    """``struct View`` of common.h."""

    _fields_ = (
        ("R", ctypes.c_float * 9),
        ("t", ctypes.c_float * 3),
        ("center", ctypes.c_float * 3),
        *_all(ctypes.c_float, "fx", "fy", "cx", "cy"),
        *_all(ctypes.c_float, "near", "lowpass_px", "inv_lowpass2", "log2_alpha_min", "alpha_max", "transmittance_min"),
        *_all(ctypes.c_float, "error_k2", "distortion_scale", "inv_depth_width"),
        ("background", ctypes.c_float * 3),
        *_all(ctypes.c_int32, "width", "height", "tiles_x", "tiles_y", "sh_degree", "near_plane_policy"),
    )


class ProjectArguments(ctypes.Structure):
    """Of project.cu."""

    _fields_ = (
        ("view", View),
        *_all(ctypes.c_int64, "count", "sh_rest"),
        *_pointers(*ATTRIBUTES, "records", "cull", "depth_keys", "rects", "tile_counts", "radii"),
        *_all(ctypes.c_int32, "errors", "exact"),
    )


class EmitArguments(ctypes.Structure):
    """Of emit.cu."""

    _fields_ = (
        *_all(ctypes.c_int32, "width", "height", "tiles_x", "tiles_y"),
        ("near", ctypes.c_float),
        *_all(ctypes.c_int64, "candidates", "visible"),
        *_pointers("order", "ends", "cull", "records", "rects", "keys", "payloads"),
        ("exact", ctypes.c_int32),
    )


class RangeArguments(ctypes.Structure):
    """Of emit.cu."""

    _fields_ = (("candidates", ctypes.c_int64), *_pointers("keys", "permutation", "payloads", "entries", "ranges"))


class OrderArguments(ctypes.Structure):
    """Of order.cu."""

    _fields_ = (("tiles", ctypes.c_int64), *_pointers("ranges", "order"))


class BlendArguments(ctypes.Structure):
    """Of blend.cu."""

    _fields_ = (
        ("view", View),
        *_pointers("records", "entries", "ranges", "tiles", *IMAGES, "final_T", "moments", "seen"),
    )


class Features(ctypes.Structure):
    """Of pixels.h."""

    _fields_ = (
        ("count", ctypes.c_int64),
        *_pointers("values", "background", "images", "upstream", "gradients"),
    )


class FeatureArguments(ctypes.Structure):
    """Of features.cu."""

    _fields_ = (
        ("view", View),
        *_pointers("records", "entries", "ranges", "tiles", "seen", "final_T"),
        ("features", Features),
    )


class BlendVjpArguments(ctypes.Structure):
    """Of blend_vjp.cu."""

    _fields_ = (
        ("view", View),
        *_pointers("records", "entries", "ranges", "tiles", "seen"),
        *_pointers("color", "alpha", "normal", "depth_mean", "distortion", "final_T", "moments"),
        *_pointers(*(f"g_{name}" for name in IMAGES), "learns", "slots", "gradients", "extras"),
        *_pointers("depth_transmittance", "slope", "g_depth_transmittance"),
        ("features", Features),
    )


class DepthArguments(ctypes.Structure):
    """Of transmittance.cu."""

    _fields_ = (
        ("view", View),
        *_pointers("records", "entries", "ranges", "tiles", "seen", "alpha", "median", "depth", "slope"),
    )


class SlotArguments(ctypes.Structure):
    """Of slots.cu."""

    _fields_ = (
        *_all(ctypes.c_int64, "count", "candidates"),
        *_pointers("order", "ends", "slots", "extra_slots", "gradients", "extras", "feature_slots", "features"),
        ("channels", ctypes.c_int64),
    )


class BlendColorsArguments(ctypes.Structure):
    """Of blend_colors.cu."""

    _fields_ = (
        ("view", View),
        *_pointers("records", "entries", "ranges", "tiles", "seen", "learns", "g_color", "slots", "gradients"),
    )


class ProjectColorsArguments(ctypes.Structure):
    """Of blend_colors.cu."""

    _fields_ = (
        ("view", View),
        *_all(ctypes.c_int64, "count", "sh_rest"),
        *_pointers("means", "sh0", "shN", "tile_counts", "learns", "gradients", "g_sh0", "g_shN"),
        ("clears", ctypes.c_int32),
    )


class OccludedArguments(ctypes.Structure):
    """Of occluded.cu."""

    _fields_ = (("view", View), *_pointers("records", "entries", "ranges", "tiles", "image", "mask", "errors"))


class Gathered(ctypes.Structure):
    """Of project_vjp.cu: the densification signal where it is added up at once."""

    _fields_ = _pointers("signed_norms", "absolute_norms", "counts", "radii", "skip")


class ProjectVjpArguments(ctypes.Structure):
    """Of project_vjp.cu."""

    _fields_ = (
        ("view", View),
        *_all(ctypes.c_int64, "count", "sh_rest"),
        *_pointers(*ATTRIBUTES, "tile_counts", "learns", "gradients", "extras"),
        *_pointers(*(f"g_{name}" for name in ATTRIBUTES), "g_probe"),
        ("probe_columns", ctypes.c_int64),
        *_pointers("g_intrinsics"),
        ("gathered", Gathered),
        ("clears", ctypes.c_int32),
    )


class ErrorArguments(ctypes.Structure):
    """Of errors.cu."""

    _fields_ = (
        ("view", View),
        ("count", ctypes.c_int64),
        *_pointers("records", "cull", "rects", "tile_counts", "image", "mask", "errors"),
    )


class Photograph(ctypes.Structure):
    """Of photometric.cu: a target as it was decoded."""

    _fields_ = (*_pointers("bytes"), ("background", ctypes.c_float * 3))


class PhotometricArguments(ctypes.Structure):
    """Of photometric.cu."""

    _fields_ = (
        *_all(ctypes.c_int64, "height", "width"),
        *_pointers("rendered", "target", "mask", "target_mean", "maps", "partials"),
        ("photograph", Photograph),
    )


class PhotometricVjpArguments(ctypes.Structure):
    """Of photometric.cu."""

    _fields_ = (
        *_all(ctypes.c_int64, "height", "width"),
        *_pointers("rendered", "target", "mask", "maps", "means", "g_l1", "g_ssim", "g_l2", "gradient"),
        ("photograph", Photograph),
        *_all(ctypes.c_float, "l1_scale", "ssim_scale", "l2_scale"),
    )


class BlurArguments(ctypes.Structure):
    """Of photometric.cu."""

    _fields_ = (*_all(ctypes.c_int64, "height", "width"), *_pointers("image", "out"))


class NormalArguments(ctypes.Structure):
    """Of losses.cu."""

    _fields_ = (
        *_all(ctypes.c_int64, "height", "width"),
        *_all(ctypes.c_float, "fx", "fy", "cx", "cy"),
        ("rotation", ctypes.c_float * 9),
        *_all(ctypes.c_int32, "per_splat", "at_camera"),
        *_pointers("normal", "depth", "alpha", "mask", "weights", "partials", "means", "cotangent"),
        *_pointers("g_normal", "g_depth", "g_alpha"),
        ("scale", ctypes.c_float),
        *_pointers("object"),
    )


class SilhouetteArguments(ctypes.Structure):
    """Of losses.cu."""

    _fields_ = (("pixels", ctypes.c_int64), *_pointers("alpha", "object", "mask", "g_alpha"), ("scale", ctypes.c_float))


class ClearArguments(ctypes.Structure):
    """Of sort.cu."""

    _fields_ = (*_pointers("words"), ("count", ctypes.c_int64))


class DigitArguments(ctypes.Structure):
    """Of sort.cu."""

    _fields_ = (*_pointers("keys"), ("count", ctypes.c_int64), ("passes", ctypes.c_int32), *_pointers("digits"))


class SortArguments(ctypes.Structure):
    """Of sort.cu."""

    _fields_ = (
        *_pointers("keys", "payloads", "sorted_keys", "sorted_payloads"),
        ("count", ctypes.c_int64),
        *_all(ctypes.c_int32, "shift", "bits"),
        *_pointers("digits", "ticket", "words"),
    )


class RunningArguments(ctypes.Structure):
    """Of sort.cu."""

    _fields_ = (
        *_pointers("order", "tile_counts"),
        *_all(ctypes.c_int64, "count", "room"),
        *_pointers("ends", "ticket", "words", "pairs", "overflow"),
    )


class MeanArguments(ctypes.Structure):
    """Of losses.cu."""

    _fields_ = (*_all(ctypes.c_int64, "height", "width"), *_pointers("values", "mask", "partials"))


class FinishArguments(ctypes.Structure):
    """Of losses.cu."""

    _fields_ = (
        *_pointers("partials"),
        ("blocks", ctypes.c_int64),
        *_all(ctypes.c_int32, "values", "complement"),
        *_pointers("means"),
    )


class AdamAttribute(ctypes.Structure):
    """Of adam.cu."""

    _fields_ = (
        *_pointers("parameter", "mean", "square", "gradient", "trained", "rows"),
        *_all(ctypes.c_int64, "elements", "first_block"),
        *_all(ctypes.c_int32, "columns", "compact"),
        *_all(ctypes.c_float, "step_size", "root_2"),
    )


class AdamArguments(ctypes.Structure):
    """Of adam.cu."""

    _fields_ = (
        ("attributes", AdamAttribute * 6),
        ("count", ctypes.c_int32),
        *_all(ctypes.c_float, "weight_1", "beta2", "weight_2", "eps"),
        *_pointers("skip"),
    )
