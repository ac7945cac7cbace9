"""Throw mutated inputs at the readers: ``python tests/fuzz/drive.py [FAMILY ...] --count 10000`` or ``--seconds 3600``.

Each family runs in a process of its own, so that a crash by a signal is a finding as well. A row of the table is a
family; findings are printed once a place, with the number of the input, and ``--keep FOLDER`` writes the changed file
of each. The same number is always the same input.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from tempfile import TemporaryDirectory

HERE = Path(__file__).resolve().parent
for folder in (HERE, HERE.parent / "helpers", HERE.parent.parent):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

from families import FAMILIES, Family  # noqa: E402
from guard import outcome  # noqa: E402

from gs2d.errors import Gs2dError  # noqa: E402

STALLED = 120  # s without a finished input: the process is ended, and the input a hang


def write_files(folder: Path, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def try_case(family: Family, files: dict[str, bytes], home: Path) -> tuple[str | None, str, int]:
    """One input in a folder of its own, which is gone afterwards."""
    folder = home / "case"
    folder.mkdir()
    write_files(folder, files)
    size = sum(map(len, files.values()))
    tempfile.tempdir = str(folder)  # what is written there is inside
    try:
        return outcome(family.read, folder, size)
    finally:
        tempfile.tempdir = None
        shutil.rmtree(folder, ignore_errors=True)


def read_good(family: Family, home: Path) -> None:
    """Read what nobody has changed, not under guard: what is imported late is loaded then, which may take 20 s."""
    for number, files in enumerate(family.seeds_made()):
        write_files(home / f"good{number}", files)
        with contextlib.suppress(Gs2dError):
            family.read(home / f"good{number}")
        shutil.rmtree(home / f"good{number}")


def place(finding: str) -> str:
    """What findings have in common that are one: without numbers and names."""
    return re.sub(r"[0-9.]+|'[^']*'|/\S+", "#", finding)[:90]


def work(name: str, first: int, count: int, seconds: float) -> None:
    """Run inputs one after the other; a line of JSON each on stdout."""
    import torch

    torch.set_num_threads(1)
    family, end = FAMILIES[name], time.monotonic() + seconds
    with TemporaryDirectory(prefix="gs2d-fuzz-") as home:
        read_good(family, Path(home))
        for seed in itertools.count(first):
            if seed >= first + count or time.monotonic() > end:
                return
            print(json.dumps([seed]), flush=True)
            files, victim = family.case(seed)
            print(json.dumps([seed, *try_case(family, files, Path(home)), victim]), flush=True)


def run(name: str, first: int, count: int, seconds: float, keep: Path | None) -> tuple[dict[str, object], list[str]]:
    """Run a family in processes of its own until all is done; return its row and its findings, one a place."""
    start, done, read, peak, total = time.monotonic(), 0, 0, 0, 0
    found: dict[str, str] = {}
    seed = first
    while done < count and time.monotonic() - start < seconds:
        rest = [str(seed), str(count - done), str(seconds - (time.monotonic() - start))]
        words = [sys.executable, __file__, "--work", name, *rest]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            begun = None
            try:
                for line in process.stdout:
                    entry = json.loads(line)
                    if len(entry) == 1:
                        begun = entry[0]
                        continue
                    seed, finding, verdict, memory, victim = entry
                    seed, begun, done = seed + 1, None, done + 1
                    read, peak = read + (verdict == "read"), max(peak, memory)
                    if finding:
                        total += 1
                        if place(finding) not in found:
                            found[place(finding)] = f"{name} {entry[0]} ({victim}): {finding}"
                            _keep(keep, name, entry[0])
            except KeyboardInterrupt:  # the row says how far it came; --first goes on from there
                process.terminate()
                break
        if begun is None and process.returncode != 0:
            raise SystemExit(f"{name}: the driver itself failed with status {process.returncode}")
        if begun is not None:
            total, done, seed = total + 1, done + 1, begun + 1
            found[f"signal {process.returncode}"] = f"{name} {begun}: ended by signal {-process.returncode}"
            _keep(keep, name, begun)
        elif done < count and process.returncode == 0 and time.monotonic() - start < seconds:
            break
    row = {"family": name, "inputs": done, "read": read, "refused": done - read, "findings": total}
    return {**row, "places": len(found), "peak MB": peak >> 20, "s": round(time.monotonic() - start)}, list(
        found.values()
    )


def _keep(folder: Path | None, name: str, seed: int) -> None:
    if folder is not None:
        files, victim = FAMILIES[name].case(seed)
        target = folder / name / f"{seed}--{victim.replace('/', '__')}"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(files[victim])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("families", nargs="*", help=f"of {', '.join(FAMILIES)}; all without any")
    parser.add_argument("--count", type=int, default=sys.maxsize, help="inputs a family")
    parser.add_argument("--seconds", type=float, default=float(10**9), help="time a family")
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--keep", type=Path, help="a folder for the changed files of findings")
    parser.add_argument("--work", nargs=4, metavar=("FAMILY", "FIRST", "COUNT", "SECONDS"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        name, first, count, seconds = options.work
        work(name, int(first), int(count), float(seconds))
        return 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: ends the family with the row so far
    findings: list[str] = []
    for index, name in enumerate(options.families or FAMILIES):
        row, found = run(name, options.first, options.count, options.seconds, options.keep)
        if index == 0:
            print("| " + " | ".join(row) + " |\n|" + "---|" * len(row))
        print("| " + " | ".join(map(str, row.values())) + " |", flush=True)
        for line in found:
            print("    " + line, flush=True)
        findings += found
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
