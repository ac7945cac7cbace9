"""The output of ``gs2d poses``: photographs with and without a camera, and the next command."""

from __future__ import annotations

import shlex
from typing import Any

_MAX_LINES = 12  # of photographs without a camera; poses.json lists all


def poses_lines(result: dict[str, Any]) -> list[str]:
    """Return the outcome in lines for people."""
    from gs2d.pipeline.prepare.pose_finding import placed_line

    lines = [
        placed_line(result),
        *(f"camera: {camera['about']}" for camera in result["cameras"][:4]),
    ]
    if len(result["cameras"]) > 4:
        lines.append(f"and {len(result['cameras']) - 4} more cameras, in poses.json")
    left_out = [row for row in result["photographs"] if not row["placed"]]
    lines += [f"no camera: {row['source']}: {row['reason']}" for row in left_out[:_MAX_LINES]]
    if len(left_out) > _MAX_LINES:
        lines.append(f"no camera: {len(left_out) - _MAX_LINES} more, in poses.json")
    for other in result["other_models"]:
        lines.append(
            f"{other['folder']} holds a separate piece: {len(other['photos'])} photographs, {other['points']:,} points"
        )
    capture = result["capture"]
    lines.append(f"look at {capture}/poses.png, then: gs2d train {shlex.quote(capture)} --out RUN")
    return lines
