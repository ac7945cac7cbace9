"""Before training: options, captures, priors and memory are checked and become one job; finished runs are opened."""
