"""Who watches a training while it runs: nobody, unless a page is asked for (``pipeline.live``)."""

from __future__ import annotations

from gs2d.pipeline.events import Event, OnEvent
from gs2d.training import events
from gs2d.training.state import TrainState


class TrainingObserver:
    """Nobody watches a training; ``pipeline.live.Live`` has the same methods."""

    def __init__(self, on_event: OnEvent) -> None:
        self._tell = on_event

    def on_event(self, event: Event) -> None:
        """Pass an event of the pipeline on."""
        self._tell(event)

    def on_training_event(self, event: events.Event, state: TrainState) -> None:
        """Nothing is shown."""

    def scored(self, psnr: float | None) -> None:
        """Nothing is shown."""

    @property
    def waiting(self) -> bool:
        """Whether there is something to do in a turn."""
        return False

    def turn(self) -> None:
        """Nothing was asked for."""
