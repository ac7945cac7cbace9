"""Seeded benchmarks: `python -m benchmarks --out FILE.json`; committed results are in `benchmarks/results/`."""
