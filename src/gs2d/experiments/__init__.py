"""Many runs from one plan: sweeps, the paper's tables and figures."""
