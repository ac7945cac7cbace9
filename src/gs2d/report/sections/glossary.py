"""Terms of the report in plain words."""

from __future__ import annotations

from collections.abc import Sequence

from gs2d.report.html_parts import macro
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.section_registry import GLOSSARY, register_section

GENERAL = {
    "PSNR": "Peak signal-to-noise ratio in decibels: similarity of a rendering and its photograph, pixel by pixel. "
    "Higher is better. At 20 dB the typical error is 10 % of the brightness range, at 30 dB it is 3 %.",
    "SSIM": "Structural similarity, at most 1: agreement of edges and textures. Higher is better.",
    "LPIPS": "Learned perceptual distance: how different two images look to a neural network. Lower is better.",
    "New view": "A test view: a photograph that was held out of training. Its score shows the quality from new angles.",
    "Training view": "A photograph that the scene was fitted to.",
    "Splat": "A small flat disc with a position, orientation, size, opacity, and a colour that depends on the viewing "
    "direction. The scene consists of splats.",
    "Stage": "A part of the training with its own losses.",
    "Normal consistency": "A loss: how much the orientation of the splats differs from the surface that they form. "
    "Lower is smoother.",
    "World unit": "The length unit of the capture. It is arbitrary unless the cameras were measured.",
    "Transparent": "Pixels of training views with an alpha below 0.9: the background shows through. Near 0 is good.",
    "Floater": "A splat in front of the camera or in the air that no photograph shows.",
    "Peak memory": "Largest amount of memory that the process used.",
}
SURFACE = {  # only for runs that are compared with a true surface
    "Accuracy": "Mean distance from the mesh to the true surface. Lower is better.",
    "Completeness": "Mean distance from the true surface to the mesh. Lower is better.",
    "Chamfer distance": "Mean of accuracy and completeness.",
    "Precision": "Share of the mesh that is closer to the true surface than a threshold.",
    "Recall": "Share of the true surface that is closer to the mesh than a threshold.",
    "F-score": "Harmonic mean of precision and recall, at most 1. Higher is better.",
}
TERMS = {**GENERAL, **SURFACE}
_NAMES = {"Splats": "Splat"}


def titles_of(names: Sequence[str]) -> dict[str, str]:
    """Return the meanings of those names that are terms."""
    terms = {name: _NAMES.get(name, name.split(",")[0].split(" (")[0]) for name in names}
    return {name: TERMS[term] for name, term in terms.items() if term in TERMS}


@register_section(GLOSSARY, title="Terms")
def terms_section(run: RunRecord) -> str | None:
    """Return the terms of the report with their meanings."""
    return macro("lists.html", "glossary", TERMS if run.surface else GENERAL)
