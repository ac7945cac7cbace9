"""``gs2d plan``: what training on a capture takes, and whether it fits."""

from __future__ import annotations

from dataclasses import replace

from gs2d.data.archive import is_archive, unpacked_for_a_moment
from gs2d.errors import DataError
from gs2d.pipeline.prepare.estimate import Estimate, estimate
from gs2d.pipeline.prepare.limits import use_memory, use_threads
from gs2d.pipeline.prepare.loaded import read_init
from gs2d.pipeline.prepare.open_capture import open_capture
from gs2d.pipeline.prepare.options import PlanOptions
from gs2d.pipeline.prepare.resolve import by_quality, check_options, resolve
from gs2d.training.events import OnEvent, ignore


def plan(options: PlanOptions, on_event: OnEvent = ignore) -> Estimate:
    """Estimate a training: the capture is read as ``gs2d train`` does, nothing is trained or written.

    Raises
    ------
    Gs2dError
        The capture cannot be read, or training on it does not fit into memory or on the disk.
    """
    if is_archive(options.scene):
        with unpacked_for_a_moment(options.scene) as folder:
            return plan(replace(options, scene=folder), on_event)
    check_options(options)
    use_threads(options.threads)
    use_memory(options.memory)
    training = by_quality(options, on_event)
    start = None if options.init is None else len(read_init(options.init, on_event)[0])
    scale = 1.0 if training.schedule_scale is None else training.schedule_scale
    opened = open_capture(training, on_event)
    recipe, capture = resolve(training, opened, on_event, seed=training.seed, schedule_scale=scale)
    found = estimate(
        capture.scene, recipe, capture.backend, downscale=capture.downscale, prepare=options.prepare, start=start
    )
    if options.disk is not None and found.disk > options.disk * 2**30:
        raise DataError(
            f"{found.photographs:,} photographs take about {found.disk / 2**30:.2g} GiB of disk, got "
            f"{options.disk:g} GiB that --disk allows; use a larger --downscale, or allow more"
        )
    return found
