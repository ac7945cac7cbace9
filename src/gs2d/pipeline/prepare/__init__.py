"""Resolve options and a capture into a run, before training; load finished runs."""
