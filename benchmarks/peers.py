"""Time the CPU rasterizer and other CPU rasterizers, forward and backward, alternately in one process.

::

    python -m benchmarks.peers [--opensplat LIBRARY] [--gsplat CHECKOUT] [--only 20k-400] [--threads 2] [--repeats 9]
                               [--out benchmarks/results/peers.json]

Requirements, built or checked out by the user outside this repository:

- ``--opensplat LIBRARY``: a shared library that registers, for this torch, OpenSplat's public CPU functions as torch
  operators ``opensplat_cpu::project``, ``forward``, ``backward`` and ``pairs``. The first three are
  ``project_gaussians_forward_tensor_cpu`` (with ``glob_scale`` 1 and ``clip_thresh`` 0.01),
  ``rasterize_forward_tensor_cpu`` and ``rasterize_backward_tensor_cpu`` with their own argument order; the address of
  the splat lists is passed as an integer. ``backward`` frees the lists; ``pairs(lists, pixels)`` returns the sum of
  their lengths. Compile with the flags of OpenSplat's Release build (``-O3 -DNDEBUG``).
- ``--gsplat CHECKOUT``: a checkout of gsplat. Only its torch reference of 2DGS is imported. Two of our functions
  replace those of nerfacc, which require CUDA.

The scene is the room of ``benchmarks/workload.py``. OpenSplat renders the same splats as 3D Gaussians with a thousandth
of their size as thickness. For OpenSplat, rasterization of colour alone is timed, forward and backward, on its single
thread; projection and SH are precomputed. For ours, everything is timed: projection, SH, sorting, all six outputs and
gradients of all parameters. After each switch between rasterizers one pass is not timed. ``ratio`` is the other
rasterizer's time over ours, of medians and of best times.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line

import torch

from benchmarks.peer_adapters import PEERS, difference
from benchmarks.stages import Passes, count_work
from benchmarks.timing import Timing, machine, peak_probe, summary
from benchmarks.workload import name_of, room_workload
from gs2d.kernels.library import Library, load

WORKLOADS = {"opensplat": ((20_000, 400), (100_000, 800)), "gsplat": ((20_000, 400),)}  # gsplat: 10 GB at 100k, 800
OURS_PER_PEER = 3  # the other rasterizers take about twenty times as long


def compare_with(
    peer_name: str, path: Path, library: Library, count: int, size: int, threads: int, repeats: int
) -> dict[str, Any]:
    """Return medians and best times of another rasterizer and of ours, run alternately."""
    workload = room_workload(count, size, size)
    peer = PEERS[peer_name](path, workload.splats, workload.cameras[0])
    ours = Passes(library, workload, 3)
    output, rendered = ours.forward(), peer.forward()
    work = count_work(library, output, count)
    facts = {
        "pairs_per_pixel": {"peer": peer.pairs(rendered) / size**2, "ours": work.pairs / size**2},
        "mean_color_difference": difference(peer.color(rendered), output.color),
    }
    ours.backward(output)
    peer.backward(rendered)
    times: dict[str, dict[str, list[float]]] = {who: {"forward": [], "backward": []} for who in ("peer", "ours")}
    rate = peak_probe(library)
    for _ in range(repeats):
        for who, passes, turns in (("peer", peer, 1), ("ours", ours, OURS_PER_PEER)):
            passes.backward(passes.forward())  # not timed: the caches hold the other rasterizer's data
            for _ in range(turns):
                start = time.perf_counter()
                result: Any = passes.forward()
                middle = time.perf_counter()
                passes.backward(result)
                times[who]["forward"].append(1e3 * (middle - start))
                times[who]["backward"].append(1e3 * (time.perf_counter() - middle))
    total = {who: summary([f + b for f, b in zip(*rows.values(), strict=True)]) for who, rows in times.items()}
    return {
        "peer": peer_name,
        "workload": name_of(count, size, size),
        "threads": threads,
        **{f"{who}_ms": rounded(timing) for who, timing in total.items()},
        **{f"{who}_best_ms_by_pass": {k: round(min(v), 2) for k, v in times[who].items()} for who in times},
        "ratio": {
            "median": round(total["peer"].median / total["ours"].median, 2),
            "best": round(total["peer"].best / total["ours"].best, 2),
        },
        **facts,
        "fma_gflops": round(max(rate, peak_probe(library)), 1),
    }


def rounded(timing: Timing) -> dict[str, float]:
    """Round to two decimals."""
    return {name: round(value, 2) for name, value in asdict(timing).items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print a line each and write the file; return 2 if another rasterizer does not meet the requirements."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--opensplat", type=Path)
    parser.add_argument("--gsplat", type=Path)
    parser.add_argument("--only", nargs="+", help="run only workloads whose name contains one of these words")
    parser.add_argument(
        "--threads", type=int, nargs="+", default=[2, 1], help="threads of our rasterizer; the others use one"
    )
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/peers.json"))
    args = parser.parse_args(arguments)
    paths = {name: getattr(args, name) for name in PEERS if getattr(args, name) is not None}
    if not paths:
        parser.error("give --opensplat LIBRARY, --gsplat CHECKOUT or both")
    before, library, rows = torch.get_num_threads(), load(), []
    document = {
        "format": 1,
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine() | {"variant": library.variant},
        "rows": rows,
    }
    try:
        for peer, path in paths.items():
            for count, size in WORKLOADS[peer]:
                if args.only and not any(part in name_of(count, size, size) for part in args.only):
                    continue
                for threads in args.threads:
                    torch.set_num_threads(1)  # for their torch code: OpenSplat's loops are single-threaded
                    library.use_threads(threads)
                    rows.append(compare_with(peer, path, library, count, size, threads, args.repeats))
                    print(json.dumps(rows[-1]), flush=True)
                    args.out.parent.mkdir(parents=True, exist_ok=True)
                    args.out.write_text(json.dumps(document, indent=1) + "\n")
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    finally:
        torch.set_num_threads(before)
    return 0


if __name__ == "__main__":
    sys.exit(main())
