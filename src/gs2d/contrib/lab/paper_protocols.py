"""The protocols of Tanks and Temples and of Mip-NeRF 360, recognised by ``--protocol auto``.

Sources, marked at each number: [s] the official 2DGS scripts (tnt_eval, m360_eval), [c] the official 2DGS code,
[2dgs] the 2DGS paper, [r] the 2DGS-R paper. Pure Python; never imports torch.
"""

from __future__ import annotations

from dataclasses import replace

from gs2d.config.protocols import PROTOCOLS, FusionLimits, Protocol

TNT = Protocol(
    "tnt",  # Barn, Caterpillar, Ignatius, Truck
    depth="median",  # [s] depth_ratio 1
    loss_weights={"distortion": 100.0},  # [s] printed (not executed); [r] Table 1 "100"
    near=0.2,  # [c]
    near_plane_policy="box",  # [c] forward.cu, compute_aabb
    downscale=2,  # [s] -r 2, [r]
    test_every=8,  # [c] --eval; [r] its PSNR is of novel views
    use_mask_in_training=False,  # [c]
    fusion=FusionLimits(voxel=0.004, truncation=0.016, depth_limit=3.0, clusters=1),  # [s]
)
TNT_LARGE = replace(
    TNT,
    name="tnt-large",  # Meetingroom, Courthouse
    loss_weights={"distortion": 10.0},  # [s] printed (not executed); [r] Table 1 "10"
    fusion=FusionLimits(voxel=0.006, truncation=0.024, depth_limit=4.5, clusters=1),  # [s]
)
MIP_NERF_360 = Protocol(
    "mip-nerf-360",
    depth="mean",  # [s] depth_ratio stays 0
    loss_weights={"distortion": 100.0},  # [2dgs] unbounded scenes; the script uses none
    near=0.2,  # [c]
    near_plane_policy="box",  # [c]
    downscale=4,  # [s] images_4 outdoors (images_2 indoors)
    test_every=8,  # [c] --eval
    use_mask_in_training=False,  # [c]
)
for _protocol in (TNT, TNT_LARGE, MIP_NERF_360):
    PROTOCOLS.register(_protocol.name, module=__name__)(_protocol)
