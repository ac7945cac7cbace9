"""360-degree panoramas, recognised by their metadata (``data.exif.Taken.panorama``).

COLMAP places them with its spherical camera, one pose per panorama; training cuts them into faces (``data.faces``).
"""

from __future__ import annotations

PANORAMA = "EQUIRECTANGULAR"
FINER = 2  # times feature_size: a panorama covers four times the field of view of a photograph
