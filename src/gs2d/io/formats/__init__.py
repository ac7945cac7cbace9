"""Splat files by format."""
