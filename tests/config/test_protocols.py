"""Protocols: the data sets' facts, and how they fill what a recipe leaves open."""

from __future__ import annotations

import pytest

from gs2d.config.protocols import DTU, GENERIC, PROTOCOLS, get_protocol
from gs2d.config.recipe import LossTerm
from gs2d.data.known_captures import protocol_for
from gs2d.errors import ProtocolError


def test_the_depth_that_is_fused_is_that_of_the_losses_unless_the_protocol_names_another() -> None:
    """NeRF-Synthetic trains on mean depth, as the official script does, and fuses median depth."""
    assert {name: p.fused_depth for name, p in PROTOCOLS.working() if p.fused_depth != p.depth} == {
        "nerf-synthetic": "median"
    }
    assert DTU.fused_depth == "median"
    assert GENERIC.fused_depth == "mean"


def test_depth_is_median_on_dtu_and_tnt_and_mean_elsewhere() -> None:
    assert {name: p.depth for name, p in PROTOCOLS.working()} == {
        "dtu": "median",
        "tnt": "median",
        "tnt-large": "median",
        "nerf-synthetic": "mean",
        "mip-nerf-360": "mean",
        "generic": "mean",
    }


def test_terms_take_what_they_leave_open_from_the_protocol() -> None:
    terms = (LossTerm("l1", 0.8), LossTerm("distortion", None, 3000), LossTerm("ssim", 0.2, depth="mean"))
    assert PROTOCOLS["tnt-large"].resolve(terms) == (
        LossTerm("l1", 0.8, depth="median"),
        LossTerm("distortion", 10.0, 3000, "median"),
        LossTerm("ssim", 0.2, depth="mean"),
    )


def test_dtu_is_trained_with_its_background_and_measured_on_training_views() -> None:
    assert not DTU.use_mask_in_training
    assert DTU.use_mask_in_fusion
    assert (DTU.test_on, DTU.test_every) == ("train", 0)
    assert (DTU.fusion.voxel, DTU.fusion.truncation, DTU.fusion.depth_limit, DTU.fusion.clusters) == (
        0.004,
        0.016,
        3.0,
        1,
    )


@pytest.mark.parametrize(
    ("scene_format", "name"),
    [("blender", "nerf-synthetic"), ("dtu", "dtu"), ("colmap", "generic"), ("nerfstudio", "generic")],
)
def test_auto_follows_the_format(scene_format: str, name: str) -> None:
    assert protocol_for(scene_format).name == name
    assert get_protocol(name) is protocol_for(scene_format)


def test_unknown_names_say_what_exists() -> None:
    with pytest.raises(ProtocolError, match="nerf-synthetic"):
        get_protocol("nerf")


def test_a_format_of_a_reader_from_elsewhere_has_the_generic_protocol() -> None:
    assert protocol_for("of-a-guest") is GENERIC
