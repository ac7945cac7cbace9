"""Atomic writes and JSON."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from gs2d.core.atomic_files import atomic_write, sweep
from gs2d.core.json_files import read_json, write_json
from gs2d.errors import DataError, DiskError


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_a_file_appears_complete_and_only_at_the_end(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "a.bin") as file:
        file.write(b"12")
        file.flush()
        assert "a.bin" not in names(tmp_path)
        file.write(b"34")
    assert (tmp_path / "a.bin").read_bytes() == b"1234"
    with atomic_write(tmp_path / "a.bin", "w") as text:
        text.write("ä\n")
    assert (tmp_path / "a.bin").read_bytes() == "ä\n".encode()
    assert names(tmp_path) == ["a.bin"]


def write_and_raise(path: Path, error: BaseException) -> None:
    with atomic_write(path) as file:
        file.write(b"new")
        raise error


def test_a_failing_body_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    for error in (RuntimeError("ours"), KeyboardInterrupt()):
        with pytest.raises(type(error)):
            write_and_raise(tmp_path / "a", error)
        assert (tmp_path / "a").read_text() == "old"
        assert names(tmp_path) == ["a"]


def test_a_folder_that_is_missing_or_a_file_or_the_name_of_a_folder_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    for path, message in (
        ("gone/a.json", "folder does not exist: create it first"),
        ("file/a.json", "a part of the path is a file, not a folder"),
        ("folder", "a folder has this name"),
        ("x" * 300, "choose a shorter name"),
    ):
        with pytest.raises(DiskError, match=message) as caught:
            write_json(tmp_path / path, {})
        assert str(tmp_path / path) in str(caught.value)
        assert "\n" not in str(caught.value)
    assert names(tmp_path) == ["file", "folder"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_one_line(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(DiskError, match="Permission"):
            write_json(tmp_path / "a.json", {})
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.parametrize("what", ["bytes", "text", "json", "torch", "library"])
def test_a_disk_that_fills_up_is_one_line_and_leaves_nothing_behind(tmp_path: Path, what: str) -> None:
    """A file-size limit of 4 KiB stands in for the full disk: the kernel refuses the write in the same way."""
    (tmp_path / "out").write_text("old")
    body = {
        "bytes": "with atomic_write(path) as f:\n    for _ in range(100): f.write(bytes(1000)); f.flush()",
        "text": "with atomic_write(path, 'w') as f: f.write('x' * 10000)",
        "json": "write_json(path, list(range(10000)))",
        # A library that hides the system's error behind its own.
        "library": "with atomic_write(path) as f:\n    try: f.write(bytes(2 << 20))\n"
        "    except OSError: raise RuntimeError('failed') from None",
        "torch": "import torch\nwith atomic_write(path) as f: torch.save(torch.zeros(100000), f)",
    }[what]
    code = textwrap.dedent(
        """
        import resource, sys
        from gs2d.errors import DiskError
        from gs2d.core.atomic_files import atomic_write
        from gs2d.core.json_files import write_json
        path = sys.argv[1]
        if "torch" in sys.argv[2]: import torch
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        try:
            exec(sys.argv[2])
        except DiskError as error:
            print(error)
            sys.exit(7)
        """
    )
    source = Path(__file__).resolve().parents[2] / "src"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "out"), body],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(source)}, check=False,
    )  # fmt: skip
    assert done.returncode == 7, done.stderr
    assert done.stdout.count("\n") == 1
    assert f"cannot write {tmp_path / 'out'}: File too large" in done.stdout
    assert (tmp_path / "out").read_text() == "old"
    assert names(tmp_path) == ["out"]


def kill_while_writing(path: Path) -> None:
    """Let a process die half-way through an atomic write."""
    code = (
        "import os, sys, signal\nfrom gs2d.core.atomic_files import atomic_write\n"
        "with atomic_write(sys.argv[1]) as f:\n    f.write(b'new'); f.flush(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    source = Path(__file__).resolve().parents[2] / "src"
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        env={**os.environ, "PYTHONPATH": str(source)}, check=False,
    )  # fmt: skip
    assert done.returncode == -signal.SIGKILL


def test_a_kill_in_the_middle_leaves_the_old_file_and_the_next_write_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("old")
    kill_while_writing(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "old"
    assert len(names(tmp_path)) == 2  # nobody can remove it who is dead
    with atomic_write(tmp_path / "out") as file:
        file.write(b"newer")
    assert (tmp_path / "out").read_text() == "newer"
    assert names(tmp_path) == ["out"]


def test_sweeping_removes_only_temporary_files_of_killed_processes(tmp_path: Path) -> None:
    for name in ("a", "b" * 250, "ü" * 120, "c\nd"):
        kill_while_writing(tmp_path / name)
    others = [".mine.tmp", "x.gs2d.tmp"]
    for name in others:
        (tmp_path / name).write_text("")
    (tmp_path / ".folder.gs2d.tmp").mkdir()
    with atomic_write(tmp_path / "out") as file:
        assert sweep(tmp_path) == 4
        file.write(b"whole")
    assert (tmp_path / "out").read_text() == "whole"
    assert names(tmp_path) == sorted([*others, ".folder.gs2d.tmp", "out"])
    assert sweep(tmp_path / "nowhere") == 0


def test_a_link_with_the_name_of_the_temporary_file_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / ".out.gs2d.tmp").symlink_to(tmp_path / "mine")
    with atomic_write(tmp_path / "out") as file:
        file.write(b"new")
    assert sweep(tmp_path) == 0
    assert ((tmp_path / "mine").read_text(), (tmp_path / "out").read_text()) == ("mine", "new")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": 1,\n "b": }', r"a\.json"),
        (b"\xff\xfe\x00", r"a\.json"),
        (b"", r"a\.json must be JSON"),
        (b"[" * 200000, r"a\.json"),
    ],
)
def test_invalid_json_is_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_json(tmp_path / "a.json")


def test_a_file_name_that_is_not_utf_8_survives_json(tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9")  # Latin-1
    write_json(tmp_path / "x.json", {"path": name})
    assert read_json(tmp_path / "x.json") == {"path": name}
    assert os.fsencode(read_json(tmp_path / "x.json")["path"]) == b"caf\xe9"
