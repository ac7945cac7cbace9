"""Robust training: floaters are removed, few images are not overfitted, opaque images stay opaque."""
