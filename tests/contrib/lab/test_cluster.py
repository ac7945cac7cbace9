"""Tasks on a cluster, with a module in place of Ray: what is asked of it, what its answers become."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import gs2d
from fake_ray import FakeQueue, FakeRay
from gs2d.cli import run
from gs2d.contrib.lab import training_task as task_module
from gs2d.contrib.lab.cluster import Shares, shares
from gs2d.contrib.lab.cluster_task import token_file
from gs2d.contrib.lab.cluster_worker import do_on_worker
from gs2d.contrib.lab.execute import Workers, execute
from gs2d.contrib.lab.tasks import failures
from gs2d.contrib.lab.training_task import TrainingTask
from gs2d.errors import DataError
from gs2d.training.events import Notice, OnEvent, Phase, Step
from sweep_jobs import make_jobs
from tiny import write_capture


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[TrainingTask]:
    """Training that takes no time; returns what was trained."""
    found: list[TrainingTask] = []

    def train(job: TrainingTask, on_event: OnEvent) -> dict[str, str]:
        if job.name == "bad":
            raise DataError("expected a photograph, got none")
        on_event(Phase("surface", 10))
        on_event(Step(4))
        on_event(Notice("odd"))
        found.append(job)
        return {}

    monkeypatch.setattr(task_module, "train_and_evaluate", train)
    return found


def heard_of(jobs: tuple[TrainingTask, ...], folder: Path, **options: Any) -> list[str]:
    heard: list[str] = []
    execute(
        jobs,
        folder,
        lambda event: heard.append(event.text) if isinstance(event, Notice) else None,
        workers=Workers(cluster="auto", **options),
    )
    return heard


# -- what is asked of Ray ----------------------------------------------------------------------------------------------
def test_each_task_asks_for_what_it_takes_of_a_machine(
    ray: FakeRay, tmp_path: Path, trained: list[TrainingTask]
) -> None:
    a, b = make_jobs(tmp_path, {"a": ("1",), "b": ("2",)})
    heard_of((replace(a, memory=2.0), replace(b, retries=5)), tmp_path, threads=3, backend="cpu")
    assert ray.asked["a"]["num_cpus"] == 3
    assert ray.asked["a"]["num_gpus"] == 0
    assert ray.asked["a"]["memory"] == 2 * 2**30
    assert ray.asked["a"]["max_retries"] == 2
    assert ray.asked["a"]["max_calls"] == 1  # a process of its own
    assert "memory" not in ray.asked["b"]
    assert ray.asked["b"]["max_retries"] == 5
    assert [job.train.threads for job in trained] == [3, 3]


@pytest.mark.parametrize(
    ("backend", "slots", "threads", "expected"),
    [
        ("cpu", None, None, Shares(8, 8, 0)),  # a machine each
        ("cpu", 4, None, Shares(6, 8, 0)),  # 24 cores among four
        ("cpu", None, 2, Shares(2, 2, 0)),
        ("auto", None, None, Shares(4, 16, 1)),  # the machine with GPUs has four
        ("cuda", None, 3, Shares(3, 3, 1)),
    ],
)
def test_a_task_takes_a_gpu_where_the_backend_uses_one_and_its_part_of_the_cores(
    backend: str, slots: int | None, threads: int | None, expected: Shares
) -> None:
    nodes = [{"CPU": 0.0}, {"CPU": 8.0}, {"CPU": 16.0, "GPU": 4.0}]
    assert shares(nodes, backend, slots, threads, "x") == expected


# -- what becomes of it ------------------------------------------------------------------------------------------------
def test_what_a_task_tells_comes_back_with_its_name(ray: FakeRay, tmp_path: Path, trained: list[TrainingTask]) -> None:
    jobs = make_jobs(tmp_path, {"a": ("1",), "bad": ("2",)})
    heard = heard_of(jobs, tmp_path)
    assert any(text.startswith("a starts on ") for text in heard)
    assert "a: odd" in heard
    assert heard.count("bad failed: expected a photograph, got none") == 1
    assert jobs[0].status()["state"] == "done"
    assert failures(jobs) == {"bad": "expected a photograph, got none"}
    assert not list((tmp_path / "jobs").glob("*.token"))


def test_a_task_whose_machines_are_lost_fails_and_the_others_go_on(
    ray: FakeRay, tmp_path: Path, trained: list[TrainingTask]
) -> None:
    ray.lost.add("a")
    jobs = make_jobs(tmp_path, {"a": ("1",), "b": ("2",)})
    heard_of(jobs, tmp_path)
    reason = "its process or machine was lost repeatedly, or ran out of memory (WorkerCrashedError)"
    assert failures(jobs) == {"a": reason}
    assert jobs[1].status()["state"] == "done"


def test_an_interrupt_cancels_what_runs_first_gently(ray: FakeRay, tmp_path: Path) -> None:
    ray.never |= {"a", "b"}
    jobs = make_jobs(tmp_path, {"a": ("1",), "b": ("2",)})

    def interrupt(event: Any) -> None:
        if isinstance(event, Step):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        execute(jobs, tmp_path, interrupt, workers=Workers(cluster="auto", threads=1))
    assert ray.cancelled == [False, False, True, True]
    assert not list((tmp_path / "jobs").glob("*.token"))
    assert failures(jobs) == {}  # the next command begins them again


# -- on the machine of the task ----------------------------------------------------------------------------------------
def order_of(task: Any, folder: Path) -> dict[str, Any]:
    order = {"name": task.name, "task": pickle.dumps(task), "version": gs2d.__version__, "folder": str(folder)}
    return {**order, "token": "t", "cwd": str(folder)}


def _listed(folder: Path) -> Path:
    (folder / "jobs").mkdir()
    token_file(folder, "t").touch()
    return folder


@pytest.fixture
def stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of a list; a task moves into the driver's folder, which ends with the test."""
    monkeypatch.chdir(tmp_path)
    return _listed(tmp_path)


def test_another_version_is_refused_before_the_task_is_read(stays: Path) -> None:
    (task,) = make_jobs(stays, {"a": ()})
    found = do_on_worker(
        order_of(task, stays) | {"version": "9.9", "task": b"of a later gs2d"}, FakeQueue({"num_cpus": 0})
    )
    assert found["state"] == "refused"
    assert f"has gs2d {gs2d.__version__}, this command 9.9; install the same version" in found["reason"]


def test_a_machine_that_does_not_see_the_folder_says_so(stays: Path) -> None:
    (task,) = make_jobs(stays, {"a": ()})
    found = do_on_worker(order_of(task, stays) | {"token": "of another disk"}, FakeQueue({"num_cpus": 0}))
    assert found["state"] == "refused"
    assert f"of the cluster does not see {stays}; --out, and the capture, must lie on a disk" in found["reason"]
    assert task.status()["state"] == "new"


def test_without_ray_the_command_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    monkeypatch.setitem(sys.modules, "ray", None)
    words = ["--data", str(tmp_path / "ball"), "--out", str(tmp_path / "out"), "--cluster", "auto", "--quiet"]
    assert run(["sweep", "2dgs", *words]) == 2
    said = capsys.readouterr().err
    assert said == "error: --cluster needs Ray, which is not installed; pip install 'ray>=2.60,<3'\n"
    assert not (tmp_path / "out").exists()


def test_without_the_option_ray_is_never_imported() -> None:
    code = (
        "import sys; sys.modules['ray'] = None\n"
        "from pathlib import Path; import tempfile\n"
        "from gs2d.contrib.lab import blocks, paper\n"
        "from gs2d.contrib.lab.execute import Workers, execute\n"
        "from sweep_jobs import make_jobs\n"
        "folder = Path(tempfile.mkdtemp())\n"
        "jobs = make_jobs(folder, {'a': ()})\n"
        "execute(jobs, folder)\n"
        "assert jobs[0].status()['state'] == 'failed'\n"  # there is no capture; but it was tried
        "assert not [name for name in sys.modules if name.startswith('ray.') or 'lab.cluster' in name]\n"
    )
    helpers = str(Path(__file__).resolve().parents[2] / "helpers")
    program = f"import sys; sys.path.insert(0, {helpers!r})\n{code}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
