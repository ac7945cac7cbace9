"""Count the work of the GPU's warps on the tile lists of a trained capture, with whole lists and with pieces.

::

    python -m benchmarks.tile_lists SPLATS.ply CAPTURE[:DOWNSCALE] [--views 4]

Needs no GPU: the kernels are emulated. A *visit* is a splat that a warp evaluates at its 8x8 pixels. A warp works in
sequence, so the visits of the busiest warp bound the time of a kernel if the GPU has few warps. Reports them for the
forward pass (first the transmittance of pieces, then the blending) and the backward pass, and the total visits of all
warps, which bound the time if the GPU is full. All figures are means over training views.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch

from benchmarks.gpu.bench import opened
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.data import load_scene
from gs2d.errors import Gs2dError
from gs2d.io.formats.splat_formats import read_splats
from gs2d.kernels.cuda.launch import Launcher
from gs2d.render import cuda_passes, cuda_works
from gs2d.render.types import RasterSettings

CHUNK, WARPS = 32, 4
HALVES = np.array([[(w >> 1) * 4 + h * 2 + (w & 1) for h in range(2)] for w in range(WARPS)])  # sub-blocks of a warp


def frame_of(launcher: Launcher, splats: Splats, camera: Camera, shortest: int, most: int) -> cuda_passes.ForwardState:
    """Render a view with pieces of at least ``shortest`` entries and at most ``most`` pieces."""
    parameters = {name: tensor.detach().contiguous() for name, tensor in splats.items()}
    view = cuda_passes.view_of(camera, RasterSettings())
    with patch.multiple(cuda_works, SHORTEST_PIECE=shortest, MOST_PIECES=most):
        return cuda_passes.forward(launcher, view, parameters, distortion=False)


def parts_of(memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return states and table of the pieces."""
    states = len(memory) // (cuda_works.PIECE_STATE + cuda_works.PIECE_ROW) * cuda_works.PIECE_STATE
    return memory[:states], memory[states:].view(torch.int32)


def rows_of(frame: cuda_passes.ForwardState) -> dict[int, list[int]]:
    """Return the pieces of each tile that has more than one."""
    found: dict[int, list[int]] = {}
    rows = parts_of(frame.pieces)[1][:-1].view(-1, cuda_works.PIECE_ROW)
    for row, tile in enumerate(rows[:, 0].tolist()):
        if tile >= 0:
            found.setdefault(tile, []).append(row)
    return found


def visits_of(fine: cuda_passes.ForwardState, tile: int, rows: list[int]) -> np.ndarray:
    """Return the visits [3, chunks, warps] of a tile: of a whole list, of its gradients, and with all pixels live.

    ``fine`` has pieces of about one chunk, whose transmittances tell which pixels are live at the start of each.
    """
    begin, end = fine.ranges[tile].tolist()
    chunks = -(-(end - begin) // CHUNK)
    states = parts_of(fine.pieces)[0].view(-1, cuda_works.PIECE_STATE // 256, 2, WARPS, 32)[:, 0]
    live = np.ones((chunks, WARPS, 2), dtype=bool)
    T = torch.ones(2, WARPS, 32)
    for number, row in enumerate(rows):
        T = T * states[row] if number else T
        first, after = (chunks * n // len(rows) for n in (number, number + 1))
        live[first:after] = T.ge(fine.view.transmittance_min).any(2).T.numpy()
    masks = np.zeros(chunks * CHUNK, dtype=np.uint8)
    masks[: end - begin] = fine.entries[begin:end].numpy() & 255
    touched = (masks[:, None, None] >> HALVES & 1).reshape(chunks, CHUNK, WARPS, 2).astype(bool)
    words = fine.seen[(begin >> 5) + tile :][:chunks].numpy().view(np.uint32)[:, HALVES]
    seen = words[:, None] >> np.arange(CHUNK, dtype=np.uint32)[:, None, None] & 1
    counted = [touched & live[:, None], seen.astype(bool), touched]
    return np.stack([one.any(3).sum(1) for one in counted])


def count(launcher: Launcher, splats: Splats, camera: Camera) -> dict[str, float]:
    """Return the figures of one view."""
    fine = frame_of(launcher, splats, camera, CHUNK, 1 << 20)
    cut = rows_of(frame_of(launcher, splats, camera, cuda_works.SHORTEST_PIECE, cuda_works.MOST_PIECES))
    rows, lengths = rows_of(fine), (fine.ranges[:-1, 1] - fine.ranges[:-1, 0]).tolist()
    found: dict[str, list[np.ndarray]] = {}
    for tile in np.flatnonzero(lengths).tolist():
        visits = visits_of(fine, tile, rows.get(tile, [0]))
        pieces = len(cut.get(tile, [0]))
        ends = [visits.shape[1] * n // pieces for n in range(pieces + 1)]
        parts = [visits[:, a:b].sum(1) for a, b in pairwise(ends)]
        found.setdefault("whole", []).append(visits.sum(1)[:2])
        found.setdefault("pieces", []).extend(part[:2] for part in parts)
        found.setdefault("transmittance", []).extend(part[2:] for part in parts[:-1])
    figures: dict[str, float] = {"list": max(lengths), "tiles cut": len(cut)}
    for way, arrays in found.items():
        for kind, values in zip(("forward", "backward"), np.stack(arrays, 1), strict=False):
            figures |= {f"{way} {kind}": int(values.max()), f"{way} {kind} total": int(values.sum())}
    return figures


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return 2 for input that cannot be read."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.tile_lists",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("splats", type=Path)
    parser.add_argument("capture", metavar="CAPTURE[:DOWNSCALE]")
    parser.add_argument("--views", type=int, default=4)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    path, _, factor = args.capture.rpartition(":") if args.capture[-1:].isdigit() else (args.capture, "", "1")
    try:
        views = load_scene(Path(path or factor), downscale=int(factor) if path else 1).train
        splats = read_splats(args.splats)
        with opened(True) as bench, torch.no_grad():
            chosen = views[:: max(1, len(views) // args.views)][: args.views]
            counted = [count(bench.launcher, splats, view.camera) for view in chosen]
    except Gs2dError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    names = dict.fromkeys(name for figures in counted for name in figures)
    mean = {name: float(np.mean([figures.get(name, 0) for figures in counted])) for name in names}
    print(f"{len(splats):,} splats; longest list {mean['list']:,.0f}; tiles cut {mean['tiles cut']:.0f}")
    print("| pass | lists | visits of the busiest warp | of all warps |\n|---|---|---|---|")
    for kind in ("forward", "backward"):
        for way in ("whole", "transmittance", "pieces"):
            if f"{way} {kind}" in mean:
                print(f"| {kind} | {way} | {mean[f'{way} {kind}']:,.0f} | {mean[f'{way} {kind} total']:,.0f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
