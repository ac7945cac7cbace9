"""The data sets of the paper: their scenes and protocols."""

from __future__ import annotations

from gs2d.config.protocols import PROTOCOLS, get_protocol
from gs2d.contrib.lab.datasets import (
    DATASETS,
    DTU_SCENES,
    MIP_NERF_360_SCENES,
    NERF_SYNTHETIC_SCENES,
    TNT_SCENES,
)


def test_dtu_is_the_fifteen_scans_at_half_size() -> None:
    assert [s.scan for s in DTU_SCENES.scenes] == [24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122]
    assert {(s.name[:4], s.protocol, s.downscale) for s in DTU_SCENES.scenes} == {("scan", "dtu", 2)}
    assert DTU_SCENES.evaluator == "dtu"


def test_tanks_and_temples_is_six_scenes_with_their_tau_and_fusion() -> None:
    """tau in m, voxel in units of the capture: the two large scenes are fused coarser and farther."""
    got = {s.name: (s.tau, get_protocol(s.protocol).fusion.voxel, s.downscale) for s in TNT_SCENES.scenes}
    assert got == {
        "Barn": (0.01, 0.004, 2),
        "Caterpillar": (0.005, 0.004, 2),
        "Ignatius": (0.003, 0.004, 2),
        "Truck": (0.005, 0.004, 2),
        "Meetingroom": (0.01, 0.006, 2),
        "Courthouse": (0.025, 0.006, 2),
    }
    assert get_protocol(TNT_SCENES.scene("courthouse").protocol).fusion.depth_limit == 4.5


def test_nerf_synthetic_is_eight_scenes_at_full_size_and_360_has_its_image_folders() -> None:
    assert len(NERF_SYNTHETIC_SCENES.scenes) == 8
    assert {s.downscale for s in NERF_SYNTHETIC_SCENES.scenes} == {1}
    folders = {s.name: (s.images, s.downscale) for s in MIP_NERF_360_SCENES.scenes}
    assert folders["garden"] == folders["bicycle"] == ("images_4", 4)
    assert folders["kitchen"] == folders["room"] == ("images_2", 2)
    assert len(folders) == 9


def test_every_scene_names_a_protocol_that_exists() -> None:
    for dataset in DATASETS.values():
        for scene in dataset.scenes:
            assert scene.protocol in PROTOCOLS
            assert (scene.tau is not None) == (dataset is TNT_SCENES)
