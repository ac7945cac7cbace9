"""Readers of captures from Metashape, Meshroom and OpenSfM."""
