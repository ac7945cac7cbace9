"""The data sets of the paper's tables and their scenes.

Sources: [s] the official 2DGS scripts (dtu_eval, tnt_eval, nerf_eval, m360_eval), [tnt] the evaluation toolbox of
Tanks and Temples, [m360] the Mip-NeRF 360 paper's split into outdoor and indoor scenes as m360_eval has it,
[d] a decision of this project. Pure Python; never imports torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from gs2d.errors import ProtocolError


@dataclass(frozen=True)
class SceneInfo:
    """One scene of a data set."""

    name: str  # name of the folder in the data set
    protocol: str
    downscale: int  # factor by which images are shrunk
    images: str = "images"  # folder of the images
    tau: float | None = None  # m, Tanks and Temples: threshold of precision and recall
    scan: int | None = None  # DTU: the number of the scan


@dataclass(frozen=True)
class DataSet:
    """A data set of the paper."""

    name: str
    title: str
    scenes: tuple[SceneInfo, ...]  # in the order of the paper's tables
    evaluator: str  # evaluator of surfaces: "dtu", "tnt", "visible-surface", or "" without ground truth

    def scene(self, name: str) -> SceneInfo:
        """Return the scene of a name, ignoring case, or raise ProtocolError."""
        for scene in self.scenes:
            if scene.name.lower() == name.lower():
                return scene
        raise ProtocolError(f"no scene {name!r} in {self.title}; there is {', '.join(s.name for s in self.scenes)}")


_SCANS = (24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122)  # [s]
DTU_SCENES = DataSet(
    "dtu",
    "DTU",
    tuple(SceneInfo(f"scan{n}", "dtu", 2, scan=n) for n in _SCANS),  # [s] -r 2
    "dtu",
)
_TNT = {  # [tnt] tau, m; [s] the large scenes are fused coarser and farther
    "Barn": (0.01, "tnt"),
    "Caterpillar": (0.005, "tnt"),
    "Ignatius": (0.003, "tnt"),
    "Truck": (0.005, "tnt"),
    "Meetingroom": (0.01, "tnt-large"),
    "Courthouse": (0.025, "tnt-large"),
}
TNT_SCENES = DataSet(
    "tnt",
    "Tanks and Temples",
    tuple(SceneInfo(name, protocol, 2, tau=tau) for name, (tau, protocol) in _TNT.items()),  # [s] -r 2
    "tnt",
)
NERF_SYNTHETIC_SCENES = DataSet(
    "nerf-synthetic",
    "NeRF-Synthetic",
    tuple(  # [s] the eight scenes, 800 x 800
        SceneInfo(name, "nerf-synthetic", 1, images="train")
        for name in ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")
    ),
    "visible-surface",  # [d] no public protocol exists
)
_OUTDOOR = ("bicycle", "flowers", "garden", "stump", "treehill")  # [m360], [s] images_4
_INDOOR = ("room", "counter", "kitchen", "bonsai")  # [m360], [s] images_2
MIP_NERF_360_SCENES = DataSet(
    "mip-nerf-360",
    "Mip-NeRF 360",
    tuple(SceneInfo(name, "mip-nerf-360", 4, images="images_4") for name in _OUTDOOR)
    + tuple(SceneInfo(name, "mip-nerf-360", 2, images="images_2") for name in _INDOOR),
    "",
)
DATASETS: Mapping[str, DataSet] = MappingProxyType(
    {d.name: d for d in (DTU_SCENES, TNT_SCENES, NERF_SYNTHETIC_SCENES, MIP_NERF_360_SCENES)}
)
