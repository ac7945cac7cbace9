"""Rendered views: colour beside the photograph, normals, depth, error."""

from __future__ import annotations

from typing import Any

from gs2d.io.run_dir import RENDERS
from gs2d.report.color_maps import ERROR_TOP, depth_scale, error_scale
from gs2d.report.gallery import Gallery, ShownView, compared, read_gallery
from gs2d.report.html_parts import missing, render
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.section_registry import register_section

MAX_VIEWS = 4
KINDS = {
    "color": "Colour",
    "normal": "Normals",
    "depth": "Depth",
    "error": "Error",
    "high_error": "High-error splats",
}


@register_section("views", title="Views")
def views_section(run: RunRecord) -> str | None:
    """Return the renderings of each shown view, stage by stage."""
    gallery = read_gallery(run.path / RENDERS)
    if gallery is None or not gallery.views:
        return missing("renders/ holds no images. `gs2d render RUN` writes them.")
    shown = [_shown(gallery, view) for view in gallery.views[:MAX_VIEWS]]
    return render(
        "views.html",
        views=shown,
        hidden=max(len(gallery.views) - MAX_VIEWS, 0),
        kinds={image["kind"] for view in shown for image in view["images"]},
        scales={"error": error_scale(9), "depth": depth_scale(9)},
        top=f"{ERROR_TOP:g}",
    )


def _shown(gallery: Gallery, view: ShownView) -> dict[str, Any]:
    """Return the images of a view that exist; the first view is compared with its photograph at the top of the page."""
    pair = compared(gallery, view)
    images = []
    for stage in gallery.stages:
        for kind, title in KINDS.items():
            pixels = gallery.rendering(stage, view, kind)
            if pixels is None or (kind == "color" and pair is not None and stage == gallery.stages[-1]):
                continue
            words = [title] + [f"after {stage}"] * (len(gallery.stages) > 1)
            if kind == "depth" and view.depth_limits is not None:
                words.append("{:.3g} to {:.3g} world units".format(*view.depth_limits))
            image = {"kind": kind, "pixels": pixels, "caption": ", ".join(words)}
            images.append({**image, "full": gallery.beside(view, stage, kind)})
    on_top = pair is not None and view is gallery.views[0]
    return {"name": view.name, "kind": view.kind, "pair": None if on_top else pair, "images": images}
