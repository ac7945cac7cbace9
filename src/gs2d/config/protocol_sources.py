"""Where every number of every protocol comes from, by the name of its field.

``source(protocol, field)`` answers for each field of ``Protocol`` (those of its parts as ``fusion.voxel``), of the
surface protocols and of the scenes' facts; ``stated(protocol)`` lists them all with their values. Pure Python; never
imports torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from types import MappingProxyType
from typing import Any

from gs2d.config.protocols import Protocol
from gs2d.config.surface_protocols import DtuSurface, TntSurface, VisibleSurface
from gs2d.errors import ProtocolError

_CODE, _2DGS = "the official 2DGS code", "the 2DGS paper"
_PAPER, _OURS = "the 2DGS-R paper", "gs2d (docs/decisions.md)"
_DTU_SCRIPT, _TNT_SCRIPT = "2DGS scripts/dtu_eval.py", "2DGS scripts/tnt_eval.py"
_NERF_SCRIPT, _360_SCRIPT = "2DGS scripts/nerf_eval.py", "2DGS scripts/m360_eval.py"
_TNT_TOOL = "the evaluation toolbox of Tanks and Temples"
_DTU_TOOL = "DTUeval-python, which 2DGS calls"

_COMMON = {
    "name": _OURS,
    "background": f"{_CODE}: black unless asked for white",
    "near": f"{_CODE}: its rasterizer's 0.2",
    "crossing": f"{_CODE}: the box of an ellipse, also for a splat that reaches the camera plane",
    "robust": f"{_CODE}: it starts from sparse points, and nothing keeps space free",
    "use_mask_in_training": f"{_CODE}: the background is trained",
    "use_mask_in_fusion": f"{_CODE}: depth is cleared outside the alpha mask",
    "fusion.voxel": f"{_OURS}: from the depth maps",
    "fusion.truncation": f"{_OURS}: from the depth maps",
    "fusion.depth_limit": f"{_OURS}: from the depth maps",
    "fusion.clusters": f"{_CODE}: render.py keeps 50",
    "fusion.depth": f"{_CODE}: render.py fuses the depth that was trained",
    "fusion.subject": f"{_CODE}: render.py meshes all that is inside the limits",
    "metrics.from_8bit": f"{_CODE}: metrics.py reads PNG files",
    "metrics.lpips_unit_range": f"{_CODE}: LPIPS of images in [0, 1]",
    "metrics.surface": f"{_PAPER}: F-score",
    "downscale": f"{_OURS}: full size",
    "test_every": f"{_CODE}: --eval takes every 8th view",
    "test_on": f"{_PAPER}: novel views",
}
_FUSED = ("fusion.voxel", "fusion.truncation", "fusion.depth_limit", "fusion.clusters")
_TNT = {
    "depth": f"{_TNT_SCRIPT}: depth_ratio 1",
    "distortion_weight": f"{_PAPER}, Table 1; {_TNT_SCRIPT} prints it and does not pass it on",
    "downscale": f"{_TNT_SCRIPT}: -r 2",
    "test_every": f"{_CODE}: --eval; {_PAPER}: its PSNR is of novel views",
    **dict.fromkeys(_FUSED, _TNT_SCRIPT),
}
_OWN: dict[str, dict[str, str]] = {
    "dtu": {
        "crossing": f"{_OURS}: an object; the official box lets sheets grow",
        "depth": f"{_DTU_SCRIPT}: depth_ratio 1",
        "distortion_weight": f"{_DTU_SCRIPT}: lambda_dist 1000",
        "downscale": f"{_DTU_SCRIPT}: -r 2; {_PAPER}",
        "test_every": f"{_DTU_SCRIPT}: all views train",
        "test_on": f"{_PAPER}: PSNR on the training set",
        "metrics.surface": f"{_PAPER}: Chamfer distance",
        **dict.fromkeys(_FUSED, _DTU_SCRIPT),
    },
    "tnt": _TNT,
    "tnt-large": _TNT,
    "nerf-synthetic": {
        "crossing": f"{_OURS}: an object; the official box lets white sheets grow over white",
        "depth": f"{_NERF_SCRIPT}: depth_ratio stays 0",
        "distortion_weight": f"{_2DGS}: 1000 in bounded scenes; {_NERF_SCRIPT} uses none",
        "background": f"{_NERF_SCRIPT}: --white_background",
        "test_every": "the data set's own split",
        "use_mask_in_training": f"{_CODE}: pictures are composited on the background instead",
        "fusion.clusters": f"{_CODE}: render.py keeps 50; some objects come in pieces",
        "fusion.depth": f"{_OURS}: median depth is nearer the truth",
    },
    "mip-nerf-360": {
        "depth": f"{_360_SCRIPT}: depth_ratio stays 0",
        "distortion_weight": f"{_2DGS}: 100 in unbounded scenes; {_360_SCRIPT} uses none",
        "downscale": f"{_360_SCRIPT}: images_4 outdoors, images_2 indoors (of each scene: config/datasets)",
    },
    "generic": {
        "depth": f"{_OURS}: as 2DGS advises for scenes that are not around one object",
        "distortion_weight": f"{_2DGS}: 100 in unbounded scenes",
        "near": f"{_OURS}: 1 % of the extent, for 0.2 means nothing in a frame of unknown size",
        "crossing": f"{_OURS}: floors and walls pass by the camera",
        "use_mask_in_training": f"{_OURS}: a mask that a capture comes with says which pixels to leave out",
        "fusion.subject": f"{_OURS}: what most cameras look at",
        "robust": f"{_OURS}: real captures are few photographs, unevenly spread (docs/decisions.md, Fog)",
    },
}
_PARTS: dict[str, dict[str, str]] = {
    "surface: tnt": {
        **dict.fromkeys(("camera_threshold", "camera_sample", "stages", "max_points"), _TNT_TOOL),
        "share_change": _TNT_TOOL,
        "rms_change": f"{_TNT_TOOL}: it passes its 20 iterations in this place",
        "score_voxel": _TNT_TOOL,
        **dict.fromkeys(("min_camera_share", "min_share", "max_shift", "max_scale_change"), f"{_OURS}: the self-check"),
    },
    "surface: dtu": {
        **dict.fromkeys(("density", "margin_low", "margin_high", "max_distance"), _DTU_TOOL),
        **dict.fromkeys(("dilation", "dilation_width"), "2DGS scripts/eval_dtu/evaluate_single_scene.py"),
        "min_share": f"{_OURS}: the self-check",
    },
    "surface: visible": dict.fromkeys(
        ("samples", "fractions", "headline", "min_views", "seen_tolerance"),
        f"{_OURS}: no public protocol exists for meshes of NeRF-Synthetic",
    ),
    "scenes": {
        "name": "the data set's folders",
        "protocol": f"{_TNT_SCRIPT} (which scenes are large), else the data set",
        "downscale": f"{_DTU_SCRIPT}, {_TNT_SCRIPT}: -r 2; {_360_SCRIPT}: images_4 and images_2",
        "images": "the data set's folders",
        "tau": _TNT_TOOL,
        "scan": f"{_DTU_SCRIPT}: its list of 15",
    },
}
SOURCES: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {name: MappingProxyType(_COMMON | own) for name, own in _OWN.items()}
    | {name: MappingProxyType(part) for name, part in _PARTS.items()}
)


def source(protocol: str, field: str) -> str:
    """Where a number comes from: ``source("dtu", "fusion.voxel")``, ``source("surface: tnt", "stages")``.

    Raises
    ------
    ProtocolError
        No such protocol or field; says which exist.
    """
    if protocol not in SOURCES:
        raise ProtocolError(f"no protocol {protocol!r}; there is {', '.join(SOURCES)}")
    if field not in SOURCES[protocol]:
        raise ProtocolError(f"no field {field!r} in protocol {protocol}; there is {', '.join(SOURCES[protocol])}")
    return SOURCES[protocol][field]


@dataclass(frozen=True)
class Stated:
    """A number of a protocol: the name of its field, its value in words, where it comes from."""

    field: str
    value: str
    source: str


def stated(protocol: Protocol | TntSurface | DtuSurface | VisibleSurface) -> tuple[Stated, ...]:
    """Every number of a protocol, or of a surface protocol, with its source."""
    surfaces = {TntSurface: "surface: tnt", DtuSurface: "surface: dtu", VisibleSurface: "surface: visible"}
    name = protocol.name if isinstance(protocol, Protocol) else surfaces[type(protocol)]
    values = _flat(protocol)
    values.pop("name", None)
    if values.get("fusion.depth", "") is None:
        values["fusion.depth"] = "that of the losses"
    return tuple(Stated(field, _words(value), source(name, field)) for field, value in values.items())


def _flat(value: Any, where: str = "") -> dict[str, Any]:
    """Fields of a dataclass, those of its parts with a dot."""
    found: dict[str, Any] = {}
    for field in fields(value):
        inner = getattr(value, field.name)
        found |= _flat(inner, f"{where}{field.name}.") if is_dataclass(inner) else {where + field.name: inner}
    return found


def _words(value: Any) -> str:
    if value is None:
        return "from the scene"
    if is_dataclass(value):
        return ", ".join(f"{name} {'none' if inner is None else inner}" for name, inner in _flat(value).items())
    return "; ".join(map(_words, value)) if isinstance(value, tuple) else str(value)
