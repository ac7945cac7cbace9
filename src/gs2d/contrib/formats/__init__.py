"""Splat files beyond PLY."""
