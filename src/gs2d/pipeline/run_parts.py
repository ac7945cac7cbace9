"""Parts of the runs of each command, for the progress of the whole run."""

from __future__ import annotations

from gs2d.training.events import RunPart

# Time relative to training: measured for the mesh on 292 photographs of 780x520 px, roughly guessed for the others.
PLACED = (
    RunPart("photographs", ("looking for sharp frames", "taking frames", "reading photographs", "copying photographs")),
    RunPart("features", ("finding features",)),
    RunPart("matching", ("finding similar", "matching")),
    RunPart("cameras", ("placing", "checking the capture")),
)
_TEXTURE_PHASES = ("cutting the surface", "comparing the colours", "colouring the texture")
TRAINED = (
    RunPart("training", ("training",)),
    RunPart("mesh", ("rendering depth", "fusing"), of_training=0.17),
    RunPart("report", ("writing the report", "writing the page"), of_training=0.03),
)
TEXTURED_TOO = (*TRAINED, RunPart("texture", _TEXTURE_PHASES, of_training=0.1))
