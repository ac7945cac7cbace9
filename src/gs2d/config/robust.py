"""Settings of robust training beside losses: a dense start, and the removal of floaters.

Reasons and alternatives: docs/notebook/floaters.md. Pure Python; never imports torch.
"""

from __future__ import annotations

from dataclasses import dataclass

from gs2d.config.validate import integer, number, require

FEW_VIEWS = 24  # training photographs, or less: what shows in one of them alone is learned by heart (fog.md)


@dataclass(frozen=True)
class StartFit:
    """Splats of a dense start that look like the photographs from the first iteration (``training/start_fit.py``).

    Attributes
    ----------
    sh_degree : int
        Colour is fitted by least squares up to this degree (and the recipe's) over the views that see a splat. Degrees
        above 0 need a stage that trains them from its first iteration (``sh_interval=0``).
    ridge : float, views
        Coefficients above degree 0 are drawn to 0 as strongly as by so many views.
    opacity : float
        Of every splat.
    size : float
        Times the mean distance to the three nearest splats: the standard deviations of a splat.
    max_size : float, px
        A splat is not larger than so many pixels of the nearest view that shows it: what lies apart stays small.
    max_sparse_size : float, px
        The same for splats at sparse points that are apart from all swept places. They stand for surroundings on which
        no photographs agree (bare tables, cloth), begin as large as 2DGS's and must reach far.
    """

    sh_degree: int = 0
    ridge: float = 1.0
    opacity: float = 0.5
    size: float = 0.7
    max_size: float = 6.0
    max_sparse_size: float = 24.0


@dataclass(frozen=True)
class BackgroundSphere:
    """Splats around everything where no depth is known, to start from (``training/background_sphere.py``).

    Attributes
    ----------
    splats : int
        On the whole sphere, evenly; those in directions that no photograph shows are left out. Few and large ones: more
        of them learn each photograph's background by heart (docs/notebook/floaters.md).
    radius : float
        In units of how far the scene goes: its cameras, and nearly all of its sparse points and swept places.
    size : float
        Standard deviation of a splat, in units of the distance to its neighbours.
    """

    splats: int = 500
    radius: float = 3.0
    size: float = 0.8


@dataclass(frozen=True)
class DenseStart:
    """Splats to start from where a plane sweep over neighbouring photographs agrees (``training/plane_sweep.py``).

    Where a capture has sparse points, those give the depths to try, else the scene's bounds do
    (``training/sweep_range.py``): inside the silhouettes of all photographs, where they have an alpha channel.

    Attributes
    ----------
    side : int, px
        Photographs are shrunk by a whole factor until their longer side is about this.
    planes : int
        Depths that are tried for each pixel, evenly spaced in 1/z over the depths of the view's sparse points.
    neighbours : int
        Photographs that each is compared with; the best two count, so that one may be hidden from a place.
    min_angle, max_angle : float, degrees
        Between the lines of sight of neighbours at the scene.
    radius : int, px
        Patches of 2 radius + 1 pixels a side are compared by normalised cross-correlation (NCC).
    min_ncc : float
        Places with a lower NCC are unknown.
    agree : float
        Depths of two views agree when they differ by at most this fraction.
    votes : int
        Neighbours that must agree for a splat to start there.
    cell : float, px
        One splat starts in each cell of so many pixels of the shrunk photographs.
    max_views : int
        Photographs that are swept, evenly chosen, beside those that they are compared with.
    fit : StartFit or None
        How splats are fitted to the photographs; None: grey-opaque beginnings as from sparse points, in the colour of
        one photograph.
    required : bool
        Whether training stops where photographs agree on nothing; if not, it says so and starts without.
    sphere : BackgroundSphere or None
        Splats around everything, for what no depth is known of.
    """

    side: int = 200
    planes: int = 64
    neighbours: int = 4
    min_angle: float = 2.0
    max_angle: float = 35.0
    radius: int = 3
    min_ncc: float = 0.5
    agree: float = 0.02
    votes: int = 2
    cell: float = 3.0
    max_views: int = 120
    fit: StartFit | None = None
    required: bool = True
    sphere: BackgroundSphere | None = None


@dataclass(frozen=True)
class Removal:
    """Remove floaters: splats that something speaks against and that the training images do not miss.

    Depth maps, sizes and colours only propose splats; the training images decide (``training/trial.py``). In the same
    iterations, large splats on surfaces of known depth shrink (docs/notebook/floaters.md).

    Attributes
    ----------
    every : int
        Iterations between proposals, and from the start to the first.
    decay : float
        Fraction of its opacity that a splat loses every ten iterations, in stages that train the opacity of all splats.
        What several images need grows back at once, a veil that one image asks for does not.
    dropout : float
        Fraction of the splats that each iteration leaves out at random, where at most ``FEW_VIEWS`` images train: with
        more, dropout gains on some captures and loses on others.
    backdrop : bool
        Also propose splats in the colour of the background. Set for captures before an even, unlit backdrop, where such
        splats draw what is drawn without them and hide what new views should show.
    """

    every: int = 50
    decay: float = 0.01
    dropout: float = 0.1
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
        least = {"side": 16, "planes": 4, "neighbours": 1, "radius": 1, "votes": 1, "max_views": 2}
        for name, low in least.items():
            integer(f"{at}.{name}", getattr(start, name), low=low)
        for name in ("min_angle", "max_angle", "min_ncc", "agree", "cell"):
            number(f"{at}.{name}", getattr(start, name), low=0.0)
        require(start.cell >= 1, f"{at}.cell must be at least 1 px, got {start.cell}")
        require(start.min_angle < start.max_angle, f"{at}.min_angle must be below max_angle, got {start.min_angle}")
        if start.fit is not None:
            _check_fit(f"{at}.fit", start.fit)
        if start.sphere is not None:
            integer(f"{at}.sphere.splats", start.sphere.splats, low=1)
            for name in ("radius", "size"):
                value = number(f"{at}.sphere.{name}", getattr(start.sphere, name), low=0.0)
                require(value > 0, f"{at}.sphere.{name} must be positive, got {value}")


def _check_fit(at: str, fit: StartFit) -> None:
    require(fit.sh_degree in (0, 1, 2, 3), f"{at}.sh_degree must be 0, 1, 2 or 3, got {fit.sh_degree!r}")
    for name in ("ridge", "opacity"):
        number(f"{at}.{name}", getattr(fit, name), low=0.0)
    require(0 < fit.opacity < 1, f"{at}.opacity must be in (0, 1), got {fit.opacity}")
    for name in ("size", "max_size", "max_sparse_size"):
        require(getattr(fit, name) > 0, f"{at}.{name} must be positive, got {getattr(fit, name)}")
