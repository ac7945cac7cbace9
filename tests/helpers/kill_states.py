"""Record every state that a command may leave when it ends at a file-changing call, and resume from each.

The command runs once. It pauses before each call, and after half of each write, while its folder is recorded. SIGKILL
would leave exactly this state, because written data stays and locks are released. Before each call that needs disk
space, a forked copy of the process continues with a full disk until it ends; then the folder is restored and the
original continues. Many states are equal (fsync changes nothing; a process with a full disk removes its partial
output). Each distinct state is resumed once, and the result applies to all calls that leave it.

A fork contains only the calling thread, so forks of multi-threaded commands (``reconstruct`` uses libraries with
threads) may hang. Such commands are run with a full disk from the start, once per call.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from kill_commands import DONE, REFUSED, Command, ended, started

Tree = dict[str, bytes | None]  # by path below the folder: file contents; None for a folder


def tree_of(folder: Path) -> Tree:
    """Return all contents of a folder, sorted by name."""
    found: Tree = {}
    for path in sorted(folder.rglob("*")):
        found[str(path.relative_to(folder))] = None if path.is_dir() else path.read_bytes()
    return found


def lay(tree: Tree, folder: Path) -> None:
    """Make a folder contain exactly this tree."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, data in tree.items():
        path = folder / name
        if data is None:
            path.mkdir(exist_ok=True)
        else:
            path.write_bytes(data)


@dataclass
class State:
    """Contents of a folder, and the calls that leave it, by action: ``{"kill": [3, 4], "tear": [3]}``."""

    tree: Tree
    left_by: dict[str, list[int]] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    judged: bool = False


@dataclass
class States:
    """The states of one run of a command."""

    calls: list[str] = field(default_factory=list)  # "write /run/x"
    found: dict[bytes, State] = field(default_factory=dict)
    ended_wrong: list[str] = field(default_factory=list)  # copies with a full disk that failed

    def note(self, tree: Tree, action: str, number: int) -> State:
        """Add the state that an action leaves at a call."""
        digest = sha256()
        for name, data in tree.items():
            digest.update(repr((name, data is None, len(data or b""))).encode() + (data or b""))
        state = self.found.setdefault(digest.digest(), State(tree))
        state.left_by.setdefault(action, []).append(number)
        return state


class _Kept:
    """Snapshot of a folder, restored after another process changed it; inodes are kept because some files are open."""

    def __init__(self, folder: Path, tree: Tree) -> None:
        self.folder, self.tree, self.links = folder, tree, folder.with_name(folder.name + "-kept")
        self.links.mkdir()
        self.names = {name: self.links / str(i) for i, (name, data) in enumerate(tree.items()) if data is not None}
        for name, link in self.names.items():
            os.link(folder / name, link)

    def restore(self, now: Tree) -> None:
        for name in sorted(now.keys() - self.tree.keys(), reverse=True):
            path = self.folder / name
            path.rmdir() if path.is_dir() else path.unlink()
        for name, data in self.tree.items():
            path = self.folder / name
            if data is None:
                path.mkdir(exist_ok=True)
                continue
            link = self.names[name]
            if not (path.exists() and path.samefile(link)):
                path.unlink(missing_ok=True)
                os.link(link, path)
            if now.get(name) != data:
                with open(path, "r+b") as file:
                    file.write(data)
                    file.truncate()
        shutil.rmtree(self.links)


class Look:
    """One observed run of a command: reads the layer's messages and records states."""

    def __init__(self, folder: Path, actions: list[str]) -> None:
        self.folder, self.actions, self.states = folder, actions, States()
        self.torn = True  # whether the last call has its "tear" state
        self.kept: _Kept | None = None

    def hear(self, line: str) -> bytes:
        """Record the folder; return the reply: "c" to continue, "f" to fork a copy with a full disk."""
        kind, _, rest = line.partition(" ")
        tree, calls = tree_of(self.folder), self.states.calls
        if kind == "B":
            self.after(tree)
            calls.append(rest)
            if "kill" in self.actions:
                self.states.note(tree, "kill", len(calls) - 1)
            self.torn = "tear" not in self.actions
            if "full" not in self.actions:
                return b"c"
            self.kept = _Kept(self.folder, tree)
            return b"f"
        if kind == "H":
            self.after(tree)
            return b"c"
        assert self.kept is not None
        self.on_full_disk(tree, int(rest))
        self.kept.restore(tree)
        return b"c"

    def after(self, tree: Tree) -> None:
        """Record the state after half of the last call if it was a write, or after the call: its "tear" state."""
        if not self.torn:
            self.states.note(tree, "tear", len(self.states.calls) - 1)
        self.torn = True

    def on_full_disk(self, tree: Tree, code: int) -> None:
        """Record the result of a copy with a full disk."""
        number = len(self.states.calls) - 1
        state = self.states.note(tree, "full", number)
        if code not in (REFUSED, DONE):
            self.states.ended_wrong.append(f"{number}: ended with {code} ({self.states.calls[number]})")
        if any(name.endswith(".tmp") for name in tree):
            state.wrong.append("left a temporary file on a full disk")


def watched(command: Command, layer: Any, folder: Path, actions: list[str]) -> States:
    """Run the command once, undisturbed in the end, and return the states that the actions leave at each call.

    Parameters
    ----------
    layer
        The layer of ``kill_runs``.
    folder
        The command's working folder; afterwards it contains the command's result.
    actions
        A subset of kill, tear and full.
    """
    reports, answers = os.pipe(), os.pipe()

    def looked_at() -> None:
        os.close(reports[0]), os.close(answers[1])
        layer.watch(folder, reports[1], answers[0])
        command.run(folder)

    child = started(looked_at)
    os.close(reports[1]), os.close(answers[0])
    look = Look(folder, actions)
    while line := os.read(reports[0], 1 << 16):  # the process waits after each line, so one line arrives at a time
        os.write(answers[1], look.hear(line.decode(errors="surrogateescape").rstrip("\n")))
    os.close(reports[0]), os.close(answers[1])
    if (code := ended(child)) != DONE:
        raise SystemExit(f"the command that was looked at ended with {code}")
    look.after(tree_of(folder))
    return look.states


def gone_on_from(states: States, folder: Path, judge: Callable[[Path], list[str]], seconds: float) -> int:
    """Restore each state and collect the failures that ``judge`` returns; return the number of checked states."""
    began, done = time.monotonic(), 0
    for state in states.found.values():
        if time.monotonic() - began > seconds:
            break
        lay(state.tree, folder)
        state.wrong += judge(folder)
        state.judged = True
        done += 1
    return done
