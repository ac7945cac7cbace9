"""World coordinates of a run: a similarity from the coordinates of the run to metres, in ``georeference.json``.

The files of a run keep their own coordinates. Exported files are in *local* metres, that is relative to ``origin``, to
fit 32-bit numbers::

    local = scale * rotation @ x + translation        world = origin + local

Axes are x east, y north, z up in geographic frames, and z up otherwise.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gs2d.core.json_files import read_json, write_json
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import GEOREFERENCE

FORMAT = 1  # version of georeference.json
Role = Literal["fitted", "left out", "check"]
FITTED: Role = "fitted"
LEFT_OUT: Role = "left out"
CHECK: Role = "check"
_UP = {"places": "the positions", "cameras": "the orientation of the cameras", "given": "--set up"}
_ROLES: tuple[Role, ...] = (FITTED, LEFT_OUT, CHECK)


@dataclass(frozen=True, eq=False)
class Residual:
    """Error of one image or control point."""

    name: str
    error: np.ndarray  # [3] transformed position minus measured position, metres, in the axes of the frame
    role: Role  # used in the fit, rejected as an outlier, or held out as a check point

    @property
    def distance(self) -> float:
        """Length of the error, metres."""
        return float(np.linalg.norm(self.error))


@dataclass(frozen=True, eq=False)
class Georeference:
    """Scale, rotation and position of a run in the world."""

    scale: float  # metres of the frame per unit of the run
    rotation: np.ndarray  # [3, 3]: from the axes of the run to those of the frame
    translation: np.ndarray  # [3] metres; small, because ``origin`` has the large part
    # [3] float64 of local coordinates in the frame: east, north, height; zeros without a geographic frame
    origin: np.ndarray
    method: str  # source of the georeference, as text
    epsg: int | None = None  # projected coordinate system, if any
    geodetic: np.ndarray | None = None  # [3] latitude, longitude (degrees, WGS 84) and height (m) of the origin
    # metres of the frame per metre on the ground, horizontally: 0.9996 to 1.0004 in UTM, else 1
    grid_scale: float = 1.0
    residuals: tuple[Residual, ...] = ()
    doubts: tuple[str, ...] = ()  # warnings, one sentence each
    details: Mapping[str, Any] = field(default_factory=dict)  # further results of the method, as JSON values

    @property
    def metres_per_unit(self) -> float:
        """Metres on the ground per unit of the run."""
        return self.scale / self.grid_scale

    @property
    def frame(self) -> str:
        """Name of the frame: "EPSG:32632", "local east, north, up" or "local, z up"."""
        if self.epsg is not None:
            return f"EPSG:{self.epsg}"
        return "local, z up" if self.geodetic is None else "local east, north, up"

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """Transform points [P, 3] of the run to local metres, float64."""
        return np.asarray(self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + self.translation)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Transform points [P, 3] of the run to the world, float64."""
        return np.asarray(self.to_local(points) + self.origin)

    def rms(self, role: Role = "fitted") -> float | None:
        """Return the root mean square of the residuals of a role, metres; None without any."""
        squares = [residual.distance**2 for residual in self.residuals if residual.role == role]
        return float(np.sqrt(np.mean(squares))) if squares else None

    def worst(self, role: Role = "fitted") -> Residual | None:
        """Return the largest residual of a role."""
        of_role = [residual for residual in self.residuals if residual.role == role]
        return max(of_role, key=lambda residual: residual.distance) if of_role else None

    def count(self, role: Role) -> int:
        """Return the number of residuals of a role."""
        return sum(residual.role == role for residual in self.residuals)

    def lines(self) -> list[str]:
        """Return a summary, as lines."""
        error = self.details.get("scale_error")
        accuracy = f" (+- {error:.2%})" if isinstance(error, float) else ""
        lines = [f"georeference: {self.frame}, from {self.method}", f"scale: {self.scale:.6g} m per unit{accuracy}"]
        if self.grid_scale != 1:
            lines[-1] += f"; 1 m on the ground is {self.grid_scale:.5f} m of the map"
        if "up" in self.details:
            lines.append(f"up: from {_UP.get(self.details['up'], self.details['up'])}")
        if np.any(self.origin):
            lines.append("offset: " + " ".join(f"{value:.10g}" for value in self.origin))
        if self.geodetic is not None:
            latitude, longitude, height = self.geodetic
            lines.append(f"origin: latitude {latitude:.6f}, longitude {longitude:.6f}, height {height:.1f} m")
        roles: tuple[tuple[Role, str], ...] = (("fitted", "residuals"), ("check", "check points"))
        for role, title in roles:
            rms, worst = self.rms(role), self.worst(role)
            if rms is not None and worst is not None:
                count = self.count(role)
                lines.append(f"{title}: {rms:.4g} m rms of {count}, worst {worst.distance:.4g} m ({worst.name})")
        if outliers := self.count("left out"):
            lines.append(f"outliers left out: {outliers}")
        return [*lines, *(f"doubtful: {doubt}" for doubt in self.doubts)]

    def to_json(self) -> dict[str, Any]:
        """Return the content of ``georeference.json``."""
        return {
            "format": FORMAT,
            "frame": self.frame,
            "epsg": self.epsg,
            "unit": "m",
            "origin": self.origin.tolist(),
            "scale": self.scale,
            "metres_per_unit": self.metres_per_unit,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "geodetic": None if self.geodetic is None else self.geodetic.tolist(),
            "grid_scale": self.grid_scale,
            "method": self.method,
            "rms": {role: self.rms(role) for role in _ROLES if self.count(role)},
            "doubts": list(self.doubts),
            "facts": dict(self.details),
            "residuals": [
                {"name": residual.name, "role": residual.role, "error": residual.error.tolist()}
                for residual in self.residuals
            ],
        }

    @classmethod
    def from_json(cls, data: Any) -> Georeference:
        """Convert the result of ``to_json``; DataError if a field is missing or invalid."""
        if not isinstance(data, Mapping):
            raise DataError(f"a georeference must be an object, got {type(data).__name__}")
        if data.get("format") != FORMAT:
            raise DataError(f"a georeference of format {FORMAT} was expected, got {str(data.get('format'))[:20]}")
        try:
            rotation, translation, origin = (_numbers(data, name) for name in ("rotation", "translation", "origin"))
            geodetic = None if data.get("geodetic") is None else _numbers(data, "geodetic")
            scale, grid_scale = float(data["scale"]), float(data.get("grid_scale", 1.0))
            epsg = data.get("epsg")
            residuals = tuple(map(_residual, data.get("residuals", ())))
            doubts = tuple(map(str, data.get("doubts", ())))
            details = dict(data.get("facts", {}))
            method = str(data["method"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise DataError(
                f"a georeference must hold scale, rotation, translation, origin and method, got {error!r}"
            ) from error
        _check(scale, grid_scale, rotation, (translation, origin, *([] if geodetic is None else [geodetic])), epsg)
        return cls(scale, rotation, translation, origin, method, epsg, geodetic, grid_scale, residuals, doubts, details)


def read_georeference(run: Path) -> Georeference | None:
    """Read the georeference of a run folder; None without one, DataError if ``georeference.json`` is damaged."""
    path = Path(run) / GEOREFERENCE
    if not path.exists():
        return None
    try:
        return Georeference.from_json(read_json(path))
    except DataError as error:
        raise DataError(
            f"{path} is damaged ({error}); remove it with `gs2d survey {run} --remove`, then run it again"
        ) from error


def required_georeference(run: Path) -> Georeference:
    """Read the georeference of a run folder, or raise RunError if it has none."""
    place = read_georeference(run)
    if place is None:
        quoted = shlex.quote(str(run))
        raise RunError(
            f"{run} has no georeference; find it with `gs2d survey {quoted} --gps` if the photographs have GPS "
            f"positions, else with `gs2d survey {quoted} --known-distance X0 Y0 Z0 X1 Y1 Z1 METRES`, "
            "from two points of the mesh"
        )
    return place


def write_georeference(run: Path, georeference: Georeference) -> Path:
    """Write the georeference of a run folder."""
    path = Path(run) / GEOREFERENCE
    write_json(path, georeference.to_json())
    return path


def _numbers(data: Mapping[str, Any], name: str) -> np.ndarray:
    return np.asarray(data[name], np.float64)


def _residual(entry: Any) -> Residual:
    error, role = np.asarray(entry["error"], np.float64), entry["role"]
    if error.shape != (3,) or not np.isfinite(error).all() or role not in _ROLES:
        raise ValueError(f"a residual {str(entry)[:60]}")
    return Residual(str(entry["name"]), error, role)


def _check(scale: float, grid_scale: float, rotation: np.ndarray, vectors: Sequence[np.ndarray], epsg: Any) -> None:
    positive = all(np.isfinite(value) and value > 0 for value in (scale, grid_scale))
    is_rotation = rotation.shape == (3, 3) and bool(np.isfinite(rotation).all())
    is_rotation = is_rotation and bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6)
    is_rotation = is_rotation and float(np.linalg.det(rotation)) > 0
    finite = all(vector.shape == (3,) and np.isfinite(vector).all() for vector in vectors)
    valid_epsg = epsg is None or (isinstance(epsg, int) and not isinstance(epsg, bool) and 1024 <= epsg <= 999_999)
    if not (positive and is_rotation and finite and valid_epsg):
        raise DataError(
            "a georeference must hold a positive scale, a rotation, a translation and an origin of three finite "
            f"numbers, and an EPSG code or null, got scale {scale:g}, EPSG {str(epsg)[:20]}"
        )
