"""The losses that there are, by name. Pure Python: a name can be checked without torch."""

from __future__ import annotations

from typing import Any

from gs2d.config.multiview import MULTIVIEW_KINDS
from gs2d.config.priors import PRIOR_KINDS
from gs2d.config.registry import Registry
from gs2d.errors import RecipeError

LOSS_KINDS = (
    *("l1", "ssim", "l2", "normal_consistency", "normal_consistency_per_splat", "distortion", "silhouette"),
    *MULTIVIEW_KINDS,
)
LOSSES: Registry[Any] = Registry(
    "loss",
    "gs2d.losses",
    builtin=dict.fromkeys(LOSS_KINDS, "gs2d.losses.api") | dict.fromkeys(PRIOR_KINDS, "gs2d.training.prior_losses"),
    error=RecipeError,
)
"""Kinds of loss -> a function of images, or a class with data of its own (``gs2d.losses.api``)."""
register_loss = LOSSES.register
