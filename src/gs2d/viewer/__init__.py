"""Splats in a browser: served from this machine, or as one page that draws them exactly."""
