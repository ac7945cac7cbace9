"""Splat files beyond PLY and SPZ."""
