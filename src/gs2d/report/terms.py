"""The terms of the report in plain words: what a figure measures, and what a good one is."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup

from gs2d.report.html import macro

TERMS = {
    "PSNR": "Peak signal-to-noise ratio, in decibels: how near a rendering is to its photograph, pixel by pixel. "
    "Higher is better. 20 dB is a typical error of 10 % of the range of brightness (26 of 255), 30 dB of 3 % (8 of "
    "255); 6 dB more halve the error. One bright stripe or fog in a corner costs much.",
    "SSIM": "Structural similarity, at most 1: whether edges and textures are where the photograph has them, whatever "
    "the brightness. Higher is better; blur lowers it before it lowers PSNR.",
    "LPIPS": "Learned perceptual distance: how different a neural network finds the two pictures; near to what people "
    "say. Lower is better.",
    "Test view": "A photograph that was kept out of training. Only these tell how the scene looks from a new place: "
    "training views can be learned by heart. Test views far below training views mean fog, or too few photographs.",
    "Training view": "A photograph that the scene was fitted to.",
    "Splat": "A small flat disc with a place, a direction, two sizes, an opacity, and a colour that may change with "
    "the direction it is seen from. The scene is made of nothing else.",
    "Stage": "A part of the training with its own aims: the surface, then colours, then both together (2DGS-R).",
    "Normal": "The direction that a surface faces. Flat walls have one colour in the pictures of normals; noise in "
    "them is noise in the mesh.",
    "Normal consistency": "A loss of the training (normal_consistency in the curves): how much the discs' own "
    "directions differ from those of the surface that they make up together. Lower is a smoother, more believable "
    "surface.",
    "Depth": "How far away what a pixel shows is, along the axis of the camera, in world units.",
    "World unit": "The unit of the capture. Without known cameras or a scan it is arbitrary, no metre.",
    "Opacity": "How much a splat hides of what lies behind it, from 0 to 1.",
    "Transparent": "Pixels of training views with an alpha below 0.9, in percent, where photographs are opaque. Near 0 "
    "is good: elsewhere the background shows through, and the mesh may have holes.",
    "Floater": "Something before the camera or in the air that no photograph shows: fog, sheets, specks.",
    "Error": "Mean absolute difference of rendering and photograph over red, green and blue.",
    "Accuracy, completeness": "Mean distance from the mesh to the true surface, and from there to the mesh. Lower is "
    "better. Accuracy alone is good for a mesh of which half is missing; completeness tells.",
    "Chamfer distance": "The mean of accuracy and completeness.",
    "Precision, recall": "The share of the mesh that is nearer to the true surface than a distance; the share of the "
    "true surface that is so near to the mesh.",
    "F-score": "The harmonic mean of precision and recall at one distance: 1 where both are perfect, near 0 where one "
    "of them is.",
    "Peak memory": "The most memory that the process held at once.",
}
_COLUMNS = {"Splats": "Splat", "F-score": "F-score", "Precision": "Precision, recall", "Recall": "Precision, recall"}


def titles_of(columns: Sequence[str]) -> dict[str, str]:
    """Return what the columns of a table mean, by column; those that have a term."""
    terms = {column: _COLUMNS.get(column, column.split(",")[0].split(" (")[0]) for column in columns}
    return {column: TERMS[term] for column, term in terms.items() if term in TERMS}


def glossary() -> Markup:
    """Return the terms as HTML that opens on demand."""
    return macro("lists.html", "glossary", TERMS)
