"""Metrics of images and surfaces."""
