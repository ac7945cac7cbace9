"""Settings of the losses between two views. Pure Python; never imports torch."""

from __future__ import annotations

from dataclasses import dataclass

from gs2d.config.validate import integer, number, require

LARGEST = {"patches": 1_000_000, "radius": 50, "depth_downscale": 16}  # more is a typing error


@dataclass(frozen=True)
class MultiView:
    """Comparison of training views with a neighbour (``losses/view_pair.py``, ``training/neighbours.py``).

    Attributes
    ----------
    patches : int
        Pixels that are compared in an iteration.
    radius : int, px
        A patch has 2 radius + 1 pixels a side.
    texture : float
        Smallest standard deviation of grey in [0, 1] over a patch, above noise.
    opacity : float
        Smallest rendered alpha of a compared pixel.
    occluded : float, px
        Pixels with a larger round-trip error through the neighbour's depth are hidden there and do not count.
    neighbours : int
        Nearest training views that each view is compared with, one in each iteration.
    max_angle : float, degrees
        Largest angle between the optical axes of neighbours.
    min_baseline, max_baseline : float
        Distance between the cameras of neighbours, as a fraction of the distance to the scene.
    depth_downscale : int
        Factor by which the rendered depth of the neighbour is smaller. This rendering is the larger part of the cost.
    """

    patches: int = 2048
    radius: int = 3
    texture: float = 0.02
    opacity: float = 0.9
    occluded: float = 1.0
    neighbours: int = 4
    max_angle: float = 45.0
    min_baseline: float = 0.05
    max_baseline: float = 1.0
    depth_downscale: int = 1

    @property
    def side(self) -> int:
        """Side of a patch in pixels."""
        return 2 * self.radius + 1


def check_multiview(where: str, multiview: MultiView) -> None:
    """Raise RecipeError for an invalid value."""
    for name in ("patches", "radius", "neighbours", "depth_downscale"):
        integer(f"{where}.{name}", getattr(multiview, name), low=1)
    for name, largest in LARGEST.items():
        value = getattr(multiview, name)
        require(value <= largest, f"{where}.{name} must be at most {largest}, got {value}")
    for name in ("texture", "opacity", "occluded", "max_angle", "min_baseline", "max_baseline"):
        value = number(f"{where}.{name}", getattr(multiview, name), low=0.0)
        require(value > 0 or name == "min_baseline", f"{where}.{name} must be positive, got {value}")
    require(
        multiview.opacity < 1, f"{where}.opacity must be below 1, which no rendering reaches, got {multiview.opacity}"
    )
    require(multiview.max_angle <= 90, f"{where}.max_angle must be at most 90 degrees, got {multiview.max_angle}")
    require(
        multiview.min_baseline < multiview.max_baseline,
        f"{where}.min_baseline must be below max_baseline, got {multiview.min_baseline} and {multiview.max_baseline}",
    )
