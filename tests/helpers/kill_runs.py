"""Run gs2d commands once per file-changing call, and kill them, or fill the disk, at that call.

This is a separate program: ``failing_files.c`` must be loaded before Python (LD_PRELOAD). Modules are imported once and
each run is a fork. For each command and action it prints a JSON object: the number of calls by name, the number tried,
and the failures. To run it by hand (docs/notebook/reliability.md)::

    cc -shared -fPIC -o /tmp/failing.so tests/helpers/failing_files.c -ldl
    LD_PRELOAD=/tmp/failing.so GS2D_FAILING_FILES=/tmp/failing.so PYTHONPATH=src:tests/helpers OMP_NUM_THREADS=1 \
        python tests/helpers/kill_runs.py --commands train,mesh --actions kill,tear,full --work /tmp/kills
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import ctypes
import errno
import gc
import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

from PIL import Image

from gs2d.io.run_dir import load_tensors
from kill_commands import COMMANDS, DATED, DONE, REFUSED, Command, ended, forked, import_all, started
from kill_states import States, gone_on_from, tree_of, watched

AT_EACH_CALL = {"kill": -1, "tear": -2, "full": errno.ENOSPC}  # tear: after half a write, or right after another call


class Layer:
    """Counts and disturbs the file operations below a folder."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(os.environ["GS2D_FAILING_FILES"])

    def arm(self, folder: Path, number: int = -1, action: int = 0, record: int = -1) -> None:
        """Start counting in this process; apply ``action`` at call ``number``."""
        self._library.failing_arm(os.fsencode(folder), ctypes.c_long(number), action, record)

    def watch(self, folder: Path, report_to: int, answer_from: int) -> None:
        """Report each call from now on and wait for a reply (``kill_states``)."""
        self._library.failing_watch(os.fsencode(folder), report_to, answer_from)

    def turn_back_the_clock(self) -> None:
        """Make the wall clock of this process run backwards."""
        self._library.failing_clock()


def half_written(folder: Path, whole: set[bytes] | None = None) -> list[str]:
    """Return incomplete files that have their final names; ``whole`` caches contents already checked as complete."""
    broken = []
    for path in folder.rglob("*"):
        if not path.is_file() or path.name.endswith(".tmp"):
            continue
        digest = sha256(path.suffix.encode() + path.read_bytes()).digest()
        if whole is not None and digest in whole:
            continue
        try:
            if path.suffix == ".json":
                json.loads(path.read_text())
            elif path.suffix == ".pt":
                load_tensors(path)
            elif path.suffix == ".png":
                Image.open(path).load()
            elif path.suffix == ".html" and "</html>" not in path.read_text()[-100:]:
                raise ValueError("it has no end")
        except Exception as error:
            broken.append(f"{path.relative_to(folder)} is not whole: {error}")
        else:
            if whole is not None:
                whole.add(digest)
    return broken


@contextlib.contextmanager
def scratch(work: Path) -> Iterator[Path]:
    """Yield a temporary folder."""
    folder = work / "try"
    shutil.rmtree(folder, ignore_errors=True)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def differing(found: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """Return the names whose contents differ."""
    names = sorted(expected.keys() | found.keys())
    return [
        f"{name} " + ("is missing" if name not in found else "is left over" if name not in expected else "differs")
        for name in names
        if name not in found or name not in expected or found[name] != expected[name]
    ]


def gone_on(command: Command, folder: Path, expected: dict[str, Any]) -> list[str]:
    """Run the command again and return the differences from the expected result."""
    if forked(lambda: command.run(folder)) != DONE:
        return ["cannot be gone on with"]
    return differing(command.leaves(folder), expected)


def disturbed_at(command: Command, layer: Layer, folder: Path, number: int, action: str) -> int:
    """Run the command in a new folder with one call disturbed; return its exit code."""
    command.prepare(folder)

    def disturbed() -> None:
        layer.arm(folder, number, AT_EACH_CALL[action])
        command.run(folder)

    return forked(disturbed)


def at_call(command: Command, layer: Layer, number: int, action: str, expected: dict[str, Any]) -> list[str]:
    """Disturb the command at one call, run it again, and return the differences from the expected result."""
    with scratch(command.work) as folder:
        code = disturbed_at(command, layer, folder, number, action)
        allowed = (-signal.SIGKILL,) if action != "full" else (REFUSED, DONE)
        wrong = [] if code in allowed else [f"ended with {code}"]
        wrong += half_written(folder)
        if action == "full" and list(folder.rglob("*.tmp")):
            wrong.append("left a temporary file on a full disk")
        return wrong + gone_on(command, folder, expected)


def at_every_call(command: Command, layer: Layer, arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Check and resume from every state that each action leaves at each call; return the result lines."""
    actions = [action for action in arguments.actions.split(",") if action in AT_EACH_CALL]
    _, expected, _ = undisturbed(command, layer)
    with scratch(command.work) as folder:
        command.prepare(folder)
        states = watched(command, layer, folder, actions)
        if wrong := differing(command.leaves(folder), expected):
            raise SystemExit(f"looking on changed what {command.name} does: {wrong}")
        whole: set[bytes] = set()
        gone_on_from(
            states, folder, lambda at: half_written(at, whole) + gone_on(command, at, expected), arguments.seconds
        )
        if arguments.compare:
            check_states(command, layer, folder, states, arguments)
    for action in actions:
        mine = [state for state in states.found.values() if action in state.left_by]
        wrong = states.ended_wrong if action == "full" else []
        wrong = wrong + [
            f"{number}: {text} ({states.calls[number]})"
            for state in mine
            for text in state.wrong
            for number in state.left_by[action]
        ]
        kinds = dict(collections.Counter(line.partition(" ")[0] for line in states.calls))
        tried = sum(len(state.left_by[action]) for state in mine if state.judged)
        named = {"command": command.name, "action": action, "calls": len(states.calls), "kinds": kinds}
        yield {**named, "tried": tried, "states": len(mine), "states of all": len(states.found), "wrong": wrong}


def check_states(command: Command, layer: Layer, folder: Path, states: States, arguments: argparse.Namespace) -> None:
    """Disturb the command for real and check that it leaves the recorded state, except for times."""
    for state in states.found.values():
        for action, numbers in state.left_by.items():
            for number in numbers:
                if number % arguments.every != arguments.first:
                    continue
                shutil.rmtree(folder, ignore_errors=True)
                disturbed_at(command, layer, folder, number, action)
                wrong = differing(*({name: steady(name, data) for name, data in tree.items()}
                                    for tree in (tree_of(folder), state.tree)))  # fmt: skip
                if wrong:
                    raise SystemExit(f"{action} at {number} ({states.calls[number]}) leaves something else: {wrong}")


def steady(name: str, data: bytes | None) -> bytes | bool:
    """Return the contents of a file that must be reproducible; a temporary file counts only as present or absent."""
    whole = Path(name).name.removeprefix(".").removesuffix(".gs2d.tmp")
    dated = whole in DATED or f".{whole}" in DATED or whole.endswith((".pt", "table.json"))
    return data is not None if data is None or dated or "/jobs/" in name else data


def at_random(
    command: Command, chance: random.Random, seconds: float, expected: dict[str, Any]
) -> tuple[list[str], int]:
    """Kill the command at random times, three times in a row; return the failures and the number of effective kills."""
    with scratch(command.work) as folder:
        command.prepare(folder)
        codes = []
        for _ in range(3):
            child = started(lambda: command.run(folder))
            time.sleep(chance.uniform(0, seconds))
            os.kill(child, signal.SIGKILL)
            codes.append(ended(child))
        kills = codes.count(-signal.SIGKILL)  # the other runs had already finished
        return half_written(folder) + gone_on(command, folder, expected), kills


def stopped_and_continued(command: Command, chance: random.Random, expected: dict[str, Any]) -> list[str]:
    """Repeatedly stop and continue the command (SIGSTOP, SIGCONT)."""
    with scratch(command.work) as folder:
        command.prepare(folder)
        child = started(lambda: command.run(folder))
        while (status := os.waitpid(child, os.WNOHANG)) == (0, 0):
            for number in (signal.SIGSTOP, signal.SIGCONT):
                os.kill(child, number)
                time.sleep(chance.uniform(0, 0.05))
        wrong = [] if os.waitstatus_to_exitcode(status[1]) == DONE else ["does not end well"]
        return wrong or differing(command.leaves(folder), expected)


def with_the_clock_going_back(command: Command, layer: Layer, expected: dict[str, Any]) -> list[str]:
    """Run the command while the wall clock runs backwards."""
    with scratch(command.work) as folder:
        command.prepare(folder)

        def disturbed() -> None:
            layer.turn_back_the_clock()
            command.run(folder)

        wrong = [] if forked(disturbed) == DONE else ["does not end well"]
        return wrong or differing(command.leaves(folder), expected)


def twice_at_once(command: Command, chance: random.Random, expected: dict[str, Any]) -> list[str]:
    """Run the command twice in one folder, slightly offset: at least one must succeed, and the other may be refused."""
    with scratch(command.work) as folder:
        command.prepare(folder)
        first = started(lambda: command.run(folder))
        time.sleep(chance.uniform(0, 0.3))
        second = started(lambda: command.run(folder))
        codes = sorted((ended(first), ended(second)))
        wrong = [] if codes in ([DONE, DONE], [DONE, REFUSED]) else [f"ended with {codes}"]
        return wrong or differing(command.leaves(folder), expected)


def with_another_photograph(command: Command, layer: Layer, calls: int, expected: dict[str, Any]) -> list[str]:
    """Kill the training half-way and change an image: resuming is refused until the image is restored."""
    photograph = command.capture / "train" / "r_0.png"
    before = photograph.read_bytes()
    with scratch(command.work) as folder:
        command.prepare(folder)

        def killed() -> None:
            layer.arm(folder, calls // 2, AT_EACH_CALL["kill"])
            command.run(folder)

        forked(killed)
        try:
            shutil.copyfile(command.capture / "train" / "r_1.png", photograph)
            code = forked(lambda: command.run(folder))
        finally:
            photograph.write_bytes(before)
        wrong = [] if code == REFUSED else [f"another photograph: ended with {code}"]
        return wrong + gone_on(command, folder, expected)


def undisturbed(command: Command, layer: Layer) -> tuple[list[str], dict[str, Any], float]:
    """Return the command's calls (one per line), its result, and its duration in seconds."""
    with scratch(command.work) as folder:
        command.prepare(folder)
        record, imported = command.work / "calls.txt", command.work / "imported.txt"
        descriptor = os.open(record, os.O_CREAT | os.O_TRUNC | os.O_WRONLY, 0o600)

        def counted() -> None:
            layer.arm(folder, record=descriptor)
            command.run(folder)
            imported.write_text("\n".join(sys.modules))

        began = time.monotonic()
        if forked(counted) != DONE:
            raise SystemExit("the undisturbed command failed")
        seconds = time.monotonic() - began
        os.close(descriptor)
        import_all(imported.read_text().split())
        gc.freeze()  # children do not scan objects that are already loaded
        return record.read_text().splitlines(), command.leaves(folder), seconds


def tries(command: Command, layer: Layer, action: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Try one action on one command; return the result line."""
    calls, expected, seconds = undisturbed(command, layer)
    if action == "random":
        seconds = undisturbed(command, layer)[2]  # all modules are imported by this point
    wrong: list[str] = []
    tried, kills, began, chance = 0, 0, time.monotonic(), random.Random(arguments.seed)
    numbers = range(arguments.first, len(calls), arguments.every) if action in AT_EACH_CALL else range(arguments.times)
    for number in numbers:
        if time.monotonic() - began > arguments.seconds:
            break
        if action in AT_EACH_CALL:
            found = [f"{text} ({calls[number]})" for text in at_call(command, layer, number, action, expected)]
        elif action == "random":
            found, felt = at_random(command, chance, seconds, expected)
            kills += felt
        elif action == "stop":
            found = stopped_and_continued(command, chance, expected)
        elif action == "clock":
            found = with_the_clock_going_back(command, layer, expected)
        elif action == "twice":
            found = twice_at_once(command, chance, expected)
        else:
            found = with_another_photograph(command, layer, len(calls), expected)
        wrong += [f"{number}: {text}" for text in found]
        tried += 1
    kinds = dict(collections.Counter(line.partition(" ")[0] for line in calls))
    named = {"command": command.name, "action": action, "calls": len(calls), "kinds": kinds}
    return {**named, "tried": tried, **({"kills": kills} if action == "random" else {}), "wrong": wrong}


def main() -> None:
    """Disturb commands as selected by the options."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--commands", default=",".join(COMMANDS))
    parser.add_argument("--actions", default=",".join(AT_EACH_CALL), help="and random, stop, clock, twice, photograph")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--times", type=int, default=1, help="of the actions that are not at a call")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="for each command and action")
    parser.add_argument("--states", action="store_true", help="at each call, from one run: see kill_states.py")
    parser.add_argument("--compare", action="store_true", help="such states with those that real kills leave")
    arguments = parser.parse_args()
    layer, work = Layer(), arguments.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    for name in arguments.commands.split(","):
        if arguments.states:
            for line in at_every_call(COMMANDS[name](work), layer, arguments):
                print(json.dumps(line), flush=True)
            continue
        for action in arguments.actions.split(","):
            print(json.dumps(tries(COMMANDS[name](work), layer, action, arguments)), flush=True)


if __name__ == "__main__":
    main()
