"""Measure the CUDA backend on a GPU with three commands: see METHOD.md."""
