"""Seeded benchmarks: `python -m benchmarks.<name>`; results with machine and versions go to `benchmarks/results/`."""
