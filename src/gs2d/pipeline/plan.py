"""The parts of whole runs, for the line that says how far one is and what time is left of it.

Shares of training: a run on 292 photographs of a room at 780x520 spent 13 % of its time on the mesh and most of the
rest on training. That is one capture; the shares of texture, report and scores are coarser still. What is shown is
therefore a range from half to twice of them.
"""

from __future__ import annotations

from gs2d.pipeline.events import Part

PLACED = (
    Part("photographs", ("looking for sharp frames", "taking frames", "reading photographs", "copying photographs")),
    Part("features", ("finding features",)),
    Part("matching", ("finding similar", "matching")),
    Part("cameras", ("placing", "checking the capture")),
)
_TRAINING = Part("training", ("training",))
_MESH = Part("mesh", ("rendering depth", "fusing"), of_training=0.17)
_TEXTURE = Part("texture", ("cutting the surface", "comparing the colours", "colouring the texture"), of_training=0.1)
_REPORT = Part("report", ("writing the report", "writing the page"), of_training=0.03)
TRAINED = (_TRAINING, _MESH, _REPORT)
TEXTURED_TOO = (_TRAINING, _MESH, _REPORT, _TEXTURE)
DEMO = (Part("photographs", ("photographing",)), *TRAINED, Part("scores", ("scoring the surface",), of_training=0.1))
