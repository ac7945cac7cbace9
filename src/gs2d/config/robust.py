"""What photographs of the street need beside losses: a dense start, free space kept free, opacity that decays.

Why each is there, and what was tried instead: docs/decisions/fog.md. Pure Python; never imports torch.
"""

from __future__ import annotations

from dataclasses import dataclass, field

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
        of them learn each photograph's background by heart (docs/decisions/fog.md).
    radius : float
        In units of how far the scene goes: its cameras, and nearly all of its sparse points and swept places.
    size : float
        Standard deviation of a splat, in units of the distance to its neighbours.
    needed : float, dB
        There is no sphere where photographs whose pixels of unknown depth had one colour would have a PSNR above this:
        little is missing there, and large splats then stand where no photograph looks.
    """

    splats: int = 500
    radius: float = 3.0
    size: float = 0.8
    needed: float = 22.0


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
    fit: StartFit | None = field(default=None, metadata={"omit_empty": True})
    required: bool = field(default=True, metadata={"omit_empty": True})
    sphere: BackgroundSphere | None = field(default=None, metadata={"omit_empty": True})


@dataclass(frozen=True)
class FreeSpace:
    """Prune splats from space that photographs show to be empty (``training/free_space.py``).

    What a photograph shows at a depth, it sees through all that lies before it. Depths are those of sparse points and
    of the plane sweep, as far as a neighbour agrees.

    Attributes
    ----------
    every : int
        Iterations between prunings, and from the start to the first.
    views : int
        Photographs in whose free space a splat must lie to be pruned.
    nearer : float
        Free is what is nearer than this fraction of the depth: depths are good to a few percent.
    window : int, px
        The nearest depth in a window of so many pixels of the shrunk photographs counts, because a splat has a size and
        edges are not sharp.
    spread : float
        Standard deviations from its centre at which a splat is looked at too, along both axes.
    floor : float
        Where a photograph's depth is unknown, what is nearer than this fraction of the nearest sparse point in its
        picture is free, whether the photograph was found to show that point or not.
    ball : float
        Around a camera, within this fraction of that nearest depth, is free: the photographer stood there.
    agree : float
        Depths of the plane sweep count where a neighbour's differs by at most this fraction.
    """

    every: int = 50
    views: int = 1
    nearer: float = 0.9
    window: int = 5
    spread: float = 1.0
    floor: float = 0.8
    ball: float = 0.5
    agree: float = 0.03


@dataclass(frozen=True)
class OpacityDecay:
    """Opacity is multiplied by ``1 - rate`` every ``every`` iterations, in stages that train it for all splats.

    What many photographs need grows back at once; what one or two need for a veil does not. Unlike resets it works at
    any schedule. Splats never decay below ``least``, where they would be pruned or not drawn.

    ``backdrop_rate``, instead of ``rate``, is that of splats whose colour (of degree 0) is within ``backdrop_within``
    of the background's in every channel, both in [0, 1]; None: they are like all others. They draw what is drawn
    without them, and only hide what is wrong behind them: in a new view they hide what is right.
    """

    rate: float = 0.01
    every: int = 10
    least: float = 0.005
    backdrop_rate: float | None = field(default=None, metadata={"omit_empty": True})
    backdrop_within: float = field(default=0.06, metadata={"omit_empty": True})


@dataclass(frozen=True)
class SeenArea:
    """Prune large splats of which photographs show next to nothing (``training/seen_area.py``).

    What lies outside of all pictures answers to no loss, and hides what a new view between them should show. What lies
    behind other things hides nothing, and stays.

    Attributes
    ----------
    times : int
        Looks per stage that moves all splats, evenly spaced; the last one after its last iteration.
    least : float
        A splat stays where some photograph shows this fraction of its weight.
    inside : float
        It stays as well where this fraction of it lies within the pictures, all together.
    size : float
        Large is a splat that would fill this fraction of some picture; smaller ones cannot hide much.
    side : int, px
        Longer side of the pictures that are looked at.
    """

    times: int = 5
    least: float = 0.05
    inside: float = 0.6
    size: float = 0.001
    side: int = 200


@dataclass(frozen=True)
class SplatDropout:
    """Splats that an iteration leaves out at random where photographs are few (``training/dropout.py``).

    Attributes
    ----------
    rate : float
        Part of the splats that is left out, anew in each iteration of stages that train all of geometry and opacity.
    max_views : int
        With more training views than that none is: there it gains on some captures and loses on others
        (docs/decisions/fog.md).
    """

    rate: float = 0.1
    max_views: int = FEW_VIEWS


def check_robust(
    where: str,
    start: DenseStart | None,
    free: FreeSpace | None,
    decay: OpacityDecay | None,
    seen: SeenArea | None = None,
    dropout: SplatDropout | None = None,
) -> None:
    """Raise RecipeError for a value that cannot be trained with."""
    if dropout is not None:
        at = f"{where}: dropout"
        rate = number(f"{at}.rate", dropout.rate, low=0.0)
        require(rate < 1, f"{at}.rate must be below 1, got {rate}: nothing would be drawn")
        integer(f"{at}.max_views", dropout.max_views, low=1)
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
            number(f"{at}.sphere.needed", start.sphere.needed, low=0.0)
            for name in ("radius", "size"):
                value = number(f"{at}.sphere.{name}", getattr(start.sphere, name), low=0.0)
                require(value > 0, f"{at}.sphere.{name} must be positive, got {value}")
    if free is not None:
        at = f"{where}: free_space"
        for name in ("every", "views", "window"):
            integer(f"{at}.{name}", getattr(free, name), low=1)
        require(free.window % 2 == 1, f"{at}.window must be odd, got {free.window}")
        for name in ("nearer", "spread", "floor", "ball", "agree"):
            number(f"{at}.{name}", getattr(free, name), low=0.0)
        require(free.nearer < 1, f"{at}.nearer must be below 1, got {free.nearer}: surfaces would be pruned")
    if decay is not None:
        at = f"{where}: opacity_decay"
        integer(f"{at}.every", decay.every, low=1)
        for name in ("rate", "least"):
            value = number(f"{at}.{name}", getattr(decay, name), low=0.0)
            require(value < 1, f"{at}.{name} must be below 1, got {value}")
        number(f"{at}.backdrop_within", decay.backdrop_within, low=0.0)
        if decay.backdrop_rate is not None:
            value = number(f"{at}.backdrop_rate", decay.backdrop_rate, low=0.0)
            require(value < 1, f"{at}.backdrop_rate must be below 1, got {value}")
    if seen is not None:
        at = f"{where}: seen_area"
        integer(f"{at}.times", seen.times, low=1)
        integer(f"{at}.side", seen.side, low=16)
        for name in ("least", "inside", "size"):
            number(f"{at}.{name}", getattr(seen, name), low=0.0)
        require(seen.least < 1, f"{at}.least must be below 1, got {seen.least}: no splat is seen whole")


def _check_fit(at: str, fit: StartFit) -> None:
    require(fit.sh_degree in (0, 1, 2, 3), f"{at}.sh_degree must be 0, 1, 2 or 3, got {fit.sh_degree!r}")
    for name in ("ridge", "opacity"):
        number(f"{at}.{name}", getattr(fit, name), low=0.0)
    require(0 < fit.opacity < 1, f"{at}.opacity must be in (0, 1), got {fit.opacity}")
    for name in ("size", "max_size", "max_sparse_size"):
        require(getattr(fit, name) > 0, f"{at}.{name} must be positive, got {getattr(fit, name)}")
