"""Densification by absolute screen gradients (AbsGS): those of a splat's pixels do not cancel, so that it splits."""

from __future__ import annotations

from gs2d.config.densify import register_densifier
from gs2d.training.densify.gradient import GradientDensifier


@register_densifier("absolute-gradient")
class AbsoluteDensifier(GradientDensifier):
    """Splits are chosen by the absolute gradient, clones still by the signed one."""

    absolute = True
