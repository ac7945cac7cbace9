"""The state of a training, complete enough to continue with identical bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.core.splats import ATTRIBUTES, Splats
from gs2d.errors import RunError, ShapeError
from gs2d.training.learned_rows import LearnedRows

FORMAT = 2  # of the state dict
# Errors that reading a damaged state dict raises.
_BROKEN = (LookupError, TypeError, AttributeError, RuntimeError, ValueError, ArithmeticError)


@dataclass(eq=False)
class Moments:
    """Adam's moments of one attribute.

    Attributes
    ----------
    mean, square : Tensor, like the attribute
        Running means of the gradient and of its square.
    steps : int
        Number of updates; kept when rows are appended or zeroed, as in the official code.
    """

    mean: Tensor
    square: Tensor
    steps: int = 0

    @classmethod
    def zeros_like(cls, parameter: Tensor) -> Moments:
        """Return zero moments."""
        return cls(torch.zeros_like(parameter), torch.zeros_like(parameter))


@dataclass(eq=False)
class TrainState:
    """Mutable state of a training. Only the functions of ``training.rows`` change N.

    Attributes
    ----------
    splats : Splats
        Plain tensors without autograd history.
    generator : torch.Generator
        CPU generator of all random choices of training.
    moments : dict of attribute to Moments
        Moments of the attributes that the stage trains.
    groups : dict of name to bool Tensor [N]
        Row groups that entry actions wrote.
    statistics : dict of name to Tensor [N, ...], or None
        Statistics of the densifier; None in stages without one.
    stage, step : int
        Index of the stage, and its finished iterations.
    entered : bool
        Whether the entry actions of the stage are done.
    queue : list of int
        Remaining training views of this epoch; the last entry comes next.
    learned : dict of name to LearnedRows
        Learned quantities of images and cameras (``gs2d.training.learned``).
    shine : Tensor [V, S, S] uint8, or None
        How shiny the surface is in cells of the training views (``training.robust.shine``).
    processes : list of (stage, step, count)
        Number of processes from a stage and step on; empty for one process throughout.
    """

    splats: Splats
    generator: torch.Generator
    moments: dict[str, Moments] = field(default_factory=dict)
    groups: dict[str, Tensor] = field(default_factory=dict)
    statistics: dict[str, Tensor] | None = None
    stage: int = 0
    step: int = 0
    entered: bool = False
    queue: list[int] = field(default_factory=list)
    learned: dict[str, LearnedRows] = field(default_factory=dict)
    processes: list[tuple[int, int, int]] = field(default_factory=list)
    shine: Tensor | None = None

    def bare(self, index: int, flatness: Tensor | None) -> Tensor | None:
        """Return where training view ``index`` has no texture to trust, [H, W] uint8: flat or shiny pixels."""
        if flatness is None or self.shine is None:
            return flatness
        shine = F.interpolate(self.shine[index][None, None].float(), flatness.shape, mode="bilinear")
        return torch.maximum(flatness, shine[0, 0].to(torch.uint8))

    def trained_by(self, count: int) -> None:
        """Record the number of processes that train from here on, because the result depends on it."""
        if count != (self.processes[-1][2] if self.processes else 1):
            self.processes.append((self.stage, self.step, count))

    def next_view(self, count: int) -> int:
        """Return the index of the next training view, in shuffled epochs."""
        if not self.queue:
            self.queue = torch.randperm(count, generator=self.generator).tolist()
        return self.queue.pop()

    def state_dict(self) -> dict[str, Any]:
        """Return a deep copy on the host, in tensors and plain Python (``torch.load(..., weights_only=True)``)."""
        return {
            "format": FORMAT,
            "splats": {name: _copy(tensor) for name, tensor in self.splats.items()},
            "moments": {
                name: {"mean": _copy(m.mean), "square": _copy(m.square), "steps": m.steps}
                for name, m in self.moments.items()
            },
            "groups": {name: _copy(mask) for name, mask in self.groups.items()},
            "statistics": None
            if self.statistics is None
            else {name: _copy(tensor) for name, tensor in self.statistics.items()},
            "stage": self.stage,
            "step": self.step,
            "entered": self.entered,
            "queue": list(self.queue),
            "generator": self.generator.get_state(),
            "learned": {name: rows.state_dict() for name, rows in self.learned.items()},
            "processes": [list(since) for since in self.processes],
            "shine": None if self.shine is None else _copy(self.shine),
        }

    @classmethod
    def from_state_dict(cls, data: Mapping[str, Any]) -> TrainState:
        """Return the state of a :meth:`state_dict`; tensors are copied.

        Raises
        ------
        RunError
            If it is of another format, incomplete, or its tensors do not fit together.
        """
        found = data.get("format") if isinstance(data, Mapping) else None
        if found != FORMAT:
            raise RunError(f"checkpoint must be of format {FORMAT}, got {str(found)[:40]!r}; train again")
        try:
            splats = Splats(**{name: data["splats"][name].clone() for name in ATTRIBUTES})
            generator = torch.Generator()
            generator.set_state(data["generator"])
            statistics, shine = data["statistics"], data["shine"]
            state = cls(
                splats,
                generator,
                {
                    k: Moments(m["mean"].clone(), m["square"].clone(), int(m["steps"]))
                    for k, m in data["moments"].items()
                },
                {name: mask.clone() for name, mask in data["groups"].items()},
                None if statistics is None else {k: v.clone() for k, v in statistics.items()},
                int(data["stage"]),
                int(data["step"]),
                bool(data["entered"]),
                [int(index) for index in data["queue"]],
                {name: LearnedRows.from_state_dict(rows) for name, rows in data["learned"].items()},
                [(int(stage), int(step), int(count)) for stage, step, count in data["processes"]],
                None if shine is None else shine.clone(),
            )
            state.check()
            numbers = dict(state.splats.items()) | {name: rows.values for name, rows in state.learned.items()}
            for name, tensor in numbers.items():
                if not bool(tensor.isfinite().all()):
                    raise RunError(f"checkpoint is broken ({name} hold NaN or infinity); train again")
        except _BROKEN as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise RunError(f"checkpoint is broken ({reason}); train again") from error
        return state

    def move_to(self, device: torch.device | str) -> None:
        """Move all tensors but ``learned`` to a device.

        The generator stays on the CPU, so that its draws do not depend on the device.
        """
        self.splats = self.splats.to(device)
        for moments in self.moments.values():
            moments.mean, moments.square = moments.mean.to(device), moments.square.to(device)
        self.groups = {name: mask.to(device) for name, mask in self.groups.items()}
        if self.statistics is not None:
            self.statistics = {k: v.to(device) for k, v in self.statistics.items()}
        if self.shine is not None:
            self.shine = self.shine.to(device)

    def check(self) -> None:
        """Check that all tensors have the same N and the expected types, and that counts are valid.

        Raises
        ------
        ShapeError
            If a tensor has another N or type.
        RunError
            If a count is negative, or moments belong to no attribute.
        """
        parameters = dict(self.splats.items())
        unknown = self.moments.keys() - parameters.keys()
        if unknown:
            raise RunError(f"moments must be of {', '.join(parameters)}, got {min(unknown)!r}; train again")
        arrays: dict[str, tuple[Tensor, str]] = {"means": (self.splats.means, "N 3")}
        for name, moments in self.moments.items():
            tail = " ".join(str(size) for size in parameters[name].shape[1:])
            arrays[f"moments of {name}"] = (moments.mean, f"N {tail}")
            arrays[f"squared moments of {name}"] = (moments.square, f"N {tail}")
        groups = {f"group {name}": mask for name, mask in self.groups.items()}
        arrays |= {name: (mask, "N") for name, mask in groups.items()}
        statistics = {f"statistics {name}": tensor for name, tensor in (self.statistics or {}).items()}
        for name, tensor in statistics.items():
            arrays[name] = (tensor, " ".join(["N", *["_"] * (tensor.dim() - 1)]))
        check_shapes(arrays if self.shine is None else {**arrays, "shine": (self.shine, "V S S")})
        if self.shine is not None and self.shine.dtype != torch.uint8:
            raise ShapeError(f"shine must be torch.uint8, got {self.shine.dtype}")
        dtype = self.splats.dtype
        for name, tensor in [*parameters.items(), *((name, array) for name, (array, _) in arrays.items())]:
            expected = torch.bool if name in groups else tensor.dtype if name in statistics else dtype
            if tensor.dtype != expected or not dtype.is_floating_point:
                raise ShapeError(f"{name} must be {expected}, got {tensor.dtype}")
        for name, rows in self.learned.items():
            rows.check(name)
        self._check_counts()

    def _check_counts(self) -> None:
        """Raise RunError for a count below zero."""
        steps = [moments.steps for moments in self.moments.values()]
        learned = [rows.steps for rows in self.learned.values()]
        least = min([self.stage, self.step, *steps, *self.queue, *(count for counts in learned for count in counts)])
        if least < 0:
            raise RunError(f"counts of iterations and views must be 0 or more, got {least}; train again")


def _copy(tensor: Tensor) -> Tensor:
    """Return a copy in the host's memory."""
    return tensor.detach().to("cpu", copy=True)
