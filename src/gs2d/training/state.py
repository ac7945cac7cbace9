"""The state of a training, complete enough to continue with identical bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from operator import getitem
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.core.splats import Splats
from gs2d.errors import RunError, ShapeError

Cells = Callable[[Tensor, int], Tensor]
"""Returns the cells [S, S] of a trained view, by its index, from maps [V, S, S] of the training views of the scene."""
FORMAT = 3  # of the state dict
# Errors that reading a damaged state dict raises.
_BROKEN = (LookupError, TypeError, AttributeError, RuntimeError, ValueError)


@dataclass(eq=False)
class Moments:
    """Adam's moments of one attribute."""

    mean: Tensor  # like the attribute: running mean of the gradient
    square: Tensor  # running mean of its square
    steps: int = 0  # number of updates; kept when rows are appended or zeroed, as in the official code

    @classmethod
    def zeros_like(cls, parameter: Tensor) -> Moments:
        """Return zero moments."""
        return cls(torch.zeros_like(parameter), torch.zeros_like(parameter))


@dataclass(eq=False)
class LearnedRows:
    """G rows of numbers. A row is updated when one of its images is trained on."""

    values: Tensor  # [G, ...]: the numbers
    mean: Tensor  # [G, ...]: running mean of the gradient
    square: Tensor  # [G, ...]: running mean of its square
    steps: list[int]  # number of updates of each row

    @classmethod
    def start(cls, values: Tensor) -> LearnedRows:
        """Return rows of these values with zero moments."""
        return cls(values, torch.zeros_like(values), torch.zeros_like(values), [0] * len(values))

    def __len__(self) -> int:
        return len(self.steps)

    @torch.no_grad()
    def adam_step(
        self,
        row: int,
        gradient: Tensor,
        rate: float | Tensor,
        *,
        constants: tuple[float, float, float],
        assign: Callable[[Tensor, Tensor], Any] = Tensor.copy_,
    ) -> None:
        """Update one row in place.

        ``gradient``: gradient of the row. ``rate``: learning rate of all numbers of the row, or of each. ``constants``
        (3 floats): Adam's beta1, beta2 and eps. ``assign``: writes new values into a tensor. The step is counted even
        if it writes nothing.
        """
        self.steps[row] += 1
        count, (beta1, beta2, eps) = self.steps[row], constants
        gradient = gradient.to(self.values)
        mean = beta1 * self.mean[row] + (1 - beta1) * gradient
        square = beta2 * self.square[row] + (1 - beta2) * gradient * gradient
        scale = (square / (1 - beta2**count)).sqrt() + eps
        values = self.values[row] - rate / (1 - beta1**count) * mean / scale
        for target, new in ((self.values, values), (self.mean, mean), (self.square, square)):
            assign(target[row], new)

    def move_to(self, device: torch.device | str) -> None:
        """Move all tensors to a device."""
        self.values, self.mean, self.square = (t.to(device) for t in (self.values, self.mean, self.square))

    def check(self, name: str) -> None:
        """Raise ShapeError unless all tensors have the same shape, and each row has a count."""
        tail = " ".join(["G", *map(str, self.values.shape[1:])])
        tensors = {f"{name} values": self.values, f"{name} means": self.mean, f"{name} squares": self.square}
        arrays = {key: (tensor, tail) for key, tensor in tensors.items()}
        check_shapes({f"{name} steps": (torch.tensor(self.steps), "G")} | arrays)


@dataclass(eq=False)
class TrainState:
    """Mutable state of a training. Only the functions of ``training.rows`` change N."""

    splats: Splats  # plain tensors without autograd history
    generator: torch.Generator  # CPU generator of all random choices of training
    moments: dict[str, Moments] = field(default_factory=dict)  # of the attributes that the stage trains
    groups: dict[str, Tensor] = field(default_factory=dict)  # row groups that entry actions wrote, bool [N]
    statistics: dict[str, Tensor] | None = None  # of the densifier, [N, ...]; None in stages without one
    stage: int = 0  # index of the stage
    step: int = 0  # its finished iterations
    entered: bool = False  # whether the entry actions of the stage are done
    queue: list[int] = field(default_factory=list)  # remaining training views of this epoch; the last entry comes next
    learned: dict[str, LearnedRows] = field(default_factory=dict)  # quantities of images and cameras, by name
    # (stage, step, count): number of processes from a stage and step on; empty for one process throughout.
    processes: list[tuple[int, int, int]] = field(default_factory=list)
    # [V, S, S] uint8, of cells of the training views: "shine" and "transient" (modules of ``training.robust``)
    maps: dict[str, Tensor] = field(default_factory=dict)

    def bare(self, index: int, flatness: Tensor | None, cells: Cells = getitem) -> Tensor | None:
        """Return where training view ``index`` has no texture to trust, [H, W] uint8: flat or shiny pixels."""
        if flatness is None or "shine" not in self.maps:
            return flatness
        shine = F.interpolate(cells(self.maps["shine"], index)[None, None].float(), flatness.shape, mode="bilinear")
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
        return {"format": FORMAT, **_plain(self), "generator": self.generator.get_state()}

    @classmethod
    def from_state_dict(cls, data: Mapping[str, Any]) -> TrainState:
        """Return the state of a :meth:`state_dict`; tensors are copied.

        Raise RunError if it is of another format, incomplete, or its tensors do not fit together.
        """
        version = data.get("format") if isinstance(data, Mapping) else None
        if version != FORMAT:
            raise RunError(f"checkpoint must be of format {FORMAT}, got {str(version)[:40]!r}; train again")
        try:
            values = {entry.name: _plain(data[entry.name]) for entry in fields(cls)}
            generator = torch.Generator()
            generator.set_state(values["generator"])
            objects = {
                "splats": Splats(**values["splats"]),
                "generator": generator,
                "moments": {name: Moments(**moments) for name, moments in values["moments"].items()},
                "learned": {name: LearnedRows(**rows) for name, rows in values["learned"].items()},
                "entered": bool(values["entered"]),
                "processes": [(stage, step, count) for stage, step, count in values["processes"]],
            }
            state = cls(**values | objects)
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
        self.maps = {name: cells.to(device) for name, cells in self.maps.items()}

    def check(self) -> None:
        """Check that all tensors have the same N and the expected types, and that counts are valid.

        Raise ShapeError if a tensor has another N or type, RunError if a count is negative, or moments belong to no
        attribute.
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
        check_shapes({**arrays, **{f"map of {name}": (cells, f"V {name} {name}") for name, cells in self.maps.items()}})
        for name, cells in self.maps.items():
            if cells.dtype != torch.uint8:
                raise ShapeError(f"the map of {name} must be torch.uint8, got {cells.dtype}")
        dtype = self.splats.dtype
        for name, tensor in [*parameters.items(), *((name, array) for name, (array, _) in arrays.items())]:
            expected = torch.bool if name in groups else tensor.dtype if name in statistics else dtype
            if tensor.dtype != expected or not dtype.is_floating_point:
                raise ShapeError(f"{name} must be {expected}, got {tensor.dtype}")
        for name, rows in self.learned.items():
            rows.check(name)
        self._check_counts()

    def _check_counts(self) -> None:
        """Raise RunError for a count that is not a whole number, or below zero."""
        counts = [self.stage, self.step, *self.queue, *(count for since in self.processes for count in since)]
        counts += [moments.steps for moments in self.moments.values()]
        counts += [steps for rows in self.learned.values() for steps in rows.steps]
        wrong = [count for count in counts if not isinstance(count, int) or count < 0]
        if wrong:
            raise RunError(f"counts of iterations and views must be 0 or more, got {wrong[0]}; train again")


def _plain(value: Any) -> Any:
    """Return a copy in plain Python, with tensors in the host's memory; an object becomes a dict of its attributes."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True)
    if is_dataclass(value):
        return _plain(vars(value))
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value
