"""``python -m gs2d``: the same as the command ``gs2d``."""

from __future__ import annotations

from gs2d.cli import main

if __name__ == "__main__":
    main()
