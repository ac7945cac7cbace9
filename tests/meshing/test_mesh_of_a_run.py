"""``gs2d mesh RUN --scene``: a tiny run meshed without bounds, and the messages."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gs2d.core.json_files import write_json
from gs2d.errors import ProtocolError, RunError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import RunFolder
from gs2d.kernels.tsdf import FusionOnDevice
from gs2d.meshing.extract import extract
from gs2d.meshing.mesh_methods import MESH_METHODS, MeshMethod
from gs2d.meshing.tsdf_volume import Add, Volume, integrator
from gs2d.pipeline.finish.run_mesh import check_mesh_options, extract_mesh, mesh_run
from gs2d.pipeline.prepare.loaded import check_same_run, finished_splats, reload_run
from gs2d.pipeline.prepare.options import MeshOptions, TrainOptions
from gs2d.pipeline.prepare.resolve import with_fused_depth
from gs2d.pipeline.train.train_run import train
from gs2d.render.backends import get_backend
from gs2d.training.events import Event, Notice, Phase, Step
from tiny import RADIUS, write_capture


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("run"), "auto")


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with the protocol of photographs, whose meshes are refined."""
    return trained(tmp_path_factory.mktemp("photographed"), "generic")


def trained(folder: Path, protocol: str) -> Path:
    capture = write_capture(folder / "ball", size=32)
    overrides = ("init_points=400", "surface.iterations=40", "surface.densify.max_splats=400")
    out = folder / "run"
    return train(
        TrainOptions(
            scene=capture,
            out=out,
            recipe="2dgs",
            protocol=protocol,
            schedule_scale=0.002,
            overrides=overrides,
            threads=1,
        )
    ).path


def test_an_unbounded_mesh_of_a_run_reports_its_levels(run: Path, tmp_path: Path) -> None:
    result = mesh_run(run, MeshOptions(whole_scene=True, voxel=0.05), out=tmp_path / "far.ply", threads=1)
    assert result["method"] == "unbounded"
    assert result["levels"] >= 1
    mesh = read_mesh(tmp_path / "far.ply")
    assert len(mesh.faces) == result["faces"] > 100
    assert np.median(np.linalg.norm(mesh.vertices, axis=1)) == pytest.approx(RADIUS, rel=0.4)  # barely trained
    assert json.dumps(result)


def test_default_voxels_grow_until_the_volume_fits(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fine = mesh_run(run, MeshOptions(), out=tmp_path / "fine.ply", threads=1)
    allowed = fine["volume_bytes"] // 3
    monkeypatch.setattr("gs2d.pipeline.finish.run_mesh.memory_budget", lambda: allowed)
    heard: list[Event] = []
    coarse = mesh_run(run, MeshOptions(), out=tmp_path / "coarse.ply", threads=1, on_event=heard.append)
    assert coarse["volume_bytes"] <= allowed
    assert coarse["voxel"] > 1.3 * fine["voxel"]
    assert coarse["faces"] > 0
    (told,) = {event.text for event in heard if isinstance(event, Notice) and "voxel" in event.text}
    assert "GiB, voxels of" in told
    with pytest.raises(ProtocolError, match="use a voxel of about"):
        mesh_run(run, MeshOptions(voxel=fine["voxel"]), out=tmp_path / "asked.ply", threads=1)


def test_training_with_little_memory_uses_larger_voxels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Training and meshing in one command: the depth maps kept by scoring are closed once the smaller voxels failed."""
    monkeypatch.setattr("gs2d.pipeline.finish.run_mesh.memory_budget", lambda: 400 << 10)
    capture, heard = write_capture(tmp_path / "ball", size=32), list[Event]()
    overrides = ("init_points=400", "surface.iterations=40", "surface.densify.max_splats=400")
    run = train(TrainOptions(scene=capture, out=tmp_path / "run", recipe="2dgs", schedule_scale=0.002, threads=1,
                             overrides=overrides), heard.append)  # fmt: skip
    assert any("using voxels of this size" in event.text for event in heard if isinstance(event, Notice))
    assert run.metrics()["mesh"]["faces"] == len(read_mesh(run.file("mesh.ply")).faces) > 10


def test_meshes_of_photographs_are_refined_and_those_of_data_sets_are_not(
    run: Path, photographed: Path, tmp_path: Path
) -> None:
    heard: list[Event] = []
    refined = mesh_run(photographed, MeshOptions(), heard.append, out=tmp_path / "refined.ply", threads=1)
    assert len(read_mesh(tmp_path / "refined.ply").faces) == refined["faces"] > 20
    mesh_run(photographed, MeshOptions(refine=False), out=tmp_path / "fused.ply", threads=1)
    assert (tmp_path / "fused.ply").read_bytes() != (tmp_path / "refined.ply").read_bytes()
    begun = next(i for i, event in enumerate(heard) if isinstance(event, Phase) and event.name == "refining the mesh")
    work = [event.done for event in heard[begun:] if isinstance(event, Step)]
    assert work == sorted(work)
    assert work[-1] == heard[begun].total  # type: ignore[union-attr]
    for options in (MeshOptions(), MeshOptions(refine=False)):
        mesh_run(run, options, out=tmp_path / f"{options.refine}.ply", threads=1)
    assert (tmp_path / "True.ply").read_bytes() == (tmp_path / "False.ply").read_bytes()


def test_watertight_meshes_need_a_method_that_closes(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = mesh_run(run, MeshOptions(watertight=True), out=tmp_path / "closed.ply", threads=1)
    assert made["method"] == "delaunay"  # instead of the default
    monkeypatch.setitem(MESH_METHODS._objects, "shell", MeshMethod(extract, closes=True))
    check_mesh_options(MeshOptions(method="shell", watertight=True))
    monkeypatch.setitem(MESH_METHODS._objects, "shell", MeshMethod(extract))
    with pytest.raises(ProtocolError, match="a method that closes .delaunay., got shell; leave one of them out"):
        check_mesh_options(MeshOptions(method="shell", watertight=True))


def test_interrupting_a_refinement_keeps_the_mesh(photographed: Path) -> None:
    before = (photographed / "mesh.ply").read_bytes()

    def interrupt(event: Event) -> None:
        if isinstance(event, Phase) and event.name == "refining the mesh":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mesh_run(photographed, MeshOptions(), interrupt, threads=1)
    assert (photographed / "mesh.ply").read_bytes() == before


def test_a_run_fuses_the_depth_of_its_protocol(run: Path, tmp_path: Path) -> None:
    assert mesh_run(run, MeshOptions(voxel=0.05), out=tmp_path / "a.ply", threads=1)["depth"] == "median"
    assert mesh_run(run, MeshOptions(voxel=0.05, depth="mean"), out=tmp_path / "b.ply", threads=1)["depth"] == "mean"
    folder = RunFolder(run)
    job = reload_run(folder, lambda _event: None)
    of_recipe = with_fused_depth(job.protocol, replace(job.recipe, fused_depth="transmittance"))
    assert (of_recipe.fused_depth, job.protocol.fused_depth) == ("transmittance", "median")
    assert with_fused_depth(of_recipe, job.recipe) is of_recipe  # a recipe without the setting changes nothing
    definition = json.loads((run / "run.json").read_text())
    del definition["protocol"]["fusion"]["depth"]
    old = RunFolder(tmp_path)
    write_json(tmp_path / "run.json", definition)
    check_same_run(old, job.resolved)
    other = replace(job.protocol, fusion=replace(job.protocol.fusion, depth="mean"))
    assert replace(job, resolved=replace(job.resolved, protocol=other)).stage_key(0) == job.stage_key(
        0
    )  # shares its stages
    with pytest.raises(RunError, match="protocol"):
        check_same_run(old, replace(job.resolved, protocol=replace(job.protocol, near=0.3)))


@pytest.mark.parametrize("method", ["tsdf", "unbounded"])
def test_a_run_without_a_gpu_is_fused_by_the_cpu(
    run: Path, tmp_path: Path, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[FusionOnDevice | None] = []

    def recorded(volumes: Sequence[Volume], device: FusionOnDevice | None) -> AbstractContextManager[Add]:
        asked.append(device)
        return integrator(volumes, device)

    job = reload_run(RunFolder(run), lambda _event: None).trained(finished_splats(RunFolder(run)))
    monkeypatch.setattr("gs2d.meshing.tsdf_volume.integrator", recorded)
    for backend in ("reference", "cpu"):
        options = MeshOptions(method=method, voxel=0.05)
        result = extract_mesh(
            replace(job, backend=get_backend(backend)), options, tmp_path / "mesh.ply", lambda _event: None
        )
        assert result["fused_by"] == "cpu"
    assert asked == [None, None]
