"""Train a part of a scene: some of its views, some of its splats. `gs2d blocks` uses it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe
from gs2d.core.splats import Splats
from gs2d.data import Scene
from gs2d.errors import DataError
from gs2d.training.trainer import TrainerOptions


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainedPart:
    """A part of a scene with its own recipe and protocol; only its splats are written.

    Attributes
    ----------
    recipe : Recipe
    protocol : Protocol
    views : tuple of str
        Names of the training views, without test views; (): the split of the capture.
    extent : float or None
        World units; None: that of the capture.
    own : Splats or None
        The splats that are trained; None: initialised from points.
    options : TrainerOptions
        The frozen splats around them, the region of a dense start, and given exposures.
    digest : str or None
        Hash of ``own`` and ``options``.
    """

    recipe: Recipe
    protocol: Protocol
    views: tuple[str, ...] = ()
    extent: float | None = None
    own: Splats | None = None
    options: TrainerOptions = field(default_factory=TrainerOptions)
    digest: str | None = None

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
