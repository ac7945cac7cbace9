"""Views of splats that lie in several processes, each rendered in another one.

Every process works out which of its splats the cameras of an iteration may see, and what colour they have from there.
These *records*, 13 numbers a splat, it sends to the processes that render (all-to-all). Those work out loss and
gradients of what they got, and send the gradients of the records, the screen gradients and the radii back. Harmonics,
of which most of a splat consists, never leave their process.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gs2d.config.recipe import Stage
from gs2d.core.camera import Camera
from gs2d.core.sh import rgb_to_sh0, sh_to_rgb
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize
from gs2d.render.culling import may_be_seen
from gs2d.render.pose_gradient import pose_gradient
from gs2d.render.types import PLAIN_COLORS, RasterSettings
from gs2d.training.blended_sums import blended_sums
from gs2d.training.dropout import dropped_out, kept_splats
from gs2d.training.objective import FullRender, diverged, first_not_finite, is_async, learning_rows
from gs2d.training.parallel import Turn
from gs2d.training.shards import Seen, Shards, SplitResult, spread
from gs2d.training.state import TrainState

NUMBERS = 13  # of a record: place 3, rotation 4, scales 2, opacity 1, colour 3


@dataclass(frozen=True, eq=False)
class Sent:
    """What this process sends of a view.

    Attributes
    ----------
    rows : Tensor [M] int64
        Of this process.
    records : Tensor [M, 13]
        With the history by which gradients reach the splats.
    marks : Tensor [M, 0 to 2]
        1: not left out of the iteration, where it leaves some out; then, 1: learns, where a stage trains a row group.
    center : Tensor [3]
        Of the camera; a leaf of that history.
    """

    rows: Tensor
    records: Tensor
    marks: Tensor
    center: Tensor


class SplitViews:
    """Loss and gradients of the views of an iteration, and E_i, where each process has a part of the splats.

    Parameters
    ----------
    whole : FullRender
        Photographs, cameras and losses.
    shards : Shards
    """

    def __init__(self, whole: FullRender, shards: Shards) -> None:
        self._whole, self._shards = whole, shards

    def evaluate(
        self, state: TrainState, stage: Stage, turns: Sequence[Turn], probe: Tensor | None
    ) -> tuple[SplitResult, Sequence[Mapping[str, Tensor]]]:
        """Return gradients of the mean loss of some views for this process's splats, and of what views learn.

        Parameters
        ----------
        state : TrainState
            With this process's splats.
        stage : Stage
        turns : sequence of Turn
            At most as many as there are processes; process k renders the k-th.
        probe : Tensor [n, 2 or 4], or None
            Whether screen gradients are wanted.
        """
        shards, columns = self._shards, 0 if probe is None else probe.shape[1]
        leaves = Splats(**{k: t.detach().requires_grad_(k in stage.train) for k, t in state.splats.items()})
        sent = [self._sent(state, leaves, stage, turn, with_learning=probe is None) for turn in turns]
        received, of = shards.delivered(self._to_all([torch.cat([s.records.detach(), s.marks], dim=1) for s in sent]))
        camera, losses, of_view, back = self._render(state, stage, turns, received, columns)
        rows = [len(view.rows) for view in sent]
        returned = shards.exchanged(back, of, rows + [0] * (shards.size - len(turns))).split(rows)
        for view, values in zip(sent, returned, strict=True):
            if view.records.requires_grad:
                torch.autograd.backward([view.records], [values[:, :NUMBERS]])
        trained = {name: tensor for name, tensor in leaves.items() if name in stage.train}
        mean = {k: torch.zeros_like(t) if t.grad is None else t.grad.div_(len(turns)) for k, t in trained.items()}
        seen = tuple(_seen(view.rows, values, columns) for view, values in zip(sent, returned, strict=True))
        if state.poses is not None:
            of_view |= self._of_colors(state, sent, camera, of_view)
        each: Sequence[Mapping[str, Tensor]] = [{}] * len(turns)
        if state.of_views():
            each = shards.of_views({**mean, **of_view})[: len(turns)]
        return SplitResult(losses, mean, None, None, seen=seen), each

    def errors(self, state: TrainState, settings: RasterSettings, *, occlusion: bool) -> Iterator[Tensor]:
        """Yield the inner sum of E_i of this process's splats [n] in each training view."""
        count, size, rank = len(self._whole.scene.train), self._shards.size, self._shards.place.rank
        for first in range(0, count, size):
            indices = range(first, min(first + size, count))
            cameras = [self._whole.camera(state, index) for index in indices]
            visible = [may_be_seen(state.splats, camera, settings).nonzero().squeeze(1) for camera in cameras]
            with torch.no_grad():
                given = [
                    _records(state.splats, rows, settings.sh_degree, _center(camera, state.splats.means))
                    for rows, camera in zip(visible, cameras, strict=True)
                ]
            received, of = self._shards.delivered(self._to_all(given))
            errors = received.new_zeros(len(received))
            if rank < len(indices):
                splats = _splats(received)
                splats = replace(splats, sh0=rgb_to_sh0(splats.sh0[:, 0]))
                flat = replace(settings, sh_degree=0)
                errors = self._whole.errors(state, indices[rank], splats, flat, occlusion=occlusion)
            rows = [len(found) for found in visible]
            returned = self._shards.exchanged(errors, of, rows + [0] * (size - len(indices))).split(rows)
            for found, own in zip(visible, returned, strict=True):
                yield spread(own, found, len(state.splats))

    def blame(self, state: TrainState, stage: Stage, iteration: int, index: int) -> tuple[Tensor, Tensor]:
        """Return how much of a view's error this process's splats are drawn on [n], and their blending weights [n].

        All processes ask about the same view, which one of them renders.
        """
        whole, shards = self._whole, self._shards
        renders, camera, settings = index % shards.size, whole.camera(state, index), whole.settings(stage, iteration)
        rows = may_be_seen(state.splats, camera, settings).nonzero().squeeze(1)
        with torch.no_grad():
            records = _records(state.splats, rows, settings.sh_degree, _center(camera, state.splats.means))
        given = [records if process == renders else records[:0] for process in range(shards.size)]
        received, of = shards.delivered(given)
        back = received.new_zeros(len(received), 2)
        if shards.place.rank == renders:
            splats = _splats(received)
            found = whole.residual(state, stage, iteration, index, splats)
            back = torch.stack(blended_sums(splats, found, whole.backend), dim=1)
        sums = spread(shards.exchanged(back, of, [len(tensor) for tensor in given]), rows, len(state.splats))
        return sums[:, 0], sums[:, 1]

    def _to_all(self, given: list[Tensor]) -> list[Tensor]:
        """Return what each process gets: those without a view get nothing."""
        return given + [given[0][:0]] * (self._shards.size - len(given))

    def _sent(self, state: TrainState, leaves: Splats, stage: Stage, turn: Turn, *, with_learning: bool) -> Sent:
        """Return the records of the splats that the view of a turn may see, or the view that it is compared with."""
        whole, settings = self._whole, self._whole.settings(stage, turn.iteration)
        camera, other = whole.camera(state, turn.index), whole.turn_of(state, stage, turn.iteration, turn.index)
        visible = may_be_seen(state.splats, camera, settings)
        if other is not None:
            visible |= may_be_seen(state.splats, whole.camera(state, other.neighbour), settings)
        rows, marks, rate = visible.nonzero().squeeze(1), [], whole.drops(stage)
        if rate > 0:
            kept = kept_splats(whole.recipe, state.stage, turn.iteration, state.count, rate)
            marks.append(self._shards.own(kept, state.splats.means).to(rows.device))
        learning = learning_rows(state, stage) if with_learning else None
        if learning is not None:
            marks.append(learning)
        center = _center(camera, state.splats.means).requires_grad_(whole.learns(state, turn.iteration))
        records = _records(leaves, rows, settings.sh_degree, center)
        marked = torch.stack(marks, dim=1)[rows].to(records) if marks else records.new_empty(len(rows), 0)
        return Sent(rows, records, marked.detach(), center)

    def _render(
        self, state: TrainState, stage: Stage, turns: Sequence[Turn], received: Tensor, columns: int
    ) -> tuple[Camera | None, Mapping[str, float | Tensor], dict[str, Tensor], Tensor]:
        """Return camera and losses of this process's view, gradients of what it learns, and what is sent back.

        That is, for each record [M, 13 + columns + 1]: its gradient, its screen gradient and its radius.
        """
        rank, whole = self._shards.place.rank, self._whole
        back = received.new_zeros(len(received), NUMBERS + columns + 1)
        if rank >= len(turns):
            return None, {}, {}, back
        index, iteration = turns[rank].index, turns[rank].iteration
        records, marks = received[:, :NUMBERS].clone().requires_grad_(), received[:, NUMBERS:] > 0
        splats = _splats(records)
        drawn, marks = (dropped_out(splats, marks[:, 0]), marks[:, 1:]) if whole.drops(stage) > 0 else (splats, marks)
        camera = whole.camera(state, index, learns=whole.learns(state, iteration))
        probe = received.new_zeros(len(received), columns, requires_grad=True) if columns else None
        output = rasterize(
            drawn,
            camera,
            replace(whole.settings(stage, iteration), sh_degree=PLAIN_COLORS),
            backend=whole.backend,
            screen_probe=probe,
            gradient_rows=marks[:, 0].contiguous() if marks.shape[1] else None,
        )
        neighbour = whole.neighbour_of(state, stage, iteration, index, splats.detach())
        losses, of_view = whole.differentiate(state, stage, iteration, index, camera, output, {}, neighbour)
        if records.grad is not None:
            back[:, :NUMBERS] = records.grad
        if probe is not None and probe.grad is not None:
            back[:, NUMBERS:-1] = probe.grad
        if not is_async(back.device) and first_not_finite({"gradients": back}, whole.backend) is not None:
            raise diverged(stage, iteration, "the gradient of a splat")
        back[:, -1] = output.radii
        return camera, losses, of_view, back

    def _of_colors(
        self, state: TrainState, sent: Sequence[Sent], camera: Camera | None, of_view: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the gradient of the pose of this process's camera with the part that goes by colours, in all of them.

        Where the camera moves, splats are seen from other directions: as if they all moved the other way.
        """
        none = torch.zeros(3)
        forces = [-(none if view.center.grad is None else view.center.grad).double().cpu() for view in sent]
        total = self._shards.sum(torch.stack(forces + [none.double()] * (self._shards.size - len(sent))))
        if camera is None or camera.pose is None or "pose" not in of_view:
            return {}
        assert state.poses is not None
        moved: Any = camera.pose.detach().clone().requires_grad_()
        moved.grad = pose_gradient(moved, total[self._shards.place.rank], torch.zeros(3, dtype=torch.float64))
        return {"pose": of_view["pose"] + state.poses.gradient(replace(camera, T_cam_world=moved))}


def _center(camera: Camera, like: Tensor) -> Tensor:
    """Return where a camera is [3]."""
    return torch.as_tensor(camera.center).to(like)


def _records(splats: Splats, rows: Tensor, degree: int, center: Tensor) -> Tensor:
    """Return the records [M, 13] of some splats, seen from ``center`` with colours of this degree."""
    means = splats.means[rows]
    directions = torch.nn.functional.normalize(means - center, dim=1)
    color = sh_to_rgb(splats.sh0[rows], splats.shN[rows], directions, min(degree, splats.sh_degree))
    parts = [splats.quats[rows], splats.log_scales[rows], splats.opacity_logits[rows, None]]
    return torch.cat([means, *parts, color], dim=1)


def _splats(records: Tensor) -> Splats:
    """Return the splats of records [M, 13], in plain colours."""
    means, quats, log_scales, logits, color = records.split((3, 4, 2, 1, 3), dim=1)
    return Splats(means, quats, log_scales, logits[:, 0], color[:, None], records.new_zeros(len(records), 0, 3))


def _seen(rows: Tensor, values: Tensor, columns: int) -> Seen:
    """Return what came back of a view beside gradients."""
    return Seen(rows, values[:, NUMBERS : NUMBERS + columns] if columns else None, values[:, -1])
