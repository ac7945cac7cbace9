"""Where a run is in the world: positions of photographs, control points, markers, and the similarity that they tell."""
