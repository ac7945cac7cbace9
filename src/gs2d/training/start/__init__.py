"""The splats that training starts from: sparse, swept, known or random points."""
