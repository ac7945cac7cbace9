"""Settings of a dense start and of the removal of floaters. Reasons and alternatives: docs/notebook/floaters.md.

Pure Python; never imports torch.
"""

from __future__ import annotations

from dataclasses import dataclass

from gs2d.config.validate import integer, number, require

FEW_VIEWS = 24  # training images, or fewer, that training would overfit without dropout
MAX_ANGLE = 35.0  # degrees between the viewing directions of images that a dense start compares


@dataclass(frozen=True)
class DenseStart:
    """Start from points of a plane sweep over neighbouring images (``training/start/plane_sweep.py``).

    Sparse points of the capture give the depth range. Without any, the scene bounds do, inside the silhouettes of
    images with an alpha channel (``training/start/sweep_range.py``).
    """

    side: int = 200  # px; images are downscaled by a whole factor until their longer side is about this
    # Images that each image is compared with. The best two count, so that a point may be hidden from the others.
    neighbours: int = 4
    min_angle: float = 2.0  # degrees; smallest angle between the viewing directions of neighbours
    cell: float = 3.0  # px; one splat starts in each cell of this many pixels of the downscaled images
    # Whether colour, opacity and size of the splats are fitted to the images (``training/start/start_fit.py``).
    # Otherwise they start as splats of sparse points do.
    fit: bool = False
    required: bool = True  # whether training stops if no depths agree. Otherwise it reports that and starts without.
    # Whether splats on a sphere around the scene are added (``training/start/background_sphere.py``).
    sphere: bool = False
    # Whether the training cameras are adjusted to the photographs first, if those show that the cameras are off
    # (``training/start/camera_adjustment.py``).
    adjust: bool = False


@dataclass(frozen=True)
class Removal:
    """Remove floaters: splats that something speaks against and that the training images do not miss.

    Depth maps, sizes and colours only propose splats; the training images decide (``training/robust/trial.py``). In the
    same iterations, large splats on surfaces of known depth shrink (docs/notebook/floaters.md).
    """

    every: int = 50  # iterations between proposals, and from the start to the first
    # Fraction of its opacity that a splat loses every ten iterations, in stages that train the opacity of all splats.
    # Splats that several images need recover at once; floaters that only one image supports do not.
    decay: float = 0.01
    # Fraction of the splats that each iteration leaves out at random, with at most ``FEW_VIEWS`` training images. With
    # more, dropout gains on some captures and loses on others.
    dropout: float = 0.1
    # Also propose splats in the colour of the background. Set for captures in front of an even, unlit backdrop, where
    # such splats change no training image and hide what new views should show.
    backdrop: bool = False


def check_robust(where: str, start: DenseStart | None, removal: Removal | None) -> None:
    """Raise RecipeError for a value that cannot be trained with."""
    if removal is not None:
        integer(f"{where}: removal.every", removal.every, low=1)
        for name in ("decay", "dropout"):
            value = number(f"{where}: removal.{name}", getattr(removal, name), low=0.0)
            require(value < 1, f"{where}: removal.{name} must be below 1, got {value}: nothing would be drawn")
    if start is not None:
        at = f"{where}: dense_start"
        integer(f"{at}.side", start.side, low=16)
        integer(f"{at}.neighbours", start.neighbours, low=1)
        number(f"{at}.cell", start.cell, low=1.0)
        angle = number(f"{at}.min_angle", start.min_angle, low=0.0)
        require(angle < MAX_ANGLE, f"{at}.min_angle must be below {MAX_ANGLE:g} degrees, got {angle}")
