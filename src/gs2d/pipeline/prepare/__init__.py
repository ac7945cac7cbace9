"""Before training: options, captures, priors and memory become one resolved run; finished runs are opened."""
