"""Names that are not UTF-8 and hold escape sequences: of photographs, captures and runs, through the commands."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from cli_runs import TINY
from gs2d.cli import run
from gs2d.data import load_scene
from tiny import write_capture

NAME = os.fsdecode(b"\xe9\x1b]0;owned\x07\n\x9b")

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere names of files are text")


def named_capture(root: Path) -> Path:
    """The ball in a folder and in files of that name."""
    capture = write_capture(root / NAME, train=3, test=1, size=16)
    for split in ("train", "test"):
        file = capture / f"transforms_{split}.json"
        meta = json.loads(file.read_text())
        for i, frame in enumerate(meta["frames"]):
            frame["file_path"] = f"./{split}/{NAME}{i}"
            (capture / split / f"r_{i}.png").rename(capture / split / f"{NAME}{i}.png")
        file.write_text(json.dumps(meta))
    return capture


def test_every_command_works_on_unprintable_names_and_prints_none_of_their_bytes(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    capture, out = named_capture(tmp_path), tmp_path / f"{NAME}run"
    for words in (
        ["info", capture],
        ["train", capture, "--out", out, "--threads", "1", *TINY],
        ["export", out, "--format", "html"],
        ["export", out / "splats.ply", "--format", "html"],
        ["export", out, "--out", tmp_path / f"{NAME}.spz"],
        ["render", out, "--split", "test"],
        ["mesh", out],
        ["info", out],
        ["train", capture, "--out", out, "--threads", "1", *TINY, "--resume"],
    ):
        code = run([str(word) for word in words])
        output = "".join(capfd.readouterr())
        assert code == 0, (words, output)
        assert not {"\x1b", "\x07", "\x9b", NAME[0]} & set(output), words
    for words in (["train", capture, "--out", out], ["mesh", NAME], ["info", out / NAME]):
        assert run([str(word) for word in words]) == 2
        assert "\\xe9\\x1b]0;owned\\x07 \\x9b" in capfd.readouterr().err
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_colmap_names_are_the_bytes_of_the_file_system(tmp_path: Path, kind: str) -> None:
    from capture_writers import small_colmap

    small_colmap(tmp_path, kind=kind)
    old = next((tmp_path / "images").iterdir())
    new = old.with_name(os.fsdecode(b"\xe9" + os.fsencode(old.name)[1:]))
    old.rename(new)
    changed = [path for path in tmp_path.rglob("images.*") if os.fsencode(old.name) in path.read_bytes()]
    for path in changed:
        path.write_bytes(path.read_bytes().replace(os.fsencode(old.name), os.fsencode(new.name)))
    assert changed
    assert new.name in {view.name for view in load_scene(tmp_path, format="colmap", test_every=0).views}
