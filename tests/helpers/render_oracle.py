"""Independent renderer for the contract tests: one pixel and one splat at a time, in world space, in float64.

Intersects rays with planes directly (no homogeneous transform), and returns the margin of every threshold decision.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from math import exp, log

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.core.sh import sh_to_rgb
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.render.types import RasterSettings


@dataclass
class Oracle:
    """Images as arrays, events by name, and the smallest relative distance of a decision from its threshold."""

    images: dict[str, np.ndarray]
    events: Counter[str] = field(default_factory=Counter)
    margin: float = np.inf

    def decide(self, value: float, threshold: float) -> bool:
        """Return value >= threshold, and record the margin."""
        self.margin = min(self.margin, abs(value - threshold) / max(abs(value), abs(threshold), 1e-12))
        return value >= threshold


def render(splats: Splats, camera: Camera, s: RasterSettings) -> Oracle:
    """Render finite splats by rules 1 to 11."""
    H, W = camera.height, camera.width
    out = Oracle(
        {k: np.zeros((H, W)) for k in ("alpha", "depth_mean", "depth_median", "distortion")}
        | {k: np.zeros((H, W, 3)) for k in ("color", "normal")}
    )
    splats = splats.detach().to(dtype=torch.float64)
    means, scales, opacity = (t.numpy() for t in (splats.means, splats.scales, splats.opacities))
    frames = quats_to_matrices(splats.quats).numpy()
    view = means - camera.center
    directions = torch.tensor(view / np.linalg.norm(view, axis=1, keepdims=True))
    degree = min(s.sh_degree, splats.sh_degree)
    colors = sh_to_rgb(splats.sh0, splats.shN, directions, degree).numpy()
    if 0 < (colors > 0).sum() < colors.size:
        out.events["clamped colour"] += 1
    pixels, depth = camera.project(means)

    order = []
    for i in np.argsort(depth, kind="stable"):
        if not out.decide(depth[i], s.near):
            out.events["splat before near"] += 1
        elif not out.decide(opacity[i], s.alpha_min):
            out.events["splat below alpha_min"] += 1
        else:
            order.append(i)
    facing = [float(np.dot(frames[i, :, 2], view[i])) for i in order]
    normals = [frames[i, :, 2] * (-1 if f > 0 else 1) for i, f in zip(order, facing, strict=True)]
    if facing:
        cosines = np.abs(facing) / np.linalg.norm(view[order], axis=1)
        out.margin = min(out.margin, float(cosines.min()))
    if len(order) > 1:
        steps = np.diff(depth[order])
        out.margin = min(out.margin, float((steps / depth[order][1:]).min()))

    for row in range(H):
        for column in range(W):
            x, y = column + 0.5, row + 0.5
            ray = camera.rotation.T @ np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
            T, layers = 1.0, []  # layers: (w, z, index in order, incoming T)
            for n, i in enumerate(order):
                rho2d = ((x - pixels[i, 0]) ** 2 + (y - pixels[i, 1]) ** 2) / s.lowpass_px**2
                toward = float(frames[i, :, 2] @ ray)
                z = float(frames[i, :, 2] @ view[i]) / toward if toward != 0 else -1.0  # ray has unit depth
                if z > 0:
                    at = camera.center + z * ray - means[i]
                    u, v = at @ frames[i, :, 0] / scales[i, 0], at @ frames[i, :, 1] / scales[i, 1]
                    rho3d = u * u + v * v
                else:
                    rho3d = np.inf
                    out.events["no hit"] += 1
                if min(rho3d, rho2d) > 2 * log(opacity[i] / s.alpha_min) * 1.01 + 0.01:
                    continue  # clearly outside: no decision nearby
                if np.isfinite(rho3d) and out.decide(rho3d, rho2d):
                    out.events["low-pass"] += 1
                if rho3d > rho2d:
                    z = float(depth[i])
                rho = min(rho3d, rho2d)
                if not out.decide(z, s.near):
                    out.events["pair before near"] += 1
                    continue
                alpha = opacity[i] * exp(-rho / 2)
                if not out.decide(alpha, s.alpha_min):
                    out.events["pair below alpha_min"] += 1
                    continue
                if out.decide(alpha, s.alpha_max):
                    alpha = s.alpha_max
                    out.events["limited"] += 1
                if not out.decide(T * (1 - alpha), s.transmittance_min):
                    out.events["stopped"] += 1
                    break
                layers.append((alpha * T, z, n, T))
                T *= 1 - alpha
            _composite(out, row, column, layers, T, [colors[i] for i in order], normals, s)
    return out


def _composite(
    out: Oracle,
    row: int,
    column: int,
    layers: list[tuple[float, float, int, float]],
    T: float,
    colors: list[np.ndarray],
    normals: list[np.ndarray],
    s: RasterSettings,
) -> None:
    pixel = {name: image[row, column] for name, image in out.images.items()}
    pixel["color"] = T * np.array(s.background) + sum(w * colors[n] for w, _, n, _ in layers)
    if layers:
        pixel["alpha"] = sum(w for w, *_ in layers)
        pixel["normal"] = sum(w * normals[n] for w, _, n, _ in layers)
        pixel["depth_mean"] = sum(w * z for w, z, *_ in layers) / pixel["alpha"]
        pixel["depth_median"] = [z for _, z, _, T_in in layers if out.decide(T_in, 0.5) and T_in > 0.5][-1]
        m = [s.far / (s.far - s.near) * (1 - s.near / z) for _, z, *_ in layers]
        pixel["distortion"] = sum(
            layers[i][0] * layers[j][0] * (m[i] - m[j]) ** 2 for i in range(len(m)) for j in range(i)
        )
    for name, image in out.images.items():
        image[row, column] = pixel[name]
