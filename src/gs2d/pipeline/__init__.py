"""Scene, training, evaluation, mesh and report joined: the one place that knows them all. Never prints."""
