"""What the CUDA tests share: the emulator's folder and the rasterizer tests' scenes on the path."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "render"))  # render_scenes
