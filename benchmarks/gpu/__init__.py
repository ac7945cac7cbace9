"""Three commands that measure the CUDA backend on a GPU: METHOD.md."""
