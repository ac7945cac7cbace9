"""Claims: who works on what, told apart from those who are gone; stages that one trains and others wait for."""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from gs2d.experiments import claims as sweep_claims
from gs2d.experiments.claims import is_stale, take_claim
from gs2d.experiments.execute import StageClaims, stage_keys
from sweep_jobs import dead_pid, write_claim


def test_a_claim_is_held_by_one_and_free_again_after_release(tmp_path: Path) -> None:
    first = take_claim(tmp_path / "job.claim")
    assert first is not None
    assert take_claim(tmp_path / "job.claim") is None
    assert not is_stale(tmp_path / "job.claim")
    first.release()
    assert take_claim(tmp_path / "job.claim") is not None


@pytest.mark.parametrize("facts", [{"pid": None}, {"began": "12345"}], ids=["dead process", "number in use again"])
def test_a_claim_of_a_process_that_is_gone_is_taken_over(tmp_path: Path, facts: dict[str, Any]) -> None:
    path = tmp_path / "job.claim"
    write_claim(path, **({"pid": dead_pid(), "began": "1"} if facts.get("pid", 0) is None else facts))
    assert is_stale(path)
    mine = take_claim(path)
    assert mine is not None
    assert json.loads(path.read_text())["pid"] == os.getpid()


def test_of_many_that_see_a_dead_claim_one_gets_it(tmp_path: Path) -> None:
    path = tmp_path / "job.claim"
    for _ in range(5):
        write_claim(path, pid=dead_pid(), began="1")
        with ThreadPoolExecutor(8) as pool:
            got = [claim for claim in pool.map(lambda _i: take_claim(path), range(8)) if claim is not None]
        assert len(got) == 1
        got[0].release()


def test_a_claim_of_another_machine_is_stale_when_it_is_not_touched(tmp_path: Path) -> None:
    path = tmp_path / "job.claim"
    write_claim(path, host="elsewhere")
    assert not is_stale(path)
    old = time.time() - sweep_claims.FOREIGN_SECONDS - 1
    os.utime(path, (old, old))
    assert is_stale(path)


def test_a_claim_of_another_container_on_this_host_is_judged_by_its_age(tmp_path: Path) -> None:
    path = tmp_path / "job.claim"
    write_claim(path, space="pid:[1]", pid=dead_pid(), began="1")  # its process numbers mean nothing here
    assert not is_stale(path)
    old = time.time() - sweep_claims.FOREIGN_SECONDS - 1
    os.utime(path, (old, old))
    assert is_stale(path)


def test_a_clock_that_is_ahead_takes_nothing_from_the_living(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "job.claim"
    write_claim(path, host="elsewhere")  # touched now, by the disk's clock
    ahead = time.time() + 2 * sweep_claims.FOREIGN_SECONDS
    monkeypatch.setattr(sweep_claims.time, "time", lambda: ahead)
    assert not is_stale(path)
    assert [p.name for p in tmp_path.iterdir()] == ["job.claim"]


def test_a_claim_that_was_never_written_is_stale_after_a_while(tmp_path: Path) -> None:
    path = tmp_path / "job.claim"
    path.touch()  # killed between making the file and writing into it
    assert not is_stale(path)
    old = time.time() - sweep_claims.UNWRITTEN_SECONDS - 1
    os.utime(path, (old, old))
    assert is_stale(path)


def test_who_was_taken_over_does_not_release_the_new_holder(tmp_path: Path) -> None:
    path = tmp_path / "job.claim"
    first = take_claim(path)
    assert first is not None
    path.unlink()
    second = take_claim(path)
    first.release()
    assert second is not None
    assert path.exists()


def test_keys_are_equal_as_far_as_the_stages_are() -> None:
    a, b = stage_keys(["lego", 0], ["surface", "x"]), stage_keys(["lego", 0], ["surface", "y"])
    assert a[0] == b[0]
    assert a[1] != b[1]
    assert stage_keys(["lego", 1], ["surface"])[0] != a[0]


def test_a_stage_under_training_is_waited_for_and_free_when_it_is_finished(tmp_path: Path) -> None:
    first, second = StageClaims(tmp_path, ("s", "a")), StageClaims(tmp_path, ("s", "b"))
    assert first.take()
    assert not second.take()
    assert not (tmp_path / "b.claim").exists()  # who cannot have all holds none
    first.finished(1)
    assert second.take()
    second.release()
    first.release()
    assert not list(tmp_path.glob("*.claim"))
