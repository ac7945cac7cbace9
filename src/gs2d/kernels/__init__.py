"""Native kernels and their loader."""
