"""Time the free-space check of robust training, native and in torch; training runs it every 50 iterations.

::

    python -m benchmarks.free_space CAPTURE[:DOWNSCALE] ... [--repeat 3]

For each capture with sparse points, the initial splats are checked in all photographs. Reports CPU seconds per check
(minimum of the repetitions) and the number of splats on which both implementations disagree. Runs on one thread.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from gs2d.config.presets import get_recipe, with_robustness
from gs2d.config.protocols import GENERIC
from gs2d.data import Scene, load_scene
from gs2d.errors import Gs2dError
from gs2d.training.robust import free_space_maps as free_space
from gs2d.training.trainer import Trainer


def look(scene: Scene, repeat: int) -> tuple[int, list[float], int]:
    """Return the number of splats, native and torch seconds, and the number of splats with different results."""
    trainer = Trainer(scene, with_robustness(get_recipe("best")), GENERIC, backend="cpu")
    maps, splats = trainer._robust._free, trainer.splats
    assert maps is not None
    found, seconds = [], []
    native = free_space.look_at_free_space
    try:
        for way in (native, lambda *_, **__: False):
            free_space.look_at_free_space = way
            taken = []
            for _ in range(repeat):
                begun = time.process_time()
                inside = maps.against(splats)
                taken.append(time.process_time() - begun)
            found.append(inside)
            seconds.append(min(taken))
    finally:
        free_space.look_at_free_space = native
    return len(splats), seconds, int((found[0] != found[1]).sum())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark and print a table; return 2 for a capture that cannot be read."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.free_space",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("captures", nargs="+", metavar="CAPTURE[:DOWNSCALE]")
    parser.add_argument("--repeat", type=int, default=3)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print("| capture | photographs | splats | native, s | torch, s | times | not agreed |\n" + "|---" * 7 + "|")
    try:
        for text in args.captures:
            path, _, factor = text.rpartition(":") if text.rpartition(":")[2].isdigit() else (text, "", "1")
            scene = load_scene(Path(path), downscale=int(factor))
            count, (native, reference), apart = look(scene, max(1, args.repeat))
            row = [scene.name, len(scene.train), f"{count:,}", f"{native:.3f}", f"{reference:.3f}"]
            print("| " + " | ".join(map(str, [*row, f"{reference / native:.1f}", apart])) + " |", flush=True)
    except Gs2dError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
