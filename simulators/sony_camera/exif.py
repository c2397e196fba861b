"""What an ILCE-7RM5 writes about itself into its files."""

from __future__ import annotations

from simulators.still_camera.exif import Nameplate

PLATE = Nameplate("SONY", "ILCE-7RM5", "FE 24-70mm F2.8 GM", "05318008", "ILCE-7RM5 v3.00")
