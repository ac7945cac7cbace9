"""Train in a run folder: log, checkpoints, results of stages, interruption and resume."""
