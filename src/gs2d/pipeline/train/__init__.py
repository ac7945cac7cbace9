"""Run a training in a run folder: log, checkpoints, stages, interruption and resume."""
