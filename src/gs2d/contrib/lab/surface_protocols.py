"""The settings of the official and our own surface protocols, with their sources.

Sources: [tnt] the evaluation toolbox of Tanks and Temples (isl-org, as 2DGS ships it), [dtu] the Python version of the
DTU evaluation (jzhangbs/DTUeval-python, as 2DGS ships it), [s] the 2DGS script that calls it, [d] this project.
Pure Python; never imports torch.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class IcpStage:
    """One stage of the alignment, in units of tau."""

    # Both clouds are thinned to one point in each cube of this side; None: to at most ``max_points`` each.
    voxel: float | None
    threshold: float  # pairs farther apart do not count
    iterations: int  # upper limit


@dataclass(frozen=True)
class TntSurface:
    """F-score of Tanks and Temples."""

    # m. Camera centres that agree within this distance are inliers.
    camera_threshold: float = 0.2  # [tnt]
    # pairs in a random sample
    camera_sample: int = 6  # [tnt]
    # [tnt] states 20 iterations but passes them as the rms criterion. Open3D therefore uses its default, 30 iterations,
    # and stops by the share of paired points only.
    stages: tuple[IcpStage, ...] = (IcpStage(1.0, 80.0, 30), IcpStage(0.5, 20.0, 30), IcpStage(None, 2.0, 30))  # [tnt]
    # Limit on the points of each cloud in a stage without a voxel.
    max_points: int = 4_000_000  # [tnt]
    # A stage ends when the share of paired points and their rms (m) both change by less than these.
    fraction_change: float = 1e-6  # [tnt]
    rms_change: float = 20.0  # [tnt] in effect off
    # tau. Both clouds are thinned to this voxel before they are scored.
    score_voxel: float = 0.5  # [tnt]
    # Limits of the self-check: share of inlier cameras, share of the mesh that the first stage pairs, shift of the mesh
    # by the stages (tau), and change of its size.
    min_camera_fraction: float = (
        0.75  # [d] all cameras of all scenes of the official logs agree when the frame is right
    )
    min_fraction: float = 0.5  # [d] at 80 tau (0.24 to 2 m) even a poor mesh lies beside the scan
    max_shift: float = 20.0  # [d] the reach of the second stage
    max_scale_change: float = 0.05  # [d] pairing with scale alone shrinks a rough mesh by a few per cent


@dataclass(frozen=True)
class DtuSurface:
    """Chamfer distance of DTU, mm."""

    # Spacing of points on the mesh; no two are nearer.
    density: float = 0.2  # [dtu]
    # Widening of the bounding box of the observation mask at its lower and upper corner.
    margin_low: float = 60.0  # [dtu] patch_size
    margin_high: float = 120.0  # [dtu] twice patch_size
    # Longer distances are dropped.
    max_distance: float = 20.0  # [dtu]
    # px of an image ``dilation_width`` wide: the silhouettes that cull the mesh are widened by this radius.
    dilation: float = 24.0  # [s] a disk of radius 24
    dilation_width: int = 1600  # [s] the hard-coded 1600 x 1200
    # The self-check requires at least this fraction of the points within ``max_distance`` of the scan.
    min_fraction: float = 0.5  # [d]


TNT_SURFACE = TntSurface()
DTU_SURFACE = DtuSurface()


@dataclass(frozen=True)
class VisibleSurfaceProtocol:
    """Chamfer and F-score over the surface visible in the training views, our protocol (docs/guides/evaluation.md)."""

    # Points on each surface, area-weighted, from a seed.
    samples: int = 200_000  # [d] all of it: no public protocol exists for NeRF-Synthetic meshes
    # Thresholds as fractions of the diagonal of the true bounding box; the main figures are those at the first.
    fractions: tuple[float, ...] = (0.0025, 0.005, 0.01)  # [d] the strictest first: at 0.5 % all methods look alike
    # True surface visible in fewer training views does not count.
    min_views: int = 3  # [d] fewer views do not determine a surface
    # Largest distance behind the depth buffer at which a point is visible, as a fraction of the diagonal.
    seen_tolerance: float = 0.002  # [d] against ray-cast counts: 2 % of the area more, 0.2 % less


VISIBLE_SURFACE = VisibleSurfaceProtocol()
