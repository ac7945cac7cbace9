"""The pinhole camera: intrinsics in pixels and a rigid world-to-camera transform."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gs2d.errors import ShapeError

if TYPE_CHECKING:
    from torch import Tensor


class Zoom(NamedTuple):
    """A change of intrinsics, independent of the image size.

    Focal lengths are multiplied by ``scale``; the principal point moves by ``right`` and ``down`` focal lengths.
    """

    scale: float = 1.0
    right: float = 0.0
    down: float = 0.0


@dataclass(frozen=True, eq=False, slots=True)
class Camera:
    """A pinhole camera in the OpenCV convention: x right, y down, z forward.

    Pixel (i, j) (column i, row j) covers [i, i+1) x [j, j+1) and is centred at (i + 0.5, j + 0.5).
    The principal point is general.

    Attributes
    ----------
    width, height : int
        Image size, px.
    fx, fy, cx, cy : float
        Focal lengths and principal point, px, in the corner-origin convention above.
    T_cam_world : ndarray [4, 4] float64
        x_cam = T_cam_world @ x_world (homogeneous). A torch tensor that requires a gradient is kept as ``pose``.
    pose : Tensor [4, 4] or None
        ``T_cam_world`` as a tensor that requires a gradient (``rasterize``, rule 20).
    intrinsics : Tensor [4] or None
        fx, fy, cx and cy as a tensor that requires a gradient, with equal values (``rasterize``, rule 21).
    rays : Tensor [H, W, 4] or None
        The ray of each pixel instead of a pinhole's, from ``gs2d.render.rays.ray_map`` (``rasterize``, rule 25).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    T_cam_world: np.ndarray  # [4, 4]
    pose: Tensor | None = None  # [4, 4]
    intrinsics: Tensor | None = None  # [4]
    rays: Tensor | None = None  # [H, W, 4]

    def __post_init__(self) -> None:
        matrix: Any = self.T_cam_world
        if hasattr(matrix, "requires_grad"):  # a torch tensor; this module does not import torch
            object.__setattr__(self, "pose", matrix if matrix.requires_grad else None)
            matrix = matrix.detach().cpu().numpy()
        T = np.array(matrix, dtype=np.float64)  # a copy: an optimizer that changes the tensor must not move the camera
        if T.shape != (4, 4):
            raise ShapeError(f"T_cam_world must be [4, 4], got {list(T.shape)}")
        if not (np.isfinite(T).all() and np.allclose(T[3], (0, 0, 0, 1), atol=1e-6)):
            raise ShapeError("T_cam_world must be finite with last row (0, 0, 0, 1)")
        R = T[:3, :3]
        with np.errstate(all="ignore"):  # overflow fails the check
            off, determinant = np.abs(R @ R.T - np.eye(3)).max(), np.linalg.det(R)
        if not (off < 1e-2 and determinant > 0):
            raise ShapeError(
                f"T_cam_world must be a rotation and a translation, got determinant {determinant:.4g} and an "
                f"orthonormality error of {off:.2g}; remove scale and mirroring"
            )
        if not np.isfinite((self.fx, self.fy, self.cx, self.cy)).all():
            raise ShapeError(f"fx, fy, cx, cy must be finite, got {self.fx}, {self.fy}, {self.cx}, {self.cy}")
        if not all(isinstance(side, int | np.integer) for side in (self.width, self.height)):
            raise ShapeError(f"width and height must be whole numbers of pixels, got {self.width!r}x{self.height!r}")
        if self.width < 1 or self.height < 1 or not (self.fx > 0 and self.fy > 0):
            raise ShapeError(
                f"a camera needs a positive size and focal length, got {self.width}x{self.height}, "
                f"fx={self.fx}, fy={self.fy}"
            )
        object.__setattr__(self, "T_cam_world", T)
        if not self.is_at_pose:
            raise ShapeError("pose must equal T_cam_world; pass the new T_cam_world as a tensor, or pose=None")
        if not self.has_its_intrinsics:
            raise ShapeError(
                "intrinsics must be a tensor [4] equal to fx, fy, cx and cy; pass the new tensor, or intrinsics=None"
            )

    @property
    def is_at_pose(self) -> bool:
        """Whether ``pose``, if any, equals ``T_cam_world``."""
        return self.pose is None or np.array_equal(self.T_cam_world, self.pose.detach().cpu().numpy())

    @property
    def has_its_intrinsics(self) -> bool:
        """Whether ``intrinsics``, if any, equals fx, fy, cx and cy."""
        return self.intrinsics is None or self.intrinsics.tolist() == [self.fx, self.fy, self.cx, self.cy]

    @property
    def K(self) -> np.ndarray:
        """Intrinsic matrix [3, 3], px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def rotation(self) -> np.ndarray:
        """World-to-camera rotation [3, 3]."""
        return np.asarray(self.T_cam_world[:3, :3])

    @property
    def center(self) -> np.ndarray:
        """Camera centre in the world [3] world units."""
        return np.asarray(-self.rotation.T @ self.T_cam_world[:3, 3])

    @property
    def forward(self) -> np.ndarray:
        """Unit optical axis in the world [3]."""
        return np.asarray(self.rotation[2])

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera for another image size; intrinsics scale with each axis."""
        sx, sy = width / self.width, height / self.height
        return self._with(width, height, (self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy), (sx, sy, sx, sy))

    def downscaled(self, factor: int) -> Camera:
        """Return the camera of an image area-filtered by an integer factor; leftover rows and columns are cut.

        Raises
        ------
        ShapeError
            If the result is empty.
        """
        width, height = self.width // factor, self.height // factor
        if factor < 1 or width < 1 or height < 1:
            raise ShapeError(f"downscale must leave at least one pixel of {self.width}x{self.height}, got {factor}")
        f = float(factor)
        return self._with(width, height, (self.fx / f, self.fy / f, self.cx / f, self.cy / f), (1 / f,) * 4)

    def zoomed(self, zoom: Zoom) -> Camera:
        """Return the camera with changed intrinsics, without their tensor."""
        scale, right, down = zoom
        cx, cy = self.cx + self.fx * right, self.cy + self.fy * down
        return replace(self, fx=self.fx * scale, fy=self.fy * scale, cx=cx, cy=cy, intrinsics=None)

    def _with(self, width: int, height: int, numbers: tuple[float, ...], factors: tuple[float, ...]) -> Camera:
        """Return the camera with another size and intrinsics; an intrinsics tensor is scaled differentiably."""
        if self.rays is not None:
            raise ShapeError("a camera with rays has one size; make a camera with the rays of the other size")
        learning = None
        if self.intrinsics is not None:
            learning = self.intrinsics * self.intrinsics.new_tensor(factors)
            numbers = tuple(learning.tolist())
        fx, fy, cx, cy = numbers
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, intrinsics=learning)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points.

        Parameters
        ----------
        points : ndarray [P, 3] world units

        Returns
        -------
        pixels : ndarray [P, 2] px
        depth : ndarray [P] world units, along the optical axis (points behind the camera have depth <= 0)
        """
        if self.rays is not None:
            raise ShapeError("a camera with rays has no pinhole projection")
        x = points @ self.rotation.T + self.T_cam_world[:3, 3]
        z = x[:, 2]
        safe = np.where(np.abs(z) < 1e-12, 1e-12, z)
        return np.stack([self.fx * x[:, 0] / safe + self.cx, self.fy * x[:, 1] / safe + self.cy], axis=1), z


def look_at(
    eye: np.ndarray, target: np.ndarray, up: np.ndarray, *, width: int, height: int, fx: float, fy: float | None = None
) -> Camera:
    """Return a camera that looks from one point at another.

    Parameters
    ----------
    eye, target : ndarray [3]
        Camera centre, and a point on the optical axis, world units.
    up : ndarray [3]
        Direction towards the top of the image, of any length.
    width, height : int
        Image size, px.
    fx, fy : float
        Focal lengths, px; ``fy`` None: the same as ``fx``. The principal point is the image centre.

    Returns
    -------
    Camera

    Raises
    ------
    ShapeError
        If ``eye`` is at ``target``, or ``up`` is along the optical axis.

    Examples
    --------
    >>> camera = look_at(np.array([0, -2.0, 0.5]), np.zeros(3), np.array([0, 0, 1.0]), width=64, height=48, fx=60.0)
    >>> camera.center.round(6).tolist()
    [0.0, -2.0, 0.5]
    """
    eye, target, up = (np.asarray(v, dtype=np.float64) for v in (eye, target, up))
    right = np.cross(target - eye, up)
    if not np.linalg.norm(right) > 0:
        raise ShapeError(
            f"look_at needs an eye away from its target and an up that is not the viewing direction, got eye "
            f"{eye.tolist()}, target {target.tolist()}, up {up.tolist()}; choose another up"
        )
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T[:3, 3] = -T[:3, :3] @ eye
    return Camera(width, height, fx, fy if fy is not None else fx, width / 2, height / 2, T)
