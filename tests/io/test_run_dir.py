"""Run folders: ownership, files after a kill, and what a resume reads."""

from __future__ import annotations

import importlib.metadata
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gs2d.errors import DiskError, RunError
from gs2d.io.run_dir import EventLog, RunFolder, claim_run, load_tensors, open_run, save_tensors

SCENE = {"name": "ball", "path": "ball", "format": "blender", "train": 6, "test": 2}
DEFINITION = {"recipe": {"name": "2dgs-r"}, "scene": SCENE}


def new_run(path: Path) -> RunFolder:
    run = claim_run(path, resume=False, overwrite=False)
    run.write_definition(DEFINITION)
    return run


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_a_new_run_has_a_definition_with_versions_and_machine(tmp_path: Path) -> None:
    run = new_run(tmp_path / "a" / "b")
    written = open_run(tmp_path / "a" / "b").definition()
    assert written["recipe"] == DEFINITION["recipe"]
    assert written["versions"]["torch"] == importlib.metadata.version("torch")
    assert written["machine"]["cores"] >= 1
    assert names(run.path) == ["run.json"]


def test_an_existing_run_is_an_error_unless_resumed_or_overwritten(tmp_path: Path) -> None:
    new_run(tmp_path / "run")
    with pytest.raises(RunError, match="--resume"):
        claim_run(tmp_path / "run", resume=False, overwrite=False)
    assert claim_run(tmp_path / "run", resume=True, overwrite=False).definition()["recipe"] == DEFINITION["recipe"]


def test_overwriting_deletes_the_files_of_the_run_and_nothing_else(tmp_path: Path) -> None:
    run = new_run(tmp_path / "run")
    run.save_checkpoint(0, "surface", 10, {"x": 1})
    run.events.append({"kind": "x"})
    run.write_metrics({"stages": []})
    (run.path / "notes.txt").write_text("mine")
    claim_run(run.path, resume=False, overwrite=True)
    assert names(run.path) == [".lock", "notes.txt"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_with_other_files_is_never_taken(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(RunError, match="thesis"):
        claim_run(tmp_path, resume=False, overwrite=overwrite)
    assert names(tmp_path) == ["thesis.tex"]


def test_a_run_without_a_complete_definition_is_started_again(tmp_path: Path) -> None:
    kill = (
        "import os; from gs2d.core.atomic_files import atomic_write\n"
        "with atomic_write('run.json'): os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", kill], cwd=tmp_path, check=False)
    (left,) = names(tmp_path)
    assert left != "run.json"
    assert claim_run(tmp_path, resume=True, overwrite=False).checkpoints() == []


def test_a_lock_removes_temporary_files_of_killed_processes(tmp_path: Path) -> None:
    run = new_run(tmp_path)
    kill = "import os, sys\nfrom gs2d.core.atomic_files import atomic_write\n"
    kill += "with atomic_write(sys.argv[1]): os.kill(os.getpid(), 9)"
    left = ("events.jsonl", "checkpoints/0-surface-0000010.pt", "renders/surface/test__a.png", "surface/precision.ply")
    for name in left:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        subprocess.run([sys.executable, "-c", kill, str(tmp_path / name)], check=False)
    assert len(list(tmp_path.rglob("*.tmp"))) == len(left)
    with run.locked():
        assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.parametrize(
    ("make", "got"), [(None, "nothing"), ("folder", "a folder without run.json"), ("file", "a file")]
)
def test_opening_something_else_names_what_it_is(tmp_path: Path, make: str | None, got: str) -> None:
    path = tmp_path / "x"
    if make == "folder":
        path.mkdir()
    elif make == "file":
        path.write_text("")
    with pytest.raises(RunError, match=f"expected a run folder at .*x, got {got}"):
        open_run(path)


@pytest.mark.parametrize(
    ("versions", "words"), [({"2dgs-r": "9.9"}, "gs2d 9.9"), ({}, "another version"), (3, "another version")]
)
def test_a_run_of_another_format_names_the_version_that_wrote_it(tmp_path: Path, versions: object, words: str) -> None:
    run = new_run(tmp_path)
    (tmp_path / "run.json").write_text(json.dumps({"format": 99, "versions": versions}))
    with pytest.raises(RunError, match=f"format 99, expected 2; use {words}, which wrote it"):
        run.definition()


@pytest.mark.parametrize("text", ["[]", "{}", '{"format": 2}', '{"format": 2, "recipe": 3, "scene": {}}', "3"])
def test_a_damaged_definition_is_one_line(tmp_path: Path, text: str) -> None:
    run = new_run(tmp_path)
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(RunError, match=r"run\.json .*(must|format)"):
        run.definition()


@pytest.mark.parametrize("text", ["[]", "{}", '{"stages": 3}', '{"stages": [{}]}', '{"stages": [1]}'])
def test_damaged_metrics_are_one_line(tmp_path: Path, text: str) -> None:
    run = new_run(tmp_path)
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(RunError, match=r"metrics\.json .*must"):
        run.metrics()


def test_the_log_is_truncated_to_the_checkpoint_without_incomplete_lines(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "events.jsonl")
    log.append({"iteration": 1})
    size = log.size
    log.append({"iteration": 2})
    with open(log.path, "ab") as file:
        file.write(b'{"iterat')
    assert log.read() == [{"iteration": 1}, {"iteration": 2}]
    log.cut(size)
    assert log.read() == [{"iteration": 1}]
    log.append({"iteration": 2})
    assert log.path.read_text() == '{"iteration": 1}\n{"iteration": 2}\n'


def test_a_log_line_is_removed_if_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import resource

    log = EventLog(tmp_path / "events.jsonl")
    log.append({"a": 1})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    import signal

    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, hard))
    try:
        with pytest.raises(DiskError, match="events"):
            log.append({"b": "x" * 100})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    assert log.path.read_bytes() == b'{"a": 1}\n'


def test_the_last_two_checkpoints_and_the_end_of_a_stage_are_kept(tmp_path: Path) -> None:
    run = new_run(tmp_path)
    for iteration in (10, 20, 30):
        run.save_checkpoint(0, "surface", iteration, {"i": iteration})
    assert [c.iteration for c in run.checkpoints()] == [20, 30]
    run.save_checkpoint(0, "surface", None, {"i": 40})
    run.save_checkpoint(1, "appearance", 5, {"i": 45})
    found = run.checkpoints()
    assert [(c.stage_index, c.stage, c.iteration) for c in found] == [(0, "surface", None), (1, "appearance", 5)]
    assert load_tensors(found[-1].path)["i"] == 45


def test_a_checkpoint_stores_the_length_of_the_log(tmp_path: Path) -> None:
    run = new_run(tmp_path)
    run.events.append({"iteration": 1})
    path = run.save_checkpoint(0, "surface", 1, {"tensor": torch.arange(3)})
    payload = load_tensors(path)
    assert payload["events_bytes"] == len('{"iteration": 1}\n')
    assert torch.equal(payload["tensor"], torch.arange(3))


def test_one_changed_byte_of_a_checkpoint_is_detected(tmp_path: Path) -> None:
    path = tmp_path / "x.pt"
    save_tensors(path, {"a": torch.full((1000,), 0.5)})  # 00 00 00 3f
    data = bytearray(path.read_bytes())
    data[data.index(b"\x00\x00\x00\x3f" * 100) + 202] = 1
    path.write_bytes(bytes(data))
    with pytest.raises(RunError, match=r"x\.pt"):
        load_tensors(path)


@pytest.mark.parametrize("damage", ["cut", "garbage", "missing"])
def test_a_broken_checkpoint_is_named(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "x.pt"
    save_tensors(path, {"a": torch.zeros(1000)})
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:500])
    elif damage == "garbage":
        path.write_bytes(b"not a checkpoint")
    else:
        path.unlink()
    with pytest.raises(RunError, match="checkpoint"):
        load_tensors(path)


def test_a_checkpoint_with_code_is_an_error(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.mkdir, (str(tmp_path / "executed"),)

    torch.save({"x": Evil()}, tmp_path / "x.pt")
    with pytest.raises(RunError, match="not a readable checkpoint"):
        load_tensors(tmp_path / "x.pt")
    assert not (tmp_path / "executed").exists()


def test_a_full_disk_keeps_the_older_checkpoint(tmp_path: Path) -> None:
    import resource
    import signal

    run = new_run(tmp_path)
    run.save_checkpoint(0, "surface", 1, {"a": torch.zeros(10)})
    before = names(tmp_path / "checkpoints")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(DiskError, match="surface"):
            run.save_checkpoint(0, "surface", 2, {"a": torch.zeros(1_000_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    assert names(tmp_path / "checkpoints") == before


def _hold(path: str, ready: object, done: object) -> None:
    with RunFolder(Path(path)).locked():
        ready.set()  # type: ignore[attr-defined]
        done.wait(900)  # type: ignore[attr-defined]


def test_a_lock_excludes_other_processes_and_ends_with_its_own(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    ready, done = context.Event(), context.Event()
    process = context.Process(target=_hold, args=(str(tmp_path), ready, done))
    process.start()
    assert ready.wait(600)
    run = RunFolder(tmp_path)
    with pytest.raises(RunError, match="trained"), run.locked():
        pass
    process.kill()
    process.join()
    with run.locked():
        pass


def test_discarding_removes_the_run_and_its_created_folders(tmp_path: Path) -> None:
    run = new_run(tmp_path / "a" / "b")
    with run.locked():
        run.save_checkpoint(0, "s", 1, {})
    run.discard()
    assert names(tmp_path) == []


def test_a_lock_removes_superseded_checkpoints(tmp_path: Path) -> None:
    """Killed between the checkpoint at the end of a stage and the end of the one within it."""
    run = new_run(tmp_path / "run")
    for index, iteration in ((0, None), (1, None), (2, 4)):
        run.save_checkpoint(index, "stage", iteration, {"a": torch.zeros(2)})
    left = run.path / "checkpoints" / "1-stage-0000002.pt"
    shutil.copyfile(run.path / "checkpoints" / "2-stage-0000004.pt", left)
    with run.locked():
        names = [checkpoint.path.name for checkpoint in run.checkpoints()]
    assert names == ["0-stage-end.pt", "1-stage-end.pt", "2-stage-0000004.pt"]
