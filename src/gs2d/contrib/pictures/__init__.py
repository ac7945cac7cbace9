"""The command ``gs2d render``."""
