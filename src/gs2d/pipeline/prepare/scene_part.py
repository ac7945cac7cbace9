"""Train a part of a scene: some of its views, some of its splats. `gs2d blocks` uses it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe
from gs2d.core.splats import Splats
from gs2d.data import Scene
from gs2d.errors import DataError


@dataclass(frozen=True, eq=False)
class PartStart:
    """The initial state of a part.

    Attributes
    ----------
    own : Splats
        The splats that are trained.
    frozen : Splats
        Rendered with them, never changed.
    exposures : Tensor [V, 3, 4] or None
        Of the training views, if the recipe learns exposures.
    digest : str
        Hash of the above.
    within : callable or None
        For a dense start: returns whether points [M, 3] belong to the part, [M] bool.
    """

    own: Splats
    frozen: Splats
    exposures: Tensor | None
    digest: str
    within: Callable[[Tensor], Tensor] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainedPart:
    """A part of a scene with its own recipe and protocol; only its splats are written.

    Attributes
    ----------
    recipe : Recipe
    protocol : Protocol
    views : tuple of str
        Names of the training views, without test views; (): the split of the capture.
    start : PartStart or None
        None: initialised from points.
    extent : float or None
        World units; None: that of the capture.
    """

    recipe: Recipe
    protocol: Protocol
    views: tuple[str, ...] = ()
    start: PartStart | None = None
    extent: float | None = None

    def scene_of(self, scene: Scene) -> Scene:
        """Return the scene with the views and the extent of the part."""
        scene = scene if self.extent is None else replace(scene, extent=self.extent)
        if not self.views:
            return scene
        by_name = {view.name: view for view in scene.train}
        missing = [name for name in self.views if name not in by_name]
        if missing:
            raise DataError(
                f"{scene.root} lacks the training view {missing[0]} of this part ({len(missing)} missing); restore the "
                "capture, or use another --out"
            )
        return replace(scene, train=tuple(by_name[name] for name in self.views), test=())
