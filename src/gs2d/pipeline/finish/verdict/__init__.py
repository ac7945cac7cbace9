"""The verdict on a run: what is measured, how it is judged, and its file."""
