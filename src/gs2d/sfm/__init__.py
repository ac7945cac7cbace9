"""Structure from motion: a folder of photographs to a capture with cameras. COLMAP does the work (extra ``sfm``)."""
