"""Training: state, rows, optimizer, densification, actions, loop."""
