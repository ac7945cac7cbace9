"""The command ``gs2d edit``."""
