"""COLMAP model as text with undistorted images (PINHOLE), as COLMAP's dense reconstruction and OpenMVS want them."""

from __future__ import annotations

from service.dataset.formats.colmap import text
from service.dataset.posed.exporter import Exporter

KIND = Exporter("colmap-pinhole", "COLMAP model as text, with undistorted images", text.write, pinhole=True)
