"""Results of trained splats: images, scores, verdict, mesh, texture, exports and report."""
