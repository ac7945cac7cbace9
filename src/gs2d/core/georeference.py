"""Where a scene is in the world: a similarity from the coordinates of a run to metres, as a value.

A run keeps its own coordinates; nothing moves it by stealth. What is written "georeferenced" is in *local* metres, that
is in the world less ``origin``, so that 32-bit numbers keep their digits::

    local = scale * rotation @ x + translation        world = origin + local

Axes are x east, y north, z up where the frame is one of the earth's, and z up elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from gs2d.errors import DataError

FORMAT = 1  # of what `to_json` gives
Role = Literal["fitted", "left out", "check"]
FITTED: Role = "fitted"
LEFT_OUT: Role = "left out"
CHECK: Role = "check"
_UP = {"places": "the places", "cameras": "how the cameras were held", "given": "--up"}
_ROLES: tuple[Role, ...] = (FITTED, LEFT_OUT, CHECK)


@dataclass(frozen=True, eq=False)
class Residual:
    """How far a point lies from where the world says it is.

    Attributes
    ----------
    name : str
        Of the photograph or the control point.
    error : ndarray [3]
        World by the similarity less world as given, metres, in the axes of the frame.
    role : "fitted", "left out" or "check"
        Whether it decided the similarity, was left out as an outlier, or was held out as a check.
    """

    name: str
    error: np.ndarray
    role: Role

    @property
    def distance(self) -> float:
        """Length of the error, metres."""
        return float(np.linalg.norm(self.error))


@dataclass(frozen=True, eq=False)
class Georeference:
    """Scale, rotation and place of a run in the world.

    Attributes
    ----------
    scale : float
        Metres of the frame for one unit of the run.
    rotation : ndarray [3, 3]
        From the axes of the run to those of the frame.
    translation : ndarray [3]
        Metres; small, because ``origin`` has the large part.
    origin : ndarray [3] float64
        Where the local coordinates begin, in the frame: east, north, height; zeros where the frame is the scene's own.
    method : str
        What it was found from, in words.
    epsg : int or None
        The projected coordinate system; None: a frame of its own.
    geodetic : ndarray [3] or None
        Latitude, longitude (degrees, WGS 84) and height (m) of the origin, where they are known.
    grid_scale : float
        Metres of the frame for one metre on the ground, horizontally: 0.9996 to 1.0004 in UTM, else 1.
    residuals : tuple of Residual
    doubts : tuple of str
        What a person should look at, one sentence each.
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray
    origin: np.ndarray
    method: str
    epsg: int | None = None
    geodetic: np.ndarray | None = None
    grid_scale: float = 1.0
    residuals: tuple[Residual, ...] = ()
    doubts: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)

    unit = "m"

    @property
    def metres_per_unit(self) -> float:
        """Metres on the ground for one unit of the run: what measuring multiplies by."""
        return self.scale / self.grid_scale

    @property
    def frame(self) -> str:
        """Return the name of the frame: "EPSG:32632", "local east, north, up" or "local, z up"."""
        if self.epsg is not None:
            return f"EPSG:{self.epsg}"
        return "local, z up" if self.geodetic is None else "local east, north, up"

    @property
    def T_local_run(self) -> np.ndarray:
        """Return the similarity [4, 4] from the run to local metres."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.scale * self.rotation, self.translation
        return T

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """Return points [P, 3] of the run in local metres, float64."""
        return np.asarray(self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + self.translation)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Return points [P, 3] of the run in the world, float64."""
        return np.asarray(self.to_local(points) + self.origin)

    def from_world(self, points: np.ndarray) -> np.ndarray:
        """Return points [P, 3] of the world in the run, float64."""
        local = np.asarray(points, np.float64) - self.origin
        return np.asarray((local - self.translation) @ self.rotation / self.scale)

    def ground_way(self, way: np.ndarray) -> np.ndarray:
        """Return a way [3] between two places of the run in metres on the ground: east, north, up."""
        return np.asarray(self.metres_per_unit * (self.rotation @ np.asarray(way, np.float64)))

    @property
    def is_local(self) -> bool:
        """Whether it changes nothing: what it is of is in local metres already."""
        return bool(self.scale == 1 and not np.any(self.translation) and np.array_equal(self.rotation, np.eye(3)))

    def of_local_files(self) -> Georeference:
        """Return that of a file in local metres: only the origin and the frame are left to be said."""
        return replace(self, scale=1.0, rotation=np.eye(3), translation=np.zeros(3), residuals=(), facts={}, doubts=())

    def rms(self, role: Role = "fitted") -> float | None:
        """Return the root mean square of the residuals of a role, metres; None where there are none."""
        squares = [residual.distance**2 for residual in self.residuals if residual.role == role]
        return float(np.sqrt(np.mean(squares))) if squares else None

    def worst(self, role: Role = "fitted") -> Residual | None:
        """Return the largest residual of a role."""
        of_role = [residual for residual in self.residuals if residual.role == role]
        return max(of_role, key=lambda residual: residual.distance) if of_role else None

    def count(self, role: Role) -> int:
        """Return how many residuals have a role."""
        return sum(residual.role == role for residual in self.residuals)

    def lines(self) -> list[str]:
        """Return what is known, in lines for people."""
        error = self.facts.get("scale_error")
        accuracy = f" (+- {error:.2%})" if isinstance(error, float) else ""
        lines = [f"georeference: {self.frame}, from {self.method}", f"scale: {self.scale:.6g} m a unit{accuracy}"]
        if self.grid_scale != 1:
            lines[-1] += f"; 1 m on the ground is {self.grid_scale:.5f} m of the map"
        if "up" in self.facts:
            lines.append(f"up: by {_UP.get(self.facts['up'], self.facts['up'])}")
        if np.any(self.origin):
            lines.append("offset: " + " ".join(f"{value:.10g}" for value in self.origin))
        if self.geodetic is not None:
            latitude, longitude, height = self.geodetic
            lines.append(f"at latitude {latitude:.6f}, longitude {longitude:.6f}, height {height:.1f} m")
        roles: tuple[tuple[Role, str], ...] = (("fitted", "residuals"), ("check", "check points"))
        for role, what in roles:
            rms, worst = self.rms(role), self.worst(role)
            if rms is not None and worst is not None:
                count = self.count(role)
                lines.append(f"{what}: {rms:.4g} m rms of {count}, worst {worst.distance:.4g} m ({worst.name})")
        if left := self.count("left out"):
            lines.append(f"left out: {left} that do not agree with the others")
        return [*lines, *(f"doubtful: {doubt}" for doubt in self.doubts)]

    def to_json(self) -> dict[str, Any]:
        """Return what ``georeference.json`` holds, and the files that are written with it."""
        return {
            "format": FORMAT,
            "frame": self.frame,
            "epsg": self.epsg,
            "unit": self.unit,
            "origin": self.origin.tolist(),
            "scale": self.scale,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "geodetic": None if self.geodetic is None else self.geodetic.tolist(),
            "grid_scale": self.grid_scale,
            "method": self.method,
            "rms": {role: self.rms(role) for role in _ROLES if self.count(role)},
            "doubts": list(self.doubts),
            "facts": dict(self.facts),
            "residuals": [
                {"name": residual.name, "role": residual.role, "error": residual.error.tolist()}
                for residual in self.residuals
            ],
        }

    @classmethod
    def from_json(cls, data: Any) -> Georeference:
        """Read what ``to_json`` gave.

        Raises
        ------
        DataError
            A field is missing or is not what it should be.
        """
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
            facts = dict(data.get("facts", {}))
            method = str(data["method"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise DataError(
                f"a georeference must hold scale, rotation, translation, origin and method, got {error!r}"
            ) from error
        _check(scale, grid_scale, rotation, (translation, origin, *([] if geodetic is None else [geodetic])), epsg)
        return cls(scale, rotation, translation, origin, method, epsg, geodetic, grid_scale, residuals, doubts, facts)


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
    whole = all(vector.shape == (3,) and np.isfinite(vector).all() for vector in vectors)
    known = epsg is None or (isinstance(epsg, int) and not isinstance(epsg, bool) and 1024 <= epsg <= 999_999)
    if not (positive and is_rotation and whole and known):
        raise DataError(
            "a georeference must hold a positive scale, a rotation, a translation and an origin of three finite "
            f"numbers, and an EPSG code or null, got scale {scale:g}, EPSG {str(epsg)[:20]}"
        )
