"""The splats that training starts from: sparse, swept or random points, or points on depth maps."""
