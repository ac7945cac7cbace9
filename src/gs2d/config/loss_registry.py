"""Registered losses, by name. Pure Python: a name can be checked without torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from gs2d.config.registry import Register, Registry
from gs2d.errors import RecipeError

MODULES = {
    "gs2d.losses.view_terms": (
        *("l1", "ssim", "l2", "normal_consistency", "normal_consistency_per_splat", "normal_smoothness"),
        *("distortion", "silhouette"),
    ),
    "gs2d.losses.prior_terms": ("depth_prior", "normal_prior"),
}
NEEDS = ("silhouette", "flatness", "distortion")
"""Inputs of losses that are computed or loaded only on request."""
LOSSES: Registry[Any] = Registry(
    "loss",
    "gs2d.losses",
    builtin={kind: module for module, kinds in MODULES.items() for kind in kinds},
    error=RecipeError,
)
"""Kinds of loss -> a function of images, or a subclass of ``gs2d.losses.base.Loss``."""


def register_loss(name: str, *, needs: Sequence[str] = ()) -> Callable[[Register], Register]:
    """Return a decorator that registers a loss, so that ``LossTerm(name, weight)`` can use it.

    Parameters
    ----------
    name : str
        Kind of the loss; must not be taken.
    needs : sequence of str
        Inputs that are computed or loaded only on request: "silhouette" (``view.silhouette``, the alpha channel of the
        image), "flatness" (``view.flatness``, where the image has no texture) or "distortion" (``output.distortion``).

    Returns
    -------
    callable
        Decorates a function ``(output, view, **options)`` that returns a scalar Tensor, unweighted, or None to skip the
        view: ``output`` is a RenderOutput (images [H, W, C]), ``view`` a ``gs2d.losses.base.LossView``. Or it decorates
        a subclass of ``gs2d.losses.base.Loss``, whose constructor takes the options.

    Raises
    ------
    RecipeError
        If a need is unknown; from the decorator, if the name is taken.

    Examples
    --------
    >>> import gs2d
    >>> @gs2d.register_loss("crisp")
    ... def crisp(output, view, power=1.0):
    ...     return (4 * output.alpha * (1 - output.alpha)).clamp_min(0).pow(power).mean()
    >>> recipe = gs2d.get_recipe("2dgs").with_loss(gs2d.LossTerm("crisp", 0.1, options={"power": 2.0}))
    """
    if isinstance(needs, str) or not set(needs) <= set(NEEDS):
        raise RecipeError(f"needs of loss {name!r} must be a list of {', '.join(NEEDS)}, got {needs!r}")

    def registered(loss: Register) -> Register:
        LOSSES.register(name)(loss)
        if needs:
            loss.needs = frozenset(needs)  # type: ignore[attr-defined]
        return loss

    return registered
