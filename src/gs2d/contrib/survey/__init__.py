"""Real-world coordinates of a run, and orthophotos."""
