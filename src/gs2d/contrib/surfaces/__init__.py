"""Further methods of mesh extraction."""
