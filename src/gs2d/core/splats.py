"""The scene: N flat Gaussian disks with spherical-harmonic colour."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gs2d.core.checks import check_shapes

ATTRIBUTES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
IMAGES = ("color", "alpha", "normal", "depth_mean", "depth_median", "distortion")
"""Output images of a rendering, in the order of the kernels."""


@dataclass(eq=False)
class Splats:
    """Parameters of N splats, before activation (2DGS: a local frame, two scales, an opacity, SH colour).

    Attributes
    ----------
    means : Tensor [N, 3] world units
        Centres p (the paper's mu).
    quats : Tensor [N, 4]
        Rotations, (w, x, y, z), normalised on use. Columns of the matrix: t_u, t_v, normal t_w.
    log_scales : Tensor [N, 2]
        log of s_u, s_v (world units), the standard deviations along t_u and t_v.
    opacity_logits : Tensor [N]
        Opacity o = sigmoid(opacity_logits).
    sh0 : Tensor [N, 1, 3]
        Degree-0 SH coefficients, RGB.
    shN : Tensor [N, K-1, 3]
        Higher SH coefficients, K = (degree + 1)^2.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh0: Tensor
    shN: Tensor

    def __post_init__(self) -> None:
        check_shapes(
            {
                "means": (self.means, "N 3"),
                "quats": (self.quats, "N 4"),
                "log_scales": (self.log_scales, "N 2"),
                "opacity_logits": (self.opacity_logits, "N"),
                "sh0": (self.sh0, "N 1 3"),
                "shN": (self.shN, "N _ 3"),
            }
        )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """Yield (attribute name, tensor) in the order of ``ATTRIBUTES``."""
        for field in fields(self):
            yield field.name, getattr(self, field.name)

    @property
    def sh_degree(self) -> int:
        """Highest SH degree that the coefficients can hold."""
        return round(float(1 + self.shN.shape[1]) ** 0.5) - 1

    @property
    def device(self) -> torch.device:
        """Device of all tensors."""
        return self.means.device

    @property
    def dtype(self) -> torch.dtype:
        """Type of all tensors."""
        return self.means.dtype

    @property
    def scales(self) -> Tensor:
        """Scales s_u, s_v [N, 2] world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities o [N] in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def nbytes(self) -> int:
        """Bytes of all parameters."""
        return sum(t.numel() * t.element_size() for _, t in self.items())

    def detach(self) -> Splats:
        """Return the same storage without autograd history."""
        return Splats(**{name: tensor.detach() for name, tensor in self.items()})

    def clone(self) -> Splats:
        """Return a deep, detached copy."""
        return Splats(**{name: tensor.detach().clone() for name, tensor in self.items()})

    def to(self, device: torch.device | torch.dtype | str | None = None, dtype: torch.dtype | None = None) -> Splats:
        """Return a copy on another device or in another dtype; ``to(torch.float64)`` is ``to(dtype=torch.float64)``."""
        if isinstance(device, torch.dtype):
            device, dtype = None, device
        return Splats(**{name: tensor.to(device=device, dtype=dtype) for name, tensor in self.items()})

    def save(self, path: str | os.PathLike[str], *, layout: str | None = None) -> None:
        """Write the splats to a file, in the format of its ending.

        Parameters
        ----------
        path : path
            Ends in .ply (for viewers), .compressed.ply, .spz, .splat, .usd, .glb, .sog or the ending of a registered
            format.
        layout : str, optional
            Name of the format, as for ``gs2d.write_splats``: "2dgs" is the PLY of the official code, lossless.

        Raises
        ------
        DataError
            If no format has this ending or name.
        DiskError
            If the file could not be written.

        Examples
        --------
        >>> trained.splats.save("garden.spz")  # doctest: +SKIP
        """
        import gs2d  # writers are in a higher layer

        gs2d.write_splats(path, self, layout=layout)

    def followed_by(self, others: Splats) -> Splats:
        """Concatenate splats of the same SH degree, differentiably."""
        rest = dict(others.items())
        return Splats(**{name: torch.cat([tensor, rest[name]]) for name, tensor in self.items()})

    def rows(self, index: Tensor) -> Splats:
        """Return the rows of a boolean mask or an index tensor, detached."""
        return Splats(**{name: tensor.detach()[index] for name, tensor in self.items()})
