"""From frames to a mesh: limits, fusion, marching cubes, components."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gs2d.mesh.consistency import depth_noise
from gs2d.mesh.frames import Frame, Spool
from gs2d.mesh.fuse import fuse
from gs2d.mesh.limits import FusionLimits, derive_limits, sample_depths, widen_truncation
from gs2d.mesh.surface import components, keep_components, marching_cubes
from gs2d.triangles import Mesh


@dataclass(frozen=True)
class Extraction:
    """A mesh and how it came about."""

    mesh: Mesh
    limits: FusionLimits
    frames: int
    blocks: int
    volume_bytes: int
    components: int  # before small ones went
    faces_removed: int


def extract(
    frames: Iterable[Frame],
    *,
    limits: FusionLimits | None = None,
    resolution: int = 512,
    bbox: np.ndarray | None = None,
    voxel: float | None = None,
    truncation: float | None = None,
    depth_limit: float | None = None,
    points: np.ndarray | None = None,
    min_weight: float = 1.0,
    min_faces: int = 50,
    keep: int | None = None,
    max_bytes: int = 4 << 30,
    threads: int | None = None,
    folder: str | os.PathLike[str] | None = None,
) -> Extraction:
    """Fuse frames into a mesh.

    Parameters
    ----------
    frames : iterable of Frame
        Read once (a generator is fine) and kept in a temporary file.
    limits : FusionLimits, optional
        Default: ``derive_limits`` from the frames, with ``resolution``, ``bbox``, ``voxel``, ``truncation``,
        ``depth_limit`` and ``points`` as it takes them (they may not be given together with ``limits``); a truncation
        that is not given grows with the disagreement of the depth maps (``consistency.depth_noise``).
    min_weight : float
        See ``marching_cubes``.
    min_faces, keep : int
        See ``keep_components``.
    max_bytes : int
        Bound on the volume.
    threads : int, optional
    folder : path, optional
        Where the temporary file goes.

    Raises
    ------
    ProtocolError
        If there is nothing to fuse, the limits make no sense, or the volume would be larger than ``max_bytes``.
    ShapeError
        If a frame's maps are not of its camera's size.
    DiskError
        If the temporary file cannot be written.
    """
    if limits is not None and any(v is not None for v in (bbox, voxel, truncation, depth_limit, points)):
        raise TypeError("give limits, or the numbers to derive them from, not both")
    with Spool(folder) as spool:
        spool.extend(frames)
        if limits is None:
            samples = [sample_depths(item) for item in spool]
            limits = derive_limits(
                samples,
                spool.cameras,
                resolution=resolution,
                bbox=bbox,
                voxel=voxel,
                truncation=truncation,
                depth_limit=depth_limit,
                points=points,
            )
            if truncation is None:
                limits = widen_truncation(limits, depth_noise(spool, samples, limits))
        volume = fuse(spool, limits, max_bytes=max_bytes, threads=threads)
    whole = marching_cubes(volume, min_weight=min_weight)
    mesh = keep_components(whole, min_faces=min_faces, keep=keep)
    return Extraction(
        mesh=mesh,
        limits=limits,
        frames=volume.frames,
        blocks=len(volume.keys),
        volume_bytes=volume.nbytes,
        components=int(components(whole).max(initial=-1)) + 1,
        faces_removed=len(whole.faces) - len(mesh.faces),
    )
