"""What a command leaves when it ends at any of its calls that change files: every such state, and each gone on from.

The command runs once. It stands still before each call, and after half of each write, while its folder is looked at:
that is what SIGKILL leaves there, for what a killed process wrote stays, and its locks go with it. Before each call
that needs room a copy of the process (fork) goes on alone, with a full disk, until it ends; then the folder is as
before and the first goes on. Many states are the same (fsync changes none, and who finds the disk full removes what it
began): each is gone on from once, and judged for all calls that leave it.

A copy has the thread alone that made the call: of a command that has others (``reconstruct``: those of its libraries)
it may wait for ever. Such a one is run with a full disk from the start, call by call.
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

Tree = dict[str, bytes | None]  # by name below the folder: what a file holds; None of a folder


def tree_of(folder: Path) -> Tree:
    """Return all that is in a folder, in the order of names."""
    found: Tree = {}
    for path in sorted(folder.rglob("*")):
        found[str(path.relative_to(folder))] = None if path.is_dir() else path.read_bytes()
    return found


def lay(tree: Tree, folder: Path) -> None:
    """Make a folder hold this and nothing else."""
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
    """What a folder held, and of which actions at which calls: ``{"kill": [3, 4], "tear": [3]}``."""

    tree: Tree
    left_by: dict[str, list[int]] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    judged: bool = False


@dataclass
class States:
    """The states of one run of a command."""

    calls: list[str] = field(default_factory=list)  # "write /run/x"
    found: dict[bytes, State] = field(default_factory=dict)
    ended_wrong: list[str] = field(default_factory=list)  # of copies with a full disk

    def note(self, tree: Tree, action: str, number: int) -> State:
        """Add what an action at a call leaves."""
        digest = sha256()
        for name, data in tree.items():
            digest.update(repr((name, data is None, len(data or b""))).encode() + (data or b""))
        state = self.found.setdefault(digest.digest(), State(tree))
        state.left_by.setdefault(action, []).append(number)
        return state


class _Kept:
    """A folder as it was before another process went on in it: the same files (inodes: some are open)."""

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
    """One run of a command that is looked at: what the layer tells, and what is noted of it."""

    def __init__(self, folder: Path, actions: list[str]) -> None:
        self.folder, self.actions, self.states = folder, actions, States()
        self.torn = True  # whether the last call has its state for "tear"
        self.kept: _Kept | None = None

    def hear(self, line: str) -> bytes:
        """Note what the folder holds now; what is answered: "c" to go on, "f" for a copy with a full disk."""
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
        """What is here after half of the last call, if that was a write, else after it: torn there, it leaves this."""
        if not self.torn:
            self.states.note(tree, "tear", len(self.states.calls) - 1)
        self.torn = True

    def on_full_disk(self, tree: Tree, code: int) -> None:
        """A copy with a full disk has ended."""
        number = len(self.states.calls) - 1
        state = self.states.note(tree, "full", number)
        if code not in (REFUSED, DONE):
            self.states.ended_wrong.append(f"{number}: ended with {code} ({self.states.calls[number]})")
        if any(name.endswith(".tmp") for name in tree):
            state.wrong.append("left a temporary file on a full disk")


def watched(command: Command, layer: Any, folder: Path, actions: list[str]) -> States:
    """Run the command once, in the end undisturbed, and return what the actions at each of its calls leave.

    Parameters
    ----------
    layer
        The layer of ``kill_runs``.
    folder
        Where the command works; it is there afterwards, as the command left it.
    actions
        Of kill, tear and full.
    """
    told, answered = os.pipe(), os.pipe()

    def looked_at() -> None:
        os.close(told[0]), os.close(answered[1])
        layer.watch(folder, told[1], answered[0])
        command.run(folder)

    child = started(looked_at)
    os.close(told[1]), os.close(answered[0])
    look = Look(folder, actions)
    while line := os.read(told[0], 1 << 16):  # the process waits after each: one line at a time
        os.write(answered[1], look.hear(line.decode(errors="surrogateescape").rstrip("\n")))
    os.close(told[0]), os.close(answered[1])
    if (code := ended(child)) != DONE:
        raise SystemExit(f"the command that was looked at ended with {code}")
    look.after(tree_of(folder))
    return look.states


def gone_on_from(states: States, folder: Path, judge: Callable[[Path], list[str]], seconds: float) -> int:
    """Lay each state into the folder, add what ``judge`` says of it; the number that there was time for."""
    began, done = time.monotonic(), 0
    for state in states.found.values():
        if time.monotonic() - began > seconds:
            break
        lay(state.tree, folder)
        state.wrong += judge(folder)
        state.judged = True
        done += 1
    return done
