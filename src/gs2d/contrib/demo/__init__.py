"""The command ``gs2d demo``, and its capture: a rendered scene with an exactly known surface."""
