"""What ``gs2d plan`` tells of captures, beside what their trainings then take.

::

    python -m benchmarks.plan_check FOLDER CAPTURE[:DOWNSCALE[:SCHEDULE]] ... [--recipe best] [--threads 1]

Each capture is planned and trained by commands of their own, one after the other, mesh and report included; CAPTURE may
be ``flown-N-SIDE``, N photographs over SIDE m of land, which is made. Memory is the largest resident sum of the
training's processes (``benchmarks.scale``). Seconds are by the clock, and the machine's other work is in both. The
table goes to standard output, figures to ``FOLDER/plan.json``; what is there already is not done again.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.scale import measure
from gs2d.errors import Gs2dError
from gs2d.synthetic.flight import Flight, write_flight

FLOWN = re.compile(r"flown-(\d+)-(\d+)")


def capture_of(name: str, folder: Path) -> Path:
    """Return the folder of a capture; a flown one is made where it is not there."""
    match = FLOWN.fullmatch(name)
    if match is None:
        return Path(name)
    path = folder / name
    if not (path / "sparse/0/cameras.bin").exists():
        write_flight(path, Flight(int(match[1]), width=96, height=72, side=float(match[2])))
    return path


def check(capture: Path, downscale: int, scale: float, args: argparse.Namespace) -> dict[str, Any]:
    """Plan and train one.

    Raises
    ------
    RuntimeError
        A command failed.
    """
    label = f"{capture.name}-{downscale}-{scale:g}"
    words = [str(capture), "--downscale", str(downscale), "--schedule-scale", str(scale), "--recipe", args.recipe]
    words += ["--threads", str(args.threads)]
    planned = subprocess.run([sys.executable, "-m", "gs2d", "plan", *words, "--json", "--quiet"], capture_output=True)
    if planned.returncode:
        raise RuntimeError(planned.stderr.decode())
    told, run = json.loads(planned.stdout), args.folder / f"run-{label}"
    trained = measure(
        told["photographs"],
        "train",
        ["train", *words, "--out", str(run), "--overwrite", "--quiet"],
        args.folder / f"log-{label}.txt",
    )
    stage = json.loads((run / "metrics.json").read_text())["stages"][-1]
    events = (json.loads(line) for line in (run / "events.jsonl").read_text().splitlines())
    begun = next(event["splats"] for event in events if event.get("kind") == "initialised")
    return {
        "capture": label,
        "photographs": told["photographs"],
        "start": [told["start"], begun],
        "splats": [told["splats"], stage["splats"]],
        "mib": [{name: value / 2**20 for name, value in told["memory"].items()}, trained.mib],
        "seconds": [told["seconds"], trained.seconds],
    }


def table(found: list[dict[str, Any]]) -> str:
    """Return the figures in Markdown, and how many runs are within the bounds that are wanted."""
    lines = ["| capture | photographs | splats: plan, run | memory: plan, run | seconds: plan, run |", "|---" * 5 + "|"]
    near = {"mib": 0, "seconds": 0}
    for one in found:
        (splats, made), (mib, took), (seconds, lasted) = one["splats"], one["mib"], one["seconds"]
        near["mib"] += abs(mib["expected"] / took - 1) <= 0.2
        near["seconds"] += 1 / 1.5 <= seconds["expected"] / lasted <= 1.5
        lines.append(
            f"| {one['capture']} | {one['photographs']:,} "
            f"| {splats['expected']:,.0f} ({splats['least']:,.0f} to {splats['most']:,.0f}), {made:,} "
            f"| {mib['expected']:.0f} ({mib['least']:.0f} to {mib['most']:.0f}) MiB, {took:.0f} "
            f"| {seconds['expected']:.0f} ({seconds['least']:.0f} to {seconds['most']:.0f}), {lasted:.0f} |"
        )
    lines += ["", f"Memory within 20 %: {near['mib']} of {len(found)}; time within 1.5: {near['seconds']}."]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Check all; 2 for what the user can mend, 1 where a command fails."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plan_check", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("captures", nargs="+", metavar="CAPTURE[:DOWNSCALE[:SCHEDULE]]")
    parser.add_argument("--recipe", default="best")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(arguments)
    kept = args.folder / "plan.json"
    try:
        args.folder.mkdir(parents=True, exist_ok=True)
        found = json.loads(kept.read_text()) if kept.exists() else []
        for word in args.captures:
            name, *rest = word.split(":")
            downscale, scale = (*rest, *("1", "0.02")[len(rest) :])
            capture = capture_of(name, args.folder)
            label = f"{capture.name}-{downscale}-{float(scale):g}"
            if all(one["capture"] != label for one in found):
                found.append(check(capture, int(downscale), float(scale), args))
                kept.write_text(json.dumps(found, indent=1) + "\n")
            print(table(found), flush=True)
    except (Gs2dError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
