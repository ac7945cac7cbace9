"""The capture of the demo: a rendered scene with an exactly known surface."""
