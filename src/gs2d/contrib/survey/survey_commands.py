"""The command ``gs2d survey`` and its options. Imports neither torch nor NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from gs2d.cli.commands import LOOK, Common, RunPath, register_command
from gs2d.config.arguments import SETTING, Arg
from gs2d.pipeline.prepare.options import Options

KnownDistance = tuple[float, float, float, float, float, float, float]  # two points of the run, metres


@dataclass(frozen=True, kw_only=True)
class GeoreferenceOptions(Options):
    """Source and coordinate system of a georeference; without a source, the current one is shown."""

    gps: bool = False
    """Use the GPS positions in the EXIF of the photographs."""
    positions: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Use positions of photographs: CSV (name,lat,lon,height or name,x,y,z) or OpenDroneMap's geo.txt."""
    control: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Use control points: CSV (name,x,y,z,photo,u,v in pixels, or name,x,y,z,run_x,run_y,run_z) or gcp_list.txt."""
    check_points: Annotated[tuple[str, ...], SETTING] = ()
    """With --control: points that are only measured (also marked by a column `check`)."""
    known_distance: Annotated[KnownDistance | None, Arg(metavar="X0 Y0 Z0 X1 Y1 Z1 METRES")] = None
    """Use the distance between two points, in coordinates of mesh.ply."""
    markers: Annotated[float | None, Arg(metavar="METRES")] = None
    """Use printed ArUco markers with this side length."""
    marker_dictionary: Annotated[str, SETTING] = "4x4_50"
    """With --markers: 4x4_50 to 7x7_1000, aruco_original, apriltag_36h11."""
    epsg: int | None = None
    """Projected coordinate system in metres (default: that of the file, or the UTM zone)."""
    enu: Annotated[bool, SETTING] = False
    """With --gps or --positions: use metres east, north and up of their centre instead of a map projection."""
    up: Annotated[tuple[float, float, float] | None, Arg(metavar="X,Y,Z", setting=True)] = None
    """Up direction in the run (default: from the positions, else from the cameras)."""
    remove: bool = False
    """Delete the georeference of the run."""


@dataclass(frozen=True, kw_only=True)
class OrthophotoOptions(Options):
    """Options of the orthophoto."""

    resolution: Annotated[float | None, Arg(metavar="METRES", setting=True)] = None
    """With --orthophoto: cell size (default: pixel size on the surface, rounded up to 1, 2, 2.5 or 5)."""


@register_command(
    "survey",
    action="gs2d.contrib.survey.show:survey",
    group=LOOK,
    first=("run", "gps", "positions", "control", "known_distance", "markers", "remove", "out", "part", "orthophoto"),
)
@dataclass(frozen=True, kw_only=True)
class SurveyCommand(GeoreferenceOptions, OrthophotoOptions, Common):
    """Find scale, up and world position of a run, export in metres, write maps."""

    run: RunPath
    """Run folder."""
    out: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Write the splats in world coordinates, in the format of the ending; the offset is in files beside it."""
    part: Literal["splats", "mesh", "texture"] = "splats"
    """With --out: write mesh.ply or the textured mesh.glb of the run instead of the splats."""
    orthophoto: bool = False
    """Write orthophoto and elevation model, from mesh.ply, to orthophoto.tif in the run, or to --out FILE.tif and
    FILE_elevation.tif."""
    threads: int | None = None
    """CPU threads."""
