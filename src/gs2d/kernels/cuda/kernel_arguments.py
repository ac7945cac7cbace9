"""The argument structures of the CUDA kernels, field for field as in the ``.cu`` files; change both."""

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
    "ClearArguments",
    "DecodedTarget",
    "DepthArguments",
    "DigitArguments",
    "EmitArguments",
    "ErrorArguments",
    "FeatureArguments",
    "FeatureBuffers",
    "FinishArguments",
    "GatheredSignal",
    "KernelView",
    "MeanArguments",
    "NormalArguments",
    "OccludedArguments",
    "OrderArguments",
    "PhotometricArguments",
    "PhotometricVjpArguments",
    "PieceBuffers",
    "ProjectArguments",
    "ProjectColorsArguments",
    "ProjectVjpArguments",
    "RangeArguments",
    "RunningArguments",
    "SlotArguments",
    "SortArguments",
    "fill",
]

_Field = tuple[str, type]


def fill(arguments: ctypes.Structure, **pointers: Tensor | ctypes.Structure | int | None) -> None:
    """Set pointers of a structure to tensors, addresses or null, and members to structures."""
    for name, pointer in pointers.items():
        setattr(arguments, name, pointer.data_ptr() if isinstance(pointer, Tensor) else pointer)


def _all(kind: type, *names: str) -> tuple[_Field, ...]:
    return tuple((name, kind) for name in names)


def _pointers(*names: str) -> tuple[_Field, ...]:
    return _all(ctypes.c_void_p, *names)


class KernelView(ctypes.Structure):
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
        ("mip_px", ctypes.c_float),
    )


class ProjectArguments(ctypes.Structure):
    """Arguments of project.cu."""

    _fields_ = (
        ("view", KernelView),
        *_all(ctypes.c_int64, "count", "sh_rest"),
        *_pointers(*ATTRIBUTES, "records", "cull", "depth_keys", "rects", "tile_counts", "radii"),
        *_all(ctypes.c_int32, "errors", "exact"),
    )


class EmitArguments(ctypes.Structure):
    """Arguments of emit.cu."""

    _fields_ = (
        *_all(ctypes.c_int32, "width", "height", "tiles_x", "tiles_y"),
        ("near", ctypes.c_float),
        *_all(ctypes.c_int64, "candidates", "visible"),
        *_pointers("order", "ends", "cull", "records", "rects", "keys", "payloads"),
        ("exact", ctypes.c_int32),
    )


class RangeArguments(ctypes.Structure):
    """Arguments of emit.cu."""

    _fields_ = (("candidates", ctypes.c_int64), *_pointers("keys", "permutation", "payloads", "entries", "ranges"))


class OrderArguments(ctypes.Structure):
    """Arguments of order.cu."""

    _fields_ = (
        ("tiles", ctypes.c_int64),
        *_pointers("ranges", "order"),
        *_all(ctypes.c_int64, "capacity", "shortest", "most"),
        *_pointers("pieces"),
    )


class PieceBuffers(ctypes.Structure):
    """``struct Pieces`` of pixels.h."""

    _fields_ = (("capacity", ctypes.c_int64), *_pointers("table", "states"))


class BlendArguments(ctypes.Structure):
    """Arguments of blend.cu."""

    _fields_ = (
        ("view", KernelView),
        *_pointers("records", "entries", "ranges", "tiles", *IMAGES, "final_T", "moments", "seen"),
        ("pieces", PieceBuffers),
    )


class FeatureBuffers(ctypes.Structure):
    """``struct Features`` of pixels.h."""

    _fields_ = (
        ("count", ctypes.c_int64),
        *_pointers("values", "background", "images", "upstream", "gradients"),
    )


class FeatureArguments(ctypes.Structure):
    """Arguments of features.cu."""

    _fields_ = (
        ("view", KernelView),
        *_pointers("records", "entries", "ranges", "tiles", "seen", "final_T"),
        ("features", FeatureBuffers),
    )


class BlendVjpArguments(ctypes.Structure):
    """Arguments of blend_vjp.cu."""

    _fields_ = (
        ("view", KernelView),
        *_pointers("records", "entries", "ranges", "tiles", "seen"),
        *_pointers("color", "alpha", "normal", "depth_mean", "distortion", "final_T", "moments"),
        *_pointers(*(f"g_{name}" for name in IMAGES), "learns", "slots", "gradients", "extras"),
        *_pointers("depth_transmittance", "slope", "g_depth_transmittance"),
        ("features", FeatureBuffers),
        ("pieces", PieceBuffers),
    )


class DepthArguments(ctypes.Structure):
    """Arguments of transmittance.cu."""

    _fields_ = (
        ("view", KernelView),
        *_pointers("records", "entries", "ranges", "tiles", "seen", "alpha", "median", "depth", "slope"),
    )


class SlotArguments(ctypes.Structure):
    """Arguments of slots.cu."""

    _fields_ = (
        *_all(ctypes.c_int64, "count", "candidates"),
        *_pointers("order", "ends", "slots", "extra_slots", "gradients", "extras", "feature_slots", "features"),
        ("channels", ctypes.c_int64),
    )


class BlendColorsArguments(ctypes.Structure):
    """Arguments of blend_colors.cu."""

    _fields_ = (
        ("view", KernelView),
        *_pointers("records", "entries", "ranges", "tiles", "seen", "learns", "g_color", "slots", "gradients"),
        ("pieces", PieceBuffers),
    )


class ProjectColorsArguments(ctypes.Structure):
    """Arguments of blend_colors.cu."""

    _fields_ = (
        ("view", KernelView),
        *_all(ctypes.c_int64, "count", "sh_rest"),
        *_pointers("means", "sh0", "shN", "tile_counts", "learns", "gradients", "g_sh0", "g_shN"),
        ("clears", ctypes.c_int32),
    )


class OccludedArguments(ctypes.Structure):
    """Arguments of occluded.cu."""

    _fields_ = (("view", KernelView), *_pointers("records", "entries", "ranges", "tiles", "image", "mask", "errors"))


class GatheredSignal(ctypes.Structure):
    """``struct Gathered`` of project_vjp.cu: sums of the densification signal, updated by the kernel."""

    _fields_ = _pointers("signed_norms", "absolute_norms", "counts", "radii", "skip")


class ProjectVjpArguments(ctypes.Structure):
    """Arguments of project_vjp.cu."""

    _fields_ = (
        ("view", KernelView),
        *_all(ctypes.c_int64, "count", "sh_rest"),
        *_pointers(*ATTRIBUTES, "tile_counts", "learns", "gradients", "extras"),
        *_pointers(*(f"g_{name}" for name in ATTRIBUTES), "g_probe"),
        ("probe_columns", ctypes.c_int64),
        *_pointers("g_intrinsics"),
        ("gathered", GatheredSignal),
        ("clears", ctypes.c_int32),
    )


class ErrorArguments(ctypes.Structure):
    """Arguments of errors.cu."""

    _fields_ = (
        ("view", KernelView),
        ("count", ctypes.c_int64),
        *_pointers("records", "cull", "rects", "tile_counts", "image", "mask", "errors"),
    )


class DecodedTarget(ctypes.Structure):
    """``struct Photograph`` of photometric.cu: a decoded target image."""

    _fields_ = (*_pointers("bytes"), ("background", ctypes.c_float * 3))


class PhotometricArguments(ctypes.Structure):
    """Arguments of photometric.cu."""

    _fields_ = (
        *_all(ctypes.c_int64, "height", "width"),
        *_pointers("rendered", "target", "mask", "maps", "partials"),
        ("photograph", DecodedTarget),
    )


class PhotometricVjpArguments(ctypes.Structure):
    """Arguments of photometric.cu."""

    _fields_ = (
        *_all(ctypes.c_int64, "height", "width"),
        *_pointers("rendered", "target", "mask", "maps", "means", "g_l1", "g_ssim", "g_l2", "gradient"),
        ("photograph", DecodedTarget),
        *_all(ctypes.c_float, "l1_scale", "ssim_scale", "l2_scale"),
    )


class NormalArguments(ctypes.Structure):
    """Arguments of losses.cu."""

    _fields_ = (
        *_all(ctypes.c_int64, "height", "width"),
        *_all(ctypes.c_float, "fx", "fy", "cx", "cy"),
        ("rotation", ctypes.c_float * 9),
        *_all(ctypes.c_int32, "per_splat", "at_camera"),
        *_pointers("normal", "depth", "alpha", "mask", "weights", "partials", "means", "cotangent"),
        *_pointers("g_normal", "g_depth", "g_alpha"),
        ("scale", ctypes.c_float),
        *_pointers("object", "flatness"),
        ("flat_more", ctypes.c_float),
    )


class SmoothArguments(ctypes.Structure):
    """Arguments of losses.cu."""

    _fields_ = (
        *_all(ctypes.c_int64, "height", "width"),
        *_pointers("normal", "alpha", "flatness", "mask", "partials", "means", "cotangent", "g_normal"),
        ("scale", ctypes.c_float),
        ("adds", ctypes.c_int32),
    )


class SilhouetteArguments(ctypes.Structure):
    """Arguments of losses.cu."""

    _fields_ = (("pixels", ctypes.c_int64), *_pointers("alpha", "object", "mask", "g_alpha"), ("scale", ctypes.c_float))


class ClearArguments(ctypes.Structure):
    """Arguments of sort.cu."""

    _fields_ = (*_pointers("words"), ("count", ctypes.c_int64))


class DigitArguments(ctypes.Structure):
    """Arguments of sort.cu."""

    _fields_ = (*_pointers("keys"), ("count", ctypes.c_int64), ("passes", ctypes.c_int32), *_pointers("digits"))


class SortArguments(ctypes.Structure):
    """Arguments of sort.cu."""

    _fields_ = (
        *_pointers("keys", "payloads", "sorted_keys", "sorted_payloads"),
        ("count", ctypes.c_int64),
        *_all(ctypes.c_int32, "shift", "bits"),
        *_pointers("digits", "ticket", "words"),
    )


class RunningArguments(ctypes.Structure):
    """Arguments of sort.cu."""

    _fields_ = (
        *_pointers("order", "tile_counts"),
        *_all(ctypes.c_int64, "count", "room"),
        *_pointers("ends", "ticket", "words", "pairs", "overflow"),
    )


class MeanArguments(ctypes.Structure):
    """Arguments of losses.cu."""

    _fields_ = (*_all(ctypes.c_int64, "height", "width"), *_pointers("values", "mask", "partials"))


class FinishArguments(ctypes.Structure):
    """Arguments of losses.cu."""

    _fields_ = (
        *_pointers("partials"),
        ("blocks", ctypes.c_int64),
        *_all(ctypes.c_int32, "values", "complement"),
        *_pointers("means"),
    )


class AdamAttribute(ctypes.Structure):
    """Arguments of adam.cu."""

    _fields_ = (
        *_pointers("parameter", "mean", "square", "gradient", "trained", "rows"),
        *_all(ctypes.c_int64, "elements", "first_block"),
        *_all(ctypes.c_int32, "columns", "compact"),
        *_all(ctypes.c_float, "step_size", "root_2"),
    )


class AdamArguments(ctypes.Structure):
    """Arguments of adam.cu."""

    _fields_ = (
        ("attributes", AdamAttribute * 6),
        ("count", ctypes.c_int32),
        *_all(ctypes.c_float, "weight_1", "beta2", "weight_2", "eps"),
        *_pointers("skip"),
    )
