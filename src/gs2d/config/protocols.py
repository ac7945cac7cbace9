"""Protocols: settings that depend on the data set (depth, background, near, split, masks, fusion limits, metrics).

Sources, marked at each number: [s] the official 2DGS scripts (dtu_eval, tnt_eval, nerf_eval, m360_eval), [c] the
official 2DGS code, [2dgs] the 2DGS paper, [r] the 2DGS-R paper, [d] a decision of this project.
Pure Python; never imports torch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from gs2d.config.recipe import LossTerm
from gs2d.config.registry import Registry
from gs2d.errors import ProtocolError, RecipeError

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
RELATIVE_NEAR = 0.01  # [d] of the extent, if a protocol has no near


@dataclass(frozen=True)
class FusionLimits:
    """Settings of the fusion of depth maps into a mesh; None is derived from the scene."""

    # voxel, truncation: world units. Voxel size, and the distance at which the signed distance saturates.
    voxel: float | None = None  # [d] from the depth maps, and the next two
    truncation: float | None = None
    depth_limit: float | None = None  # world units. Depths beyond it are ignored.
    # Number of largest connected components to keep; 0 keeps all.
    clusters: int = 50  # [c] render.py
    # "mean", "median" or "transmittance": the fused depth; None: that of the losses
    depth: str | None = None  # [c] render.py fuses the depth that was trained
    # Mesh what most cameras look at (``data.subject_box``), cleaned and simplified by evidence; False: all that is
    # inside the limits, as the scripts of the data sets do.
    subject: bool = False  # [c] render.py meshes all that is inside the limits


@dataclass(frozen=True)
class MetricConventions:
    """Conventions of reported image and surface quality."""

    # Image metrics on renders quantised to 8 bits, as the official code measures them from PNG files.
    from_8bit: bool = True  # [c] metrics.py reads PNG files
    # LPIPS of values in [0, 1], as in the official code, instead of the [-1, 1] of the network.
    lpips_unit_range: bool = True  # [c] metrics.py
    # "chamfer" or "f_score": the main figure against ground truth
    surface: str = "f_score"  # [r]


@dataclass(frozen=True)
class Protocol:
    """Settings that a recipe leaves to the data set.

    Attributes
    ----------
    name : str
    depth : str
        "mean", "median" or "transmittance": depth of surface normals and of fusion, unless a loss names one.
    loss_weights : mapping of kind to float
        Weights of losses without a weight of their own (Table 1 of the 2DGS-R paper).
    background : tuple of 3 floats
        Colour behind everything, in [0, 1].
    near : float or None
        World units. None: 1 % of the scene's extent.
    near_plane_policy : str
        "draw", "cull" or "box": treatment of splats that reach the camera plane (``RasterSettings``).
    downscale : int
        Factor by which the paper shrinks images.
    test_every : int
        Every N-th view (by name) is a test view if the format has no split; 0: all views train.
    test_on : str
        "test" or "train": the views of the main image metrics.
    robust : bool
        Whether ``--robust auto`` makes recipes robust, if the capture allows it.
    use_mask_in_training, use_mask_in_fusion : bool
        Whether losses and ranking, and fusion, ignore masked pixels.
    fusion : FusionLimits
    metrics : MetricConventions
    """

    name: str
    depth: str
    loss_weights: Mapping[str, float] = field(hash=False)
    background: tuple[float, float, float] = BLACK  # [c] unless white is set
    near: float | None = None
    near_plane_policy: str = "draw"
    downscale: int = 1  # [d] full size
    test_every: int = 8  # [c] --eval
    test_on: str = "test"  # [r] novel views
    robust: bool = False
    use_mask_in_training: bool = True
    use_mask_in_fusion: bool = True  # [c] depth is cleared outside the alpha mask
    fusion: FusionLimits = FusionLimits()
    metrics: MetricConventions = MetricConventions()

    @property
    def white(self) -> bool:
        """Return whether the background is white, for which 2DGS resets opacity once more."""
        return self.background == WHITE

    def near_for(self, extent: float) -> float:
        """Return the near distance in a scene of this extent, world units."""
        return RELATIVE_NEAR * extent if self.near is None else self.near

    @property
    def fused_depth(self) -> str:
        """Return the fused depth: "mean", "median" or "transmittance"."""
        return self.depth if self.fusion.depth is None else self.fusion.depth

    def resolve(self, terms: Sequence[LossTerm]) -> tuple[LossTerm, ...]:
        """Return the terms with missing weights and depths filled in, without terms of weight 0.

        Raises
        ------
        RecipeError
            If neither a term nor the protocol has a weight.
        """
        resolved = []
        for term in terms:
            weight = self.loss_weights.get(term.kind) if term.weight is None else term.weight
            if weight is None:
                kinds = ", ".join(self.loss_weights)
                raise RecipeError(f"loss {term.kind!r} needs a weight; protocol {self.name!r} has one for {kinds} only")
            resolved.append(replace(term, weight=weight, depth=self.depth if term.depth is None else term.depth))
        return tuple(term for term in resolved if term.weight)


DTU = Protocol(
    "dtu",
    depth="median",  # [s] depth_ratio 1
    loss_weights={"distortion": 1000.0},  # [s] lambda_dist 1000
    near=0.2,  # [c] rasterizer
    near_plane_policy="cull",  # [d] objects: splats at the camera are wrong
    downscale=2,  # [s] -r 2, [r]
    test_every=0,  # [s] all views train
    test_on="train",  # [r] "we evaluated PSNR on the training set"
    use_mask_in_training=False,  # [c] the mask multiply is commented out: the background is trained
    fusion=FusionLimits(voxel=0.004, truncation=0.016, depth_limit=3.0, clusters=1),  # [s]
    metrics=MetricConventions(surface="chamfer"),  # [r]
)
NERF_SYNTHETIC = Protocol(
    "nerf-synthetic",
    depth="mean",  # [s] depth_ratio stays 0
    loss_weights={"distortion": 1000.0},  # [2dgs] bounded scenes; the script uses none
    background=WHITE,  # [s] --white_background
    near=0.2,  # [c]
    near_plane_policy="cull",  # [d] else white sheets grow over the white background, also with the official box
    test_every=8,  # [d] for captures without transforms_test.json, which has the split of the data set
    use_mask_in_training=False,  # the images are composited on the background instead
    # [d] no script meshes this set: limits from the scene; some objects come in pieces; median is nearer the truth
    fusion=FusionLimits(depth="median"),
)
GENERIC = Protocol(
    "generic",
    depth="mean",  # [d] as 2DGS advises for scenes that are not object-centred
    loss_weights={"distortion": 100.0},  # [2dgs] unbounded scenes
    near=None,  # [d] the scale is unknown
    test_every=8,  # [c] --eval
    fusion=FusionLimits(subject=True),  # [d] photographs of objects, without their surroundings
    robust=True,  # [d] real captures: few, unevenly spread photographs with automatic exposure
)

PROTOCOLS: Registry[Protocol] = Registry(
    "protocol",
    "gs2d.protocols",
    builtin=dict.fromkeys((DTU.name, NERF_SYNTHETIC.name, GENERIC.name), __name__),
    error=ProtocolError,
)
for _protocol in (DTU, NERF_SYNTHETIC, GENERIC):
    PROTOCOLS.register(_protocol.name, module=__name__)(_protocol)


def get_protocol(name: str) -> Protocol:
    """Return the protocol of a name.

    Raises ProtocolError if there is no protocol of this name; lists the names.
    """
    if name not in PROTOCOLS:
        raise ProtocolError(PROTOCOLS.unknown(name, also=("auto",)))
    return PROTOCOLS[name]
