"""Results of trained splats: images, scores, mesh, texture, exports and report."""
